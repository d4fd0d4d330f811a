"""Which old sub-maps are still needed for matching: enough of them over every place."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from firmware.geometry import Array
from firmware.leader.atlas import FOOTPRINT_M, Sheet, SheetId
from protocol.settings import Settings, setting


@dataclass(frozen=True, slots=True, kw_only=True)
class CoverageSettings(Settings):
    """How many sub-maps a place needs."""

    layers: int = setting(
        6, "sub-maps", "over a place: two passes of each of two vehicles, nearly", minimum=1
    )
    needed_share: float = setting(
        0.3, "1", "of a sub-map's tiles that need another layer make it needed", minimum=0.01
    )


def redundant(
    sheets: Sequence[Sheet], corrections_m: Array, settings: CoverageSettings
) -> list[SheetId]:
    """Return the sub-maps, given oldest first, whose places older ones cover often enough.

    corrections_m (S, 2) move each from dead reckoning to its estimated place.
    """
    layers: Counter[tuple[int, int]] = Counter()
    found = []
    for sheet, correction_m in zip(sheets, corrections_m, strict=True):
        cells = np.floor((sheet.tiles_m + correction_m) / FOOTPRINT_M).astype(int)
        tiles = list(map(tuple, cells.tolist()))
        thin = sum(layers[tile] < settings.layers for tile in tiles)
        if thin >= settings.needed_share * len(tiles):
            layers.update(tiles)
        else:
            found.append(sheet.id)
    return found
