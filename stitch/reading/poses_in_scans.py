"""Poses that stand in the headers of scans: E57, Leica's PTX, PCD.

Robot cells that save such files write the flange's pose there; software that has registered the scans already writes
the scanner's own.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from stitch import frames
from stitch.frames import Array
from stitch.reading.extras import package

_HEAD = 4096
# PTX: sizes and four lines of the scanner's place stand above the matrix.
_PTX_MATRIX = slice(6, 10)


def poses_in_scans(files: list[Path]) -> Array | None:
    """Poses (N, 4, 4) of scans of one format in the files' own unit; None where one has none, or all are the same.

    Raises:
        InputError: the package that reads such files is not installed.
    """
    readers = {".e57": _e57, ".ptx": _ptx, ".pcd": _pcd}
    kinds = {file.suffix.lower() for file in files}
    if len(kinds) != 1 or not kinds <= readers.keys():
        return None
    read = readers[kinds.pop()]
    found = []
    for file in files:
        try:
            T = read(file)
        except (ValueError, IndexError, OSError):
            return None
        if T is None or not frames.is_rigid(T):
            return None
        found.append(T)
    poses = np.stack(found)
    return None if np.allclose(poses, poses[0]) else poses


def _e57(file: Path) -> Array | None:
    # A header is good for as long as its file is open.
    opened = package("pye57", file, "formats").E57(str(file))
    header = opened.get_header(0)
    return frames.make(header.rotation_matrix, header.translation) if header.has_pose() else None


def _ptx(file: Path) -> Array:
    """Four lines of a matrix for rows of points: the translation stands in the last of them."""
    with file.open(encoding="ascii", errors="replace") as stream:
        lines = [line.split() for _, line in zip(range(_PTX_MATRIX.stop), stream, strict=False)]
    T = np.array(lines[_PTX_MATRIX], float).T
    # Seven digits of a rotation are not quite one.
    return frames.make(Rotation.from_matrix(T[:3, :3]).as_matrix(), T[:3, 3])


def _pcd(file: Path) -> Array | None:
    with file.open("rb") as stream:
        words = [line.split() for line in stream.read(_HEAD).split(b"\n")]
    told = next((line[1:] for line in words if line[:1] == [b"VIEWPOINT"]), None)
    if told is None or len(told) != 7:
        return None
    x, y, z, w, *axis = (float(word) for word in told)
    return frames.make(Rotation.from_quat([*axis, w]).as_matrix(), np.array([x, y, z]))
