"""Arrays too large for memory, in files without a name that go with the process."""

import mmap
import tempfile
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stitch.errors import InputError


def map_parts(parts: Iterable[Mapping[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """Parts of the same named columns one after the other, each column mapped from a file of its own.

    Raises:
        InputError: no room in the folder for temporary files.
    """
    files: dict[str, Any] = {}
    layout: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {}
    rows = 0
    for part in parts:
        for name, values in part.items():
            if name not in files:
                files[name] = tempfile.TemporaryFile()  # noqa: SIM115  # the map holds it
            layout[name] = values.dtype, values.shape[1:]
            try:
                np.ascontiguousarray(values).tofile(files[name])
            except OSError:
                raise InputError(
                    f"{tempfile.gettempdir()}: no room for what does not fit in memory; to fix: make room, or name "
                    "another folder in the environment variable TMPDIR"
                ) from None
        rows += len(next(iter(part.values())))
    return {name: np.memmap(files[name], kind, "r", shape=(rows, *rest)) for name, (kind, rest) in layout.items()}


def release_mapped(array: NDArray[Any]) -> None:
    """Give back the memory of a mapped array that was looked at; it comes again from its file. Others stay."""
    held = getattr(array, "_mmap", None)
    if isinstance(array, np.memmap) and held is not None and hasattr(mmap, "MADV_DONTNEED"):
        held.madvise(mmap.MADV_DONTNEED)
