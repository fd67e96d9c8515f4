"""Two paths exchange their places in one step that nothing can interrupt."""

import ctypes
import os
import sys
from pathlib import Path

_AT_FDCWD = -100  # AT_FDCWD of Linux
_RENAME_EXCHANGE = 2  # RENAME_EXCHANGE of Linux, RENAME_SWAP of macOS


def exchange_paths(first: Path, second: Path) -> bool:
    """Exchange two existing paths of one file system; False where the system or the file system cannot.

    Source: renameat2(2) of Linux, renamex_np(2) of macOS.
    """
    a, b = os.fsencode(first), os.fsencode(second)
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        if sys.platform == "darwin":
            return bool(libc.renamex_np(a, b, ctypes.c_uint(_RENAME_EXCHANGE)) == 0)
        return bool(libc.renameat2(_AT_FDCWD, a, _AT_FDCWD, b, ctypes.c_uint(_RENAME_EXCHANGE)) == 0)
    except (AttributeError, OSError, TypeError):
        return False
