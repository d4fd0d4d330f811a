"""The C library's heap in a process that runs for days.

By default glibc learns from every large array that is freed to take the next one of its size, up
to 32 MB, from the heap; there it lies among small blocks that live, and what is free below them
never goes back to the system. A fixed threshold lets large arrays come and go as whole pages.
"""

import ctypes
import sys

_LARGE_BYTES = 1 << 20  # such arrays are few; smaller ones are worth reusing
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of glibc's <malloc.h>


def give_back_large_blocks() -> bool:
    """Tell the C library to return large blocks as soon as they are free; return whether it will.

    Call it before work begins. Elsewhere than on Linux, or on a C library without `mallopt`,
    nothing happens.
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    wanted = (_M_MMAP_THRESHOLD, _M_TRIM_THRESHOLD)
    return all(mallopt(option, _LARGE_BYTES) == 1 for option in wanted)
