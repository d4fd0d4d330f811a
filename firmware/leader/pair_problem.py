"""Two sub-maps made ready for matching: layers, noise and spectra."""

import dataclasses
from dataclasses import dataclass

import numpy as np

from firmware.geometry import Array
from firmware.leader.alignment import Coupling, NoiseModel, fields_of
from firmware.leader.ambiguity import Relief, background
from firmware.leader.matches import ANY_PAIR, MatchingSettings, PairSigmas
from firmware.leader.relief import (
    Spectrum,
    WaveNoise,
    fine_relief_m2,
    information_per_cell,
    smoothing_cells,
    spectrum,
)
from firmware.leader.screening import (
    ErrorSurface,
    Layer,
    error_at,
    error_surface,
    mean_slope2,
    prepare,
)
from firmware.submaps import GriddedSubmap
from protocol.errors import EstimationError

_RESAMPLED_CELLS = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PairProblem:
    """Two layers with their share of the noise, and all that stays the same while they match.

    The variance of a difference is white_m2, each cell's own, and shared_m2, which neighbours in a
    reconstruction have in common. slope2 is the mean squared slope, each axis. For ridge_cells see
    `error_surface`.
    """

    reference: Layer
    query: Layer
    settings: MatchingSettings
    sigmas: PairSigmas
    noise: NoiseModel
    minimum_cells: float
    ridge_cells: float
    spectra: tuple[Spectrum, Spectrum]
    white_m2: float
    shared_m2: float
    slope2: float
    charges_m2: tuple[tuple[float, float], ...]  # of each layer; see Layer.charged

    def coupled(self, coupling: Coupling) -> "PairProblem":
        """Return the problem where so much is believed of shift and drifts."""
        return dataclasses.replace(self, noise=dataclasses.replace(self.noise, coupling=coupling))

    def surface(self) -> ErrorSurface:
        """Return E at every lattice shift."""
        return error_surface(self.reference, self.query, self.minimum_cells, self.ridge_cells)

    def surface_of(self, reference: GriddedSubmap, query: GriddedSubmap) -> ErrorSurface | None:
        """Return E at every lattice shift of both grids warped, None when one is empty."""
        layers = []
        for grid, charge in zip((reference, query), self.charges_m2, strict=True):
            bare = prepare(grid)
            if bare is None:
                return None
            layers.append(bare.charged(*charge))
        return error_surface(layers[0], layers[1], self.minimum_cells, self.ridge_cells)

    def fields(self) -> tuple[Array, Array]:
        """Return the fields of both layers, with slopes as smooth as noise makes them need to be.

        A reconstruction has hardly any.
        """
        return (
            self._fields(self.reference, self.spectra[0]),
            self._fields(self.query, self.spectra[1]),
        )

    def _fields(self, layer: Layer, relief: Spectrum) -> Array:
        noise_m2 = 0.0 if layer.grid.reconstructed else _per_cell(layer.map_m2, layer)
        return fields_of(layer, smoothing_cells(relief, noise_m2))

    def error_at(self, shift_m: Array, *, absolute: bool) -> tuple[float, int, float]:
        """Return E at any shift, the overlap in cells and the depth offset."""
        return error_at(
            self.reference,
            self.query,
            shift_m,
            self.minimum_cells,
            self.ridge_cells,
            absolute=absolute,
        )

    @property
    def correlated_cells(self) -> float:
        """How many cells err together: neighbours by resampling, and what a decoder smooths."""
        area = 2.0 * np.pi * (self.settings.correlation_m / self.query.grid.cell_m) ** 2
        return float(_RESAMPLED_CELLS * (1.0 + 0.5 * self.noise.correlated_share * area))

    @property
    def strained_m2(self) -> float:
        """What drift inside the sub-maps does to a cell's depth, which slopes to two sides."""
        return 2.0 * self.sigmas.strain_m**2 * self.slope2

    def strained(self, surface: ErrorSurface) -> ErrorSurface:
        """Return a surface of which noise also explains what drift inside the sub-maps does."""
        return dataclasses.replace(surface, noise_m2=surface.noise_m2 + self.strained_m2)

    def information(
        self, noise_scale: float, *, strain_m: float = 0.0, longest_m: float = np.inf
    ) -> float:
        """Return the information per cell of the layer that has less of it.

        Longer waves than given do not count, and strain blurs the short ones.
        """
        noise = WaveNoise(
            white_m2=self.white_m2 * noise_scale,
            shared_m2=self.shared_m2 * noise_scale,
            correlation_m=self.settings.correlation_m,
            position_sigma_m=float(np.hypot(self.settings.position_sigma_m, strain_m)),
        )
        return min(information_per_cell(relief, noise, longest_m) for relief in self.spectra)


def pair_problem(
    reference: GriddedSubmap,
    query: GriddedSubmap,
    settings: MatchingSettings,
    sigmas: PairSigmas = ANY_PAIR,
) -> PairProblem | None:
    """Return the problem of matching two grids, None when one of them is empty.

    A reconstruction misses the waves that are shorter than its points can carry; how high they
    are is told by the finer of the two spectra.

    Raises
    ------
    EstimationError
        When the grids differ in cell size.
    """
    if abs(reference.cell_m - query.cell_m) > 1e-9:
        raise EstimationError(
            f"grids of {reference.cell_m} m and {query.cell_m} m cells cannot be matched; "
            "grid both alike"
        )
    bare = [prepare(reference), prepare(query)]
    present = [layer for layer in bare if layer is not None]
    if len(present) < len(bare):
        return None
    spectra = (spectrum(present[0]), spectrum(present[1]))
    fine_m2 = max(fine_relief_m2(s, settings.finest_wave_m) for s in spectra)
    slope2 = 0.5 * sum(mean_slope2(layer.grid) for layer in present)
    half_m2 = 0.5 * settings.cell_sigma_m**2 + settings.position_sigma_m**2 * slope2
    charges_m2 = tuple(
        (fine_m2 if grid.reconstructed else 0.0, half_m2) for grid in (reference, query)
    )
    layers = [layer.charged(*charge) for layer, charge in zip(present, charges_m2, strict=True)]
    noise_m2 = sum(_per_cell(layer.noise_m2, layer) for layer in layers)
    rebuilt_m2 = sum(_per_cell(each.map_m2, each) for each in layers if each.grid.reconstructed)
    shared_m2 = settings.correlated_share * rebuilt_m2
    noise = noise_model(settings, shared_m2 / noise_m2, sigmas)
    offset_m2 = noise.offset_sigma_m**2
    return PairProblem(
        reference=layers[0],
        query=layers[1],
        settings=settings,
        sigmas=sigmas,
        noise=noise,
        minimum_cells=settings.minimum_overlap_m2 / query.cell_m**2,
        ridge_cells=noise_m2 / offset_m2 if offset_m2 > 0.0 else np.inf,
        spectra=spectra,
        white_m2=noise_m2 - shared_m2,
        shared_m2=shared_m2,
        slope2=slope2,
        charges_m2=charges_m2,
    )


def relief_of(problem: PairProblem, whole: ErrorSurface, best_m: Array) -> Relief | None:
    """Return what sets the scale of the evidence, None where no background can be told."""
    level = background(whole, best_m, 3.0 * problem.settings.basin_m)
    if level is None:
        return None
    return Relief(
        background=level,
        information_per_cell=problem.information(noise_scale=1.0),
        coherent_cells=problem.settings.coherent_overlap_m2 / problem.query.grid.cell_m**2,
    )


def _per_cell(values: Array, layer: Layer) -> float:
    return float(values.sum() / layer.known.sum())


def noise_model(
    settings: MatchingSettings, correlated_share: float, sigmas: PairSigmas = ANY_PAIR
) -> NoiseModel:
    """Return the standard deviations that a fit assumes."""
    return NoiseModel(
        cell_sigma_m=settings.cell_sigma_m,
        position_sigma_m=settings.position_sigma_m,
        offset_sigma_m=0.0 if settings.absolute_depth else sigmas.offset_m,
        tilt_sigma=sigmas.tilt,
        bend_sigma_per_m=sigmas.bend_per_m,
        drift_sigma_mps=settings.drift_sigma_mps,
        walk_m2_per_s=settings.walk_m2_per_s,
        correlation_m=settings.correlation_m,
        correlated_share=correlated_share,
    )
