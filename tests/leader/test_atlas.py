import numpy as np

from firmware.geometry import Array
from firmware.leader.atlas import FOOTPRINT_M, Sheet, SheetId, overlap_m2, sheet_of
from firmware.submaps import GriddedSubmap, Track


def ragged_sheet(rng: np.random.Generator, submap: int) -> Sheet:
    """Return a sheet of 80 by 120 m somewhere, with a third of its tiles unknown."""
    depth_m = np.where(rng.random((8, 12)) < 0.67, 40.0, np.nan)
    north_m, east_m = rng.uniform(-300.0, 300.0, 2)
    times_s = np.arange(40.0)
    sheet = sheet_of(
        SheetId(vehicle=0, boot_epoch=0, submap=submap),
        Track(time_s=times_s, north_m=times_s, east_m=0 * times_s, yaw_rad=0 * times_s),
        GriddedSubmap(
            north0_m=north_m,
            east0_m=east_m,
            cell_m=FOOTPRINT_M,
            depth_m=depth_m,
            variance_m2=np.full_like(depth_m, 0.01),
            time_s=np.full_like(depth_m, 20.0),
        ),
    )
    assert sheet is not None
    return sheet


def tiles_of(position_m: Array) -> set[tuple[int, ...]]:
    return {tuple(tile) for tile in np.floor(position_m / FOOTPRINT_M).astype(int).tolist()}


def test_overlap_is_the_area_of_the_tiles_in_common_wherever_a_sheet_is_moved() -> None:
    rng = np.random.default_rng(7)
    found, counted = [], []
    for pair in range(30):
        origin, target = (ragged_sheet(rng, 2 * pair + k) for k in range(2))
        apart_m = origin.centre_m - target.centre_m
        for reach_m in (20.0, 90.0, 140.0, 400.0):
            shifts_m = apart_m + rng.uniform(-reach_m, reach_m, (9, 2))
            found += overlap_m2(origin, target, shifts_m).tolist()
            counted += [
                FOOTPRINT_M**2 * len(tiles_of(origin.tiles_m) & tiles_of(target.tiles_m + shift_m))
                for shift_m in shifts_m
            ]
        lone_m = apart_m + rng.uniform(-140.0, 140.0, 2)
        found += overlap_m2(origin, target, lone_m[None]).tolist()
        common = tiles_of(origin.tiles_m) & tiles_of(target.tiles_m + lone_m)
        counted.append(FOOTPRINT_M**2 * len(common))
    assert found == counted
    assert 0 < np.count_nonzero(counted) < len(counted)
