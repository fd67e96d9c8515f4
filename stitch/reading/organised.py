"""Scans that are stored pixel by pixel: a pixel that measured nothing is NaN three times, and is no error."""

from pathlib import Path

import numpy as np

from stitch.frames import Array

# Headers of PCD and PLY are shorter.
_HEADER_BYTES = 65536


def grid_shape(path: Path) -> tuple[int, int] | None:
    """Rows and columns of pixels of a PCD, and of a PLY that says num_rows (as range scanners write it); else None."""
    with path.open("rb") as stream:
        head = stream.read(_HEADER_BYTES)
    size: dict[bytes, int] = {}
    for line in head.split(b"DATA" if path.suffix.lower() == ".pcd" else b"end_header", 1)[0].splitlines():
        words = line.split()
        if len(words) > 1 and words[-1].isdigit() and (words[0] in (b"WIDTH", b"HEIGHT") or words[0] == b"obj_info"):
            size[words[-2]] = int(words[-1])
    rows = size.get(b"HEIGHT", size.get(b"num_rows", 0))
    return (rows, size.get(b"WIDTH", size.get(b"num_cols", 0))) if rows > 1 else None


def measured_pixels(columns: dict[str, Array]) -> dict[str, Array]:
    """The columns (N,) without pixels of which x, y and z are NaN."""
    if not all(axis in columns for axis in "xyz"):
        return columns
    empty = np.isnan(np.asarray([columns[axis] for axis in "xyz"], float)).all(axis=0)
    return {name: column[~empty] for name, column in columns.items()} if empty.any() else columns
