"""Poses that stand in the headers of scans (E57, Leica's PTX, PCD), and the times that stand in those of E57.

Robot cells that save such files write the flange's pose there; software that has registered the scans already writes
the scanner's own.
"""

from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.session.reading.announced_points import require_e57_room
from stitch.system.packages import import_extra

_HEAD = 4096
# From here E57 counts seconds (ASTM E2807).
_GPS_EPOCH = datetime(1980, 1, 6)
_LATEST_S = 1e10
# PTX: sizes and four lines of the scanner's place stand above the matrix.
_PTX_MATRIX = slice(6, 10)


def poses_in_scans(files: list[Path]) -> Array | None:
    """Return the poses (N, 4, 4) in the headers of N scans of one format, lengths in the files' unit.

    They map scanner coordinates to the frame of the software that wrote them. None for files of several formats or
    another one, where a file has no pose that is a rigid motion, and where all poses are the same.

    Raises:
        InputError: the package that reads such files is not installed.
    """
    readers = {".e57": _e57, ".ptx": _ptx, ".pcd": _pcd}
    kinds = {file.suffix.lower() for file in files}
    if len(kinds) != 1 or not kinds <= readers.keys():
        return None
    read = readers[kinds.pop()]
    headers = []
    for file in files:
        try:
            T = read(file)
        except (ValueError, IndexError, OSError):
            return None
        if T is None or not frames.is_rigid(T):
            return None
        headers.append(T)
    poses = np.stack(headers)
    return None if np.allclose(poses, poses[0]) else poses


def _e57(file: Path) -> Array | None:
    """Return the pose (4, 4) of the first scan of an E57, m; None where it has none."""
    require_e57_room(file)
    # A header is good for as long as its file is open.
    opened = import_extra("pye57", file, "formats").E57(str(file))
    header = opened.get_header(0)
    return frames.make(header.rotation_matrix, header.translation) if header.has_pose() else None


def _ptx(file: Path) -> Array:
    """Return the pose (4, 4) of a PTX, in its unit.

    The file holds the transposed matrix, for row vectors: the translation is its last line.
    """
    with file.open(encoding="ascii", errors="replace") as stream:
        lines = [line.split() for _, line in zip(range(_PTX_MATRIX.stop), stream, strict=False)]
    T = np.array(lines[_PTX_MATRIX], float).T
    # Seven digits of a rotation are not quite one.
    return frames.make(frames.rotations(T[:3, :3]).as_matrix()[0], T[:3, 3])


def _pcd(file: Path) -> Array | None:
    """Return the viewpoint (4, 4) of a PCD, in its unit; None where it has none."""
    with file.open("rb") as stream:
        words = [line.split() for line in stream.read(_HEAD).split(b"\n")]
    viewpoint = next((line[1:] for line in words if line[:1] == [b"VIEWPOINT"]), None)
    if viewpoint is None or len(viewpoint) != 7:
        return None
    x, y, z, w, *axis = (float(word) for word in viewpoint)
    return frames.from_quaternion(np.array([x, y, z]), np.array([*axis, w]))


def times_in_scans(files: list[Path]) -> list[str] | None:
    """Return the time at which each scan began, as 2026-12-31T23:59:59.250000, from the headers of E57 files.

    None for other formats, and where one of the files states no time.

    Raises:
        InputError: the package that reads such files is not installed.
    """
    if {file.suffix.lower() for file in files} != {".e57"}:
        return None
    seconds = [_e57_seconds(file) for file in files]
    if not all(0 < s < _LATEST_S for s in seconds):
        return None
    return [(_GPS_EPOCH + timedelta(seconds=s)).isoformat(timespec="microseconds") for s in seconds]


def _e57_seconds(file: Path) -> float:
    """Return the time of the first scan of an E57, s since `_GPS_EPOCH`; 0 where the header has none."""
    require_e57_room(file)
    opened = import_extra("pye57", file, "formats").E57(str(file))
    try:
        return float(opened.get_header(0).acquisitionStart_dateTimeValue)
    except Exception:  # of libe57's own kinds: the standard lets the entry out
        return 0.0
