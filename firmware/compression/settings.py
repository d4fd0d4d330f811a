"""What the compressor may be told; every number with its unit and its reason."""

from dataclasses import dataclass

from protocol.settings import Settings, setting


@dataclass(frozen=True, slots=True, kw_only=True)
class BinningSettings(Settings):
    """How soundings are thinned while they stream in."""

    cell_m: float = setting(
        1.0, "m", "about three soundings a cell at 40 m altitude", minimum=0.05, maximum=100.0
    )
    max_cells: int = setting(
        32768, "cells", "a 120 degree swath at 100 m altitude over 40 s", minimum=64, maximum=10**6
    )
    reservoir: int = setting(
        6, "soundings", "kept per cell so that its median is known", minimum=1, maximum=15
    )
    flier_gate: float = setting(
        4.5, "robust sigma", "a Gaussian loses 7 soundings in a million", minimum=2.0
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class CompressionSettings(Settings):
    """How a sub-map is fitted and how much work that may take."""

    method: str = setting(
        "expected",
        "name",
        "fitted through the leader's decoder for the loss to expect; `fitc` is Eq. 1-6",
        choices=("expected", "fitc"),
    )
    kernel: str = setting(
        "matern32",
        "name",
        "least error on all reliefs measured; `auto` tries each at the first points",
        choices=("auto", "squared_exponential", "matern32", "exponential"),
    )
    expected_loss: float = setting(
        0.14, "share", "one frame in seven, as in the paper", minimum=0.0, maximum=0.9
    )
    parity: bool = setting(
        True, "", "parity in the mantissas: any six of ten frames give all points of `paper`"
    )
    noise_applied: bool = setting(
        False, "", "ask the leader to apply sigma^2 again, Eq. 5 to the letter: smooths twice"
    )
    fit_cell_m: float = setting(
        2.0, "m", "ten times fewer rows than soundings for 3-5 % of the error", minimum=0.1
    )
    placing_cell_m: float = setting(
        3.5, "m", "of the smoothed cells that place points: 0.4 of their spacing", minimum=0.1
    )
    max_fit_rows: int = setting(
        4096, "rows", "bounds memory and the longest step", minimum=64, maximum=65536
    )
    iterations: int = setting(
        100, "evaluations", "0.15 s of one core; a quarter of them come within 5 %", minimum=0
    )
    dense_iterations: int = setting(
        40,
        "evaluations",
        "of `dense`, 0.4 s of one core; a quarter of them come within 5 %",
        minimum=0,
    )
    dense_points: int = setting(
        450,
        "points",
        "of `dense`, three times the paper's; more gain little and cost memory",
        minimum=3,
        maximum=600,
    )
    frames: int = setting(
        10, "frames", "a sub-map of `dense` or `lattice`; `paper` has ten", minimum=1, maximum=15
    )
    small_frames: bool = setting(False, "", "`lattice` in frames of 62 bytes instead of 256")
    sealed: bool = setting(
        False, "", "`dense` and `lattice` leave the last 12 bytes of a body to its seal"
    )
    lattice_step_m: float = setting(
        1.0,
        "m",
        "of the lattice: three soundings a node at 40 m altitude",
        minimum=0.25,
        maximum=60,
    )
    usable_frames: int = setting(
        2, "frames", "of a `lattice` transfer, any of them, that already give a map", minimum=1
    )
    usable_bytes: int = setting(
        60, "bytes", "of coefficients in that map: about the paper's fidelity", minimum=0
    )
