"""GPyTorch's sparse GP regression on the same window: 100 Adam iterations, one thread.

    pip install fathomlink[bench]

Denormals are flushed, without which it is 20 times slower.
"""

# ruff: noqa: ANN401  the types of optional packages are not known here
import time
from typing import Any

import numpy as np

from benchmarks.compression_peers import Coded, points_decoder
from benchmarks.compression_windows import Window
from firmware.compression.binning import coarsened
from firmware.compression.initial import dealt_fragments, initial_point_steps
from firmware.compression.kernels import Hyperparameters, Kernel
from firmware.compression.steps import run
from firmware.geometry import Array

ITERATIONS = 100


def available() -> bool:
    """Return whether the optional packages are there."""
    try:
        import gpytorch  # noqa: F401, PLC0415
        import torch  # noqa: F401, PLC0415
    except ImportError:
        return False
    return True


def sgpr(window: Window, *, all_soundings: bool, iterations: int = ITERATIONS) -> Coded:
    """Return SGPR with 150 inducing points on all soundings or on the 2 m cells."""
    import torch  # noqa: PLC0415

    torch.set_flush_denormal(True)
    torch.set_num_threads(1)
    cells = coarsened(window.bins, 2.0)
    position_m = np.column_stack([cells.north_m, cells.east_m])
    start_m, _ = run(initial_point_steps(position_m, cells.depth_m, 150))
    depth_m = cells.depth_m
    if all_soundings:
        position_m, depth_m = window.soundings_ned_m[:, :2], window.soundings_ned_m[:, 2]
    mean_m = float(depth_m.mean())
    x = torch.tensor(position_m, dtype=torch.float32)
    y = torch.tensor(depth_m - mean_m, dtype=torch.float32)
    started_s = time.process_time()
    model = _trained(x, y, torch.tensor(start_m, dtype=torch.float32), iterations)
    places, depth = _points(model)
    cpu_s = time.process_time() - started_s
    hyper = Hyperparameters(
        b_per_m=1.0 / float(model.base.base_kernel.lengthscale),
        c_m2=float(model.base.outputscale),
        sigma2_m2=float(model.likelihood.noise),
        mean_depth_m=mean_m,
        kernel=Kernel.SQUARED_EXPONENTIAL,
    )
    points = np.column_stack([places, depth + mean_m])
    decode = points_decoder(window, points, hyper, dealt_fragments(places, 10))
    return Coded(decode=decode, size_bytes=1816, cpu_s=cpu_s)


def _trained(x: Any, y: Any, start: Any, iterations: int) -> Any:
    """Return the model with inducing points from `start`, after so many steps of Adam."""
    import gpytorch  # noqa: PLC0415
    import torch  # noqa: PLC0415

    class Model(gpytorch.models.ExactGP):  # type: ignore[misc]
        def __init__(self, likelihood: object) -> None:
            super().__init__(x, y, likelihood)
            self.mean_module = gpytorch.means.ZeroMean()
            self.base = gpytorch.kernels.ScaleKernel(gpytorch.kernels.RBFKernel())
            self.base.base_kernel.lengthscale = 9.0
            self.base.outputscale = float(y.var())
            self.covar_module = gpytorch.kernels.InducingPointKernel(
                self.base, inducing_points=start, likelihood=likelihood
            )

        def forward(self, at: object) -> object:
            return gpytorch.distributions.MultivariateNormal(
                self.mean_module(at), self.covar_module(at)
            )

    likelihood = gpytorch.likelihoods.GaussianLikelihood()
    likelihood.noise = 0.03
    model = Model(likelihood)
    model.train()
    optimizer = torch.optim.Adam(model.parameters(), lr=0.1)
    objective = gpytorch.mlls.ExactMarginalLogLikelihood(likelihood, model)
    for _ in range(iterations):
        optimizer.zero_grad()
        loss = -objective(model(x), y)
        loss.backward()
        optimizer.step()
    return model


def _points(model: Any) -> tuple[Array, Array]:
    """Return the inducing points (M, 2) and their posterior depths (M,)."""
    import gpytorch  # noqa: PLC0415
    import torch  # noqa: PLC0415

    model.eval()
    points_m = model.covar_module.inducing_points.detach()
    with torch.no_grad(), gpytorch.settings.fast_pred_var():
        depth_m = model(points_m).mean.numpy()
    return points_m.numpy().astype(np.float64), depth_m.astype(np.float64)
