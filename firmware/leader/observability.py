"""What the geometry leaves undetermined: today's joint covariance beside that of dead reckoning.

Ranges tell how far vehicles are apart, not where they are nor how they are turned about each other;
closures tell where on the map a vehicle is, not where the map is. Each quantity below is a linear
form of the vehicles' newest states; the ratio of its sigmas, with measurements and without, shows
how much they tell of it. The generalised eigenvalues of the two covariances say the same without
names: an eigenvalue near one is a direction in which nothing was learned.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from firmware.geometry import Array

STATE = 4
"""A vehicle's newest state: north, east in m, bias north, east in m/s."""

_LEARNED = 0.7  # of dead reckoning's sigma: beyond it less than half of the variance was taken away
_WORTH_M, _WORTH_MPS = 3.0, 0.02  # below it a quantity is known well enough for a survey


@dataclass(frozen=True, slots=True, kw_only=True)
class Quantity:
    """One sum or difference of the vehicles' states, and how well it is known."""

    name: str
    unit: str
    sigma: float
    reckoned_sigma: float  # by dead reckoning alone

    @property
    def is_undetermined(self) -> bool:
        """Whether measurements told little of it, and it matters."""
        worth = _WORTH_M if self.unit == "m" else _WORTH_MPS
        return self.sigma > worth and self.sigma > _LEARNED * self.reckoned_sigma

    def __str__(self) -> str:
        digits = 1 if self.unit == "m" else 3
        verdict = "undetermined" if self.is_undetermined else "determined"
        if not self.is_undetermined and self.sigma > _LEARNED * self.reckoned_sigma:
            verdict = "known by dead reckoning"
        return (
            f"{self.name}: {self.sigma:.{digits}f} {self.unit}, "
            f"{self.reckoned_sigma:.{digits}f} {self.unit} by dead reckoning alone: {verdict}"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Observability:
    """What is known of the vehicles together; learned holds the eigenvalues (4V), ascending.

    worst_m is the largest sigma of any direction of the joint positions, worst_like the quantity
    that this direction is most like.
    """

    time_s: float
    quantities: tuple[Quantity, ...]
    learned: tuple[float, ...]
    worst_m: float
    worst_like: str

    @property
    def blind(self) -> int:
        """In how many directions dead reckoning is all that is known."""
        return sum(value > _LEARNED**2 for value in self.learned)

    def lines(self) -> list[str]:
        """Return the findings as text."""
        return [
            *map(str, self.quantities),
            f"largest joint uncertainty: {self.worst_m:.1f} m, most like the {self.worst_like}",
            f"in {self.blind} of {len(self.learned)} directions of the newest states "
            "dead reckoning is all that is known",
        ]


def observe(
    time_s: float, names: Sequence[str], positions_m: Array, joint: Array, reckoned: Array
) -> Observability:
    """Return what is known of vehicles at positions (V, 2), from two covariances (4V, 4V).

    `joint` is that of their newest states (north, east, bias north, bias east of each in turn),
    `reckoned` the same without closures, ranges and fixes.
    """
    forms = _forms(names, positions_m)
    quantities = tuple(
        Quantity(
            name=name,
            unit=unit,
            sigma=float(np.sqrt(form @ joint @ form)),
            reckoned_sigma=float(np.sqrt(form @ reckoned @ form)),
        )
        for name, unit, form in forms
    )
    at = np.concatenate([STATE * k + np.arange(2) for k in range(len(names))])
    values, axes = np.linalg.eigh(joint[np.ix_(at, at)])
    likeness = {
        name: abs(form[at] @ axes[:, -1]) / np.linalg.norm(form)
        for name, unit, form in forms
        if unit == "m"
    }
    learned = eigh(joint, reckoned, eigvals_only=True)
    return Observability(
        time_s=time_s,
        quantities=quantities,
        learned=tuple(float(value) for value in np.clip(learned, 0.0, 1.0)),
        worst_m=float(np.sqrt(values[-1])),
        worst_like=max(likeness, key=lambda name: float(likeness[name])),
    )


def _forms(names: Sequence[str], positions_m: Array) -> list[tuple[str, str, Array]]:
    """Return name, unit and coefficients (4V,) of every quantity."""
    count = len(names)
    forms = []
    for axis, word in enumerate(("northward", "eastward")):
        for offset, unit, what in ((0, "m", "position"), (2, "m/s", "drift")):
            form = np.zeros(STATE * count)
            form[offset + axis :: STATE] = 1.0 / count
            whose = "common " if count > 1 else ""
            forms.append((f"{whose}{what}, {word}", unit, form))
    for k in range(1, count):
        apart_m = positions_m[k] - positions_m[0]
        along = apart_m / max(float(np.hypot(*apart_m)), 1e-9)
        across = np.array([-along[1], along[0]])
        for direction, what in ((along, "distance"), (across, "rotation about the range")):
            form = np.zeros(STATE * count)
            form[STATE * k : STATE * k + 2], form[:2] = direction, -direction
            forms.append((f"{what}, {names[0]} to {names[k]}", "m", form))
    return forms
