"""Peak memory in MiB of binning and fitting so many soundings, above that after the imports.

python -m benchmarks.compression_memory 3000000 paper
"""

import gc
import sys

import numpy as np

from benchmarks.compression_windows import SPEED_MPS
from firmware.compression import compress
from firmware.compression.binning import SoundingBins

_PING = 192


def peak_kib() -> int:
    """Return the peak resident memory of this process in KiB."""
    with open("/proc/self/status", encoding="ascii") as status:
        return next(int(line.split()[1]) for line in status if line.startswith("VmHWM"))


def main(soundings: int, profile: str) -> None:
    """Feed a made survey ping by ping, fit it, and print the growth of the peak in MiB."""
    rng = np.random.default_rng(1)
    warm = SoundingBins()  # libraries load their buffers at first use
    warm.add(rng.normal(size=(4096, 3)) * 5.0 + np.array([0.0, 0.0, 40.0]), 0.0)
    warm.result()
    gc.collect()
    before = peak_kib()
    bins = SoundingBins()
    tangent = np.tan(np.deg2rad(np.linspace(-60.0, 60.0, _PING)))
    pings = soundings // _PING
    for ping in range(pings):
        time_s = 40.0 * ping / pings
        east_m = 40.0 * tangent
        north_m = np.full(_PING, SPEED_MPS * (time_s - 20.0))
        depth_m = 40.0 + np.sin(north_m / 6.0) + np.cos(east_m / 9.0)
        depth_m += 0.15 * rng.normal(size=_PING)
        bins.add(np.column_stack([north_m, east_m, depth_m]), time_s)
    compress(bins.result(), None, profile)
    print(f"{(peak_kib() - before) / 1024.0:.1f}")


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2])
