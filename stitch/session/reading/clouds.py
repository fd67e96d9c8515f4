"""One scan of any kind of file as a `Cloud`: every scalar kept, what stands for nothing measured left out."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from stitch.errors import InputError, NothingMeasuredError
from stitch.numerics.frames import Array
from stitch.session.reading.depth_image import DEPTH_SUFFIXES, read_depth_columns
from stitch.session.reading.pcd_file import read_pcd
from stitch.session.reading.scan_files import (
    MESHES,
    TEXTS,
    grid_shape,
    measured_pixels,
    read_array,
    read_e57,
    read_las,
    read_left_handed,
    read_mesh,
    read_ply,
    read_ptx,
    read_records,
    read_text_columns,
    read_zdf,
)
from stitch.session.reading.text_files import readable, reason_of, require_file
from stitch.session.session import Cloud

# What reads a kind, by the ending of the file's name.
_READERS: dict[str, Callable[[Path], dict[str, Array]]] = {
    ".ply": read_ply,
    ".pcd": read_pcd,
    **dict.fromkeys(TEXTS, read_text_columns),
    **dict.fromkeys(MESHES, read_mesh),
    ".npy": read_array,
    ".ptx": read_ptx,
    ".e57": read_e57,
    ".las": read_las,
    ".laz": read_las,
    ".zdf": read_zdf,
    ".3d": read_left_handed,
    ".bin": read_records,
    **dict.fromkeys(DEPTH_SUFFIXES, read_depth_columns),
}
CLOUD_SUFFIXES = tuple(_READERS)
_NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))
# A code for "nothing measured" stands so often, and lies so far from the others, in their own extents.
_CODE_TIMES = 3
_CODE_AWAY = 2.0
# So many of the others are looked at; they have so many different numbers, and are this share of the points.
_CODE_SAMPLE = 4000
_CODE_VALUES = 20
_CODE_REST = 0.02


@readable()
def read_cloud(path: Path, scale: float = 1.0) -> Cloud:
    """Return the scan of a file, of any known format; points at 0 0 0, which measured nothing, are left out.

    Args:
        path: its ending says the format.
        scale: factor from the file's unit to the session's length_unit.

    Raises:
        InputError: missing or broken file, no x, y, z, no points, or points that are not finite.
    """
    if not path.exists():
        raise InputError(f"{path}: no such cloud file; correct the column cloud of views.csv")
    require_file(path, "name a file in the column cloud of views.csv")
    kind = path.suffix.lower()
    reader = _READERS.get(kind)
    if reader is None:
        raise InputError(f"{path}: unknown cloud format {path.suffix!r}; use {', '.join(CLOUD_SUFFIXES)}")
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
    """Return a cloud from its columns, name -> (N,): x, y, z, normals if there are three, all others as scalars.

    Points at 0 0 0 are left out, and those with a code for "nothing measured" (`_without_codes`).

    Args:
        where: file, or name of the scan, for messages.
        columns: entries that are used are removed from it, so that large scans are not held twice.
        scale: factor from the unit of the columns to the session's length_unit.

    Raises:
        InputError: no x, y, z, no points, or points that are not finite.
    """
    missing = [axis for axis in "xyz" if axis not in columns]
    if missing:
        raise InputError(f"{where}: no column {', '.join(missing)}; a cloud needs x, y, z")
    count = len(columns["x"])
    columns, codes = _without_codes(columns)
    coded = count - len(columns["x"])
    points = np.column_stack([columns.pop(axis) for axis in "xyz"]).astype(np.float64, copy=False)
    if not len(points):
        raise NothingMeasuredError(f"{where}: no points; leave this view out of views.csv or scan it again")
    if not np.isfinite(points).all():
        bad = int((~np.isfinite(points).all(axis=1)).sum())
        raise InputError(f"{where}: {bad} of {len(points)} points are NaN or infinite; remove them from the file")
    # Structured exports write 0 0 0 for a pixel that measured nothing; no point is measured at the scanner's origin.
    x, y, z = points.T
    measured = (x != 0) | (y != 0) | (z != 0)
    if not measured.any():
        raise NothingMeasuredError(
            f"{where}: all {len(points)} points are 0 0 0, nothing was measured; leave this view out of views.csv or "
            "scan it again"
        )
    normals = None
    for names in _NORMALS:
        if all(name in columns for name in names):
            normals = np.column_stack([columns.pop(name) for name in names]).astype(np.float64)[measured]
    scalars = {name: np.asarray(column, np.float64)[measured] for name, column in columns.items() if column.ndim == 1}
    points = points if measured.all() else points[measured]
    return Cloud(points if scale == 1.0 else points * scale, normals, scalars, codes=codes, coded=coded)


def _without_codes(columns: dict[str, Array]) -> tuple[dict[str, Array], tuple[float, ...]]:
    """Return the columns without points that hold a code for "nothing measured", as z = −32.768, and the codes, sorted.

    A code is the least or the largest value of a coordinate, equal to the last digit in several points, and far outside
    the range of the others. Columns of another length stay as they are.
    """
    coded = np.zeros(len(columns["x"]), bool)
    codes = set[float]()
    for axis in "zxy":
        values = np.asarray(columns[axis])
        while (code := _find_code(values[~coded] if coded.any() else values)) is not None:
            coded |= values == code
            codes.add(code)
    if coded.any():
        for name in list(columns):
            columns[name] = columns[name][~coded] if len(columns[name]) == len(coded) else columns[name]
    return columns, tuple(sorted(codes))


def _find_code(values: Array) -> float | None:
    """Return the value among coordinates (N,) that is a code for "nothing measured"; None if there is none.

    The least or the largest value, in at least `_CODE_TIMES` points, `_CODE_AWAY` ranges away from the others. These
    must be `_CODE_REST` of all, with `_CODE_VALUES` different values in a sample, so that they have a range at all.
    """
    for extreme in (np.fmin.reduce(values), np.fmax.reduce(values)) if len(values) else ():
        # Whole scans are looked at, and hardly any has a code: first what costs least.
        if not np.isfinite(extreme) or np.count_nonzero(values == extreme) < _CODE_TIMES:
            continue
        rest = values[(values != extreme) & np.isfinite(values)]
        if len(rest) < _CODE_REST * len(values):
            continue
        sample = rest[:: -(-len(rest) // _CODE_SAMPLE)]
        low, high = np.percentile(sample, (1, 99))
        away = max(low - extreme, extreme - high)
        if away > _CODE_AWAY * (high - low) > 0 and len(np.unique(sample)) >= _CODE_VALUES:
            return float(extreme)
    return None
