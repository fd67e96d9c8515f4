"""Memory of large arrays, given back when they are freed."""

import ctypes
import sys
from functools import cache

# As mallopt(3) of glibc numbers them; allocations from the first on are mappings of their own, and what is free at the
# top of a heap beyond the second goes back.
_MMAP_THRESHOLD, _TRIM_THRESHOLD = -3, -1
_LARGE, _TOP = 2_000_000, 20_000_000


@cache
def return_large_arrays() -> None:
    """Have the system take arrays of 2 MB and more back as they are freed; nothing where there is no glibc.

    Else glibc raises that limit to 32 MB by itself, and columns of thousands of poses stay in the heap of every thread,
    a third more memory than is in use. It costs a fresh mapping for each, which in small sessions is not worth it.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(_MMAP_THRESHOLD, _LARGE)
        mallopt(_TRIM_THRESHOLD, _TOP)
