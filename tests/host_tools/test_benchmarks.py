"""What the benchmarks make of what they ran."""

from math import nan

import numpy as np

from benchmarks.accuracy import ACTIVE, FALSE, FAR, table, total
from benchmarks.compression import OURS, frames_of
from benchmarks.matching import report
from firmware.leader.matches import Match, MatchOutcome


def test_closures_of_all_seeds_are_added_up() -> None:
    runs = [{ACTIVE: 900.0, FALSE: 1.0}, {ACTIVE: 350.0, FALSE: 0.0}]
    assert total(runs) == "1 false of 1,250 active closures over all 2 seeds"


def test_seeds_that_have_no_figure_are_told() -> None:
    runs = [{"tile shift, median": 2.0, FAR: 3.0}, {"tile shift, median": nan, FAR: 40.0}]
    _, shift, far = table(runs)
    assert shift.split()[-6:] == ["2.00", "m", "(1", "of", "2", "seeds)"]
    assert far.split()[-3:] == ["21.50", "40.00", "21.50"]


def test_losses_are_drawn_over_the_frames_that_travel() -> None:
    assert "lattice, 10 x 62 B" in OURS
    assert frames_of("lattice, 10 x 62 B", 620) == 10
    assert frames_of("lattice, 2 frames", 512) == 2
    assert frames_of("octree", 1000) == 10


def test_a_line_of_matches_says_that_errors_are_those_of_valid_closures() -> None:
    found = Match(
        shift_m=np.zeros(2),
        covariance_m2=np.eye(2),
        residual=0.0,
        misfit=1.0,
        overlap_cells=100,
        axis_deg=None,
        centre_m=np.zeros(2),
        reference_time_s=0.0,
        query_time_s=0.0,
    )
    results = [
        (MatchOutcome(match=found, reason=None), np.array([north_m, 0.0]), 0.01)
        for north_m in (2.0, 50.0)
    ]
    assert "found   2 valid   1, of these RMS  2.00 m NEES  4.00" in report("rough", results)
