"""What the benchmarks make of what they ran."""

from math import nan

from benchmarks.accuracy import ACTIVE, FALSE, FAR, table, total
from benchmarks.compression import OURS, frames_of


def test_closures_of_all_seeds_are_added_up() -> None:
    runs = [{ACTIVE: 900.0, FALSE: 1.0}, {ACTIVE: 350.0, FALSE: 0.0}]
    assert total(runs) == "1 false of 1,250 active closures over all 2 seeds"


def test_seeds_that_have_no_figure_are_told() -> None:
    runs = [{"tile shift, median": 2.0, FAR: 3.0}, {"tile shift, median": nan, FAR: 40.0}]
    _, shift, far = table(runs)
    assert shift.split()[-6:] == ["2.00", "m", "(1", "of", "2", "seeds)"]
    assert far.split()[-2:] == ["21.50", "40.00"]


def test_losses_are_drawn_over_the_frames_that_travel() -> None:
    assert "lattice, 10 x 62 B" in OURS
    assert frames_of("lattice, 10 x 62 B", 620) == 10
    assert frames_of("lattice, 2 frames", 512) == 2
    assert frames_of("octree", 1000) == 10
