"""What ranges alone tell of two vehicles: how far off their relative position is, and how sure.

    python -m benchmarks.ranging [--pairs 60]

sails the pairs of `tests/leader/test_mirrored_tracks.py`: ten minutes of dead reckoning that
drifts, a range every four seconds, one in five stretched, and no closure.
"""

import argparse

import numpy as np

from tests.leader.test_mirrored_tracks import Pair

_TIMES_S = (300, 450, 600)
_CHI_SQUARE_999 = 13.8  # of two degrees of freedom


def main() -> None:
    """Print a line for each time."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.ranging", description=__doc__)
    parser.add_argument("--pairs", type=int, default=60)
    pairs = [Pair(seed) for seed in range(parser.parse_args().pairs)]
    print("  time  error: median    mean   worst  chi square of 2: median    mean  over 13.8")
    for time_s in _TIMES_S:
        errors_m = np.array([pair.error_m(time_s) for pair in pairs])
        squares = np.array([pair.chi_square(time_s) for pair in pairs])
        print(
            f"{time_s:4d} s {np.median(errors_m):12.1f} m {errors_m.mean():5.1f} m "
            f"{errors_m.max():5.1f} m {np.median(squares):24.2f} {squares.mean():7.2f} "
            f"{np.count_nonzero(squares > _CHI_SQUARE_999):10d}"
        )


if __name__ == "__main__":
    main()
