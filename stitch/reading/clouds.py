"""Point clouds from PLY, PCD, XYZ and CSV files, every scalar kept; other formats in `more_clouds.py`."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stitch.errors import InputError
from stitch.frames import Array
from stitch.measurement.cloud import Cloud
from stitch.reading.csv_number import is_number
from stitch.reading.depth_image import DEPTH_SUFFIXES, read_depth_columns
from stitch.reading.more_clouds import MESHES, read_array, read_e57, read_las, read_mesh, read_ptx
from stitch.reading.organised import grid_shape, measured_pixels
from stitch.reading.pcd import read_pcd
from stitch.reading.rights import readable
from stitch.reading.text_file import reason_of, require_file
from stitch.reading.zdf import read_zdf

_NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))
_TEXT_SUFFIXES = (".xyz", ".csv", ".txt", ".asc")
# Kinds that are read, by the ending of the file's name.
CLOUD_SUFFIXES = (
    ".ply",
    ".pcd",
    *_TEXT_SUFFIXES,
    *MESHES,
    ".npy",
    ".ptx",
    ".e57",
    ".las",
    ".laz",
    ".zdf",
    *DEPTH_SUFFIXES,
)


@readable()
def read_cloud(path: Path, scale: float = 1.0) -> Cloud:
    """Read one scan; `scale` turns the file's unit into the session's. Points at 0 0 0 are left out.

    Raises:
        InputError: missing or broken file, no x, y, z, no points, or points that are not finite.
    """
    if not path.exists():
        raise InputError(f"{path}: no such cloud file; correct the column cloud of views.csv")
    require_file(path, "name a file in the column cloud of views.csv")
    readers: dict[str, Callable[[Path], dict[str, Array]]] = {".ply": read_ply, ".pcd": read_pcd}
    readers |= dict.fromkeys(_TEXT_SUFFIXES, _read_text) | dict.fromkeys(MESHES, read_mesh)
    readers |= {
        ".npy": read_array,
        ".ptx": read_ptx,
        ".e57": read_e57,
        ".las": read_las,
        ".laz": read_las,
        ".zdf": read_zdf,
    }
    readers |= dict.fromkeys(DEPTH_SUFFIXES, read_depth_columns)
    kind = path.suffix.lower()
    reader = readers.get(kind)
    if reader is None:
        raise InputError(f"{path}: unknown cloud format {path.suffix!r}; use PLY, PCD, XYZ or CSV")
    if not path.stat().st_size:
        raise InputError(f"{path}: the file is empty; export it again, or leave this view out of views.csv")
    try:
        columns = reader(path)
        if kind in (".ply", ".pcd") and grid_shape(path):
            columns = measured_pixels(columns)
    except InputError:
        raise
    except Exception as error:  # whatever a library raises at bytes that are no cloud
        raise InputError(f"{path}: cannot be read ({reason_of(error)}); export it again") from None
    return cloud_of_columns(path, columns, scale)


def cloud_of_columns(where: Path | str, columns: dict[str, Array], scale: float = 1.0) -> Cloud:
    """Return a cloud from its columns (N,) by name: x, y, z, normals, and any scalar; points at 0 0 0 are left out.

    Args:
        where: file, or name of the scan, for messages.
        columns: is emptied of what is taken, so that large scans are not held twice.
        scale: turns the unit of the columns into the session's.

    Raises:
        InputError: no x, y, z, no points, or points that are not finite.
    """
    missing = [axis for axis in "xyz" if axis not in columns]
    if missing:
        raise InputError(f"{where}: no column {', '.join(missing)}; a cloud needs x, y, z")
    points = np.column_stack([columns.pop(axis) for axis in "xyz"]).astype(np.float64, copy=False)
    if not len(points):
        raise InputError(f"{where}: no points; leave this view out of views.csv or scan it again")
    if not np.isfinite(points).all():
        bad = int((~np.isfinite(points).all(axis=1)).sum())
        raise InputError(f"{where}: {bad} of {len(points)} points are NaN or infinite; remove them from the file")
    # Structured exports write 0 0 0 for a pixel that measured nothing; the scanner's own place has no ray.
    x, y, z = points.T
    seen = (x != 0) | (y != 0) | (z != 0)
    if not seen.any():
        raise InputError(
            f"{where}: all {len(points)} points are 0 0 0, nothing was measured; leave this view out of views.csv or "
            "scan it again"
        )
    normals = None
    for names in _NORMALS:
        if all(name in columns for name in names):
            normals = np.column_stack([columns.pop(name) for name in names]).astype(np.float64)[seen]
    scalars = {name: np.asarray(column, np.float64)[seen] for name, column in columns.items() if column.ndim == 1}
    points = points if seen.all() else points[seen]
    return Cloud(points if scale == 1.0 else points * scale, normals, scalars)


def read_ply(path: Path) -> dict[str, Array]:
    """Columns (N,) of the vertices of a PLY by name, as stored."""
    from plyfile import PlyData

    require_room(path)
    with path.open("rb") as stream:
        if stream.read(3) != b"ply":
            raise InputError(f"{path}: is not a PLY file; export it again, or name it by its kind")
    data: NDArray[np.void] = PlyData.read(path)["vertex"].data
    # List properties have no column of numbers.
    return {name: data[name] for name in data.dtype.names or () if not data.dtype[name].hasobject}


def require_room(path: Path) -> None:
    """Refuse a PLY whose header announces more elements than the file has bytes, before room is made for them.

    Raises:
        InputError: no such file, or the header promises too much.
    """
    require_file(path, "name a PLY file")
    size = path.stat().st_size
    with path.open("rb") as stream:
        header = stream.read(65536).split(b"end_header", 1)[0]
    for line in header.splitlines():
        words = line.split()
        if len(words) == 3 and words[0] == b"element" and words[2].isdigit() and int(words[2]) > size:
            raise InputError(f"{path}: {words[2].decode()} elements announced in {size} bytes; export it again")


def _read_text(path: Path) -> dict[str, Array]:
    """Numbers in columns, by comma, semicolon, space or tab; a header line names them, else x y z …

    The header may be a comment, as numpy writes it: the last line before the numbers, if it names x, y and z.
    """
    told = [line for line in path.read_text(encoding="utf-8-sig").splitlines() if line.strip()]
    lines = [line for line in told if not _is_comment(line)]
    if not lines:
        return {axis: np.empty(0) for axis in "xyz"}
    separator = next((s for s in ",;" if s in lines[0]), None)
    first = _column_names(lines[0], separator)
    header = any(not is_number(cell) for cell in first)
    above = told[: told.index(lines[0])]
    names = first if header or not above else _column_names(above[-1].lstrip(" #"), separator)
    if not header and not (len(names) == len(first) and {*"xyz"} <= {*names}):
        names = ["x", "y", "z", *(f"scalar_{i}" for i in range(len(first) - 3))][: len(first)]
    if len(lines) == header:
        return {name: np.empty(0) for name in names}
    table = np.loadtxt(lines[header:], delimiter=separator, ndmin=2).reshape(-1, len(names))
    return dict(zip(names, table.T, strict=True))


def _is_comment(line: str) -> bool:
    return line.lstrip()[0] == "#"


def _column_names(line: str, separator: str | None) -> list[str]:
    cells = [cell.strip() for cell in line.split(separator)]
    return [cell.lower() if cell.lower() in "xyz" else cell for cell in cells]
