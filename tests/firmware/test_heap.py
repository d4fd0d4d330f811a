"""A process that was told so gives large arrays back, whatever small block lies above them."""

import subprocess
import sys

import pytest

_HOLES = """
import resource, sys
from pathlib import Path
import numpy as np
from firmware.heap import give_back_large_blocks

if sys.argv[1] == "told":
    assert give_back_large_blocks()
np.ones(1 << 20)  # 8 MB: freed, it teaches the C library to keep arrays of its size in the heap
arrays, blocks = [], []
for _ in range(20):
    arrays.append(np.ones(1 << 20))
    blocks.append(bytearray(100_000))
arrays.clear()
pages = int(Path("/proc/self/statm").read_text().split()[1])
print(pages * resource.getpagesize() / 1e6)
"""


def _resident_mb(told: str) -> float:
    command = [sys.executable, "-c", _HOLES, told]
    return float(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc's heap")
def test_large_arrays_go_back_from_below_small_blocks() -> None:
    assert _resident_mb("told") < _resident_mb("untold") - 100.0
