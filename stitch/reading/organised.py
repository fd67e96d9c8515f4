"""Scans that are stored pixel by pixel: a pixel that measured nothing is NaN three times, and is no error."""

from pathlib import Path

import numpy as np

from stitch.frames import Array

# Headers of PCD and PLY are shorter.
_HEADER_BYTES = 65536


def is_organised(path: Path) -> bool:
    """True for a PCD with rows of pixels, and for a PLY that says num_rows (as range scanners write it)."""
    with path.open("rb") as stream:
        head = stream.read(_HEADER_BYTES)
    for line in head.split(b"DATA" if path.suffix.lower() == ".pcd" else b"end_header", 1)[0].splitlines():
        words = line.split()
        grid = words[:1] == [b"HEIGHT"] or words[:2] == [b"obj_info", b"num_rows"]
        if grid and words[-1].isdigit() and int(words[-1]) > 1:
            return True
    return False


def measured(columns: dict[str, Array]) -> dict[str, Array]:
    """The columns without pixels of which x, y and z are NaN."""
    if not all(axis in columns for axis in "xyz"):
        return columns
    empty = np.isnan(np.asarray([columns[axis] for axis in "xyz"], float)).all(axis=0)
    return {name: column[~empty] for name, column in columns.items()} if empty.any() else columns
