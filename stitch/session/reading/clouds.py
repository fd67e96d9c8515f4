"""Point clouds from PLY, PCD, XYZ and CSV files, every scalar kept; meshes, arrays and other formats after them."""

import io
import re
import struct
from collections.abc import Callable
from pathlib import Path

import lzf
import numpy as np
from numpy.typing import NDArray

from stitch.errors import InputError
from stitch.numerics.frames import Array
from stitch.session.reading.csv_files import is_number
from stitch.session.reading.depth_image import DEPTH_SUFFIXES, is_depth_image, read_depth_columns
from stitch.session.reading.text_files import import_extra, readable, reason_of, require_file
from stitch.session.session import Cloud

# Scans that are stored pixel by pixel: a pixel that measured nothing is NaN three times, and is no error.

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


# Scans in formats of other trades: meshes (STL, OBJ, OFF, glTF), NumPy arrays, PTX, and E57 and LAS by their packages.
#
# A mesh counts by its vertices, with the normals of its faces. A file with several scans is refused; points stay in the
# scanner's own frame.

MESHES = (".stl", ".obj", ".off", ".glb", ".gltf")
_PTX_HEADER = 10


def read_mesh(path: Path) -> dict[str, Array]:
    """Columns (N,) of the vertices, each once, with the mean normal of the faces around them where there are faces."""
    import trimesh

    scene = trimesh.load_scene(str(path))
    pieces = [g for g in scene.dump() if hasattr(g, "vertices") and len(g.vertices)]
    if not pieces:
        raise InputError(f"{path}: holds no surface; export the scan again")
    points, normals = [], []
    for piece in pieces:
        if getattr(piece, "faces", None) is not None and len(piece.faces):
            piece.merge_vertices(merge_norm=True, merge_tex=True)
            normals.append(np.asarray(piece.vertex_normals))
        points.append(np.asarray(piece.vertices))
    columns = dict(zip("xyz", np.vstack(points).T, strict=True))
    if len(normals) == len(points):
        columns |= dict(zip(("nx", "ny", "nz"), np.vstack(normals).T, strict=True))
    return columns


def read_array(path: Path) -> dict[str, Array]:
    """NumPy's .npy: (N, 3) or more columns, an image (H, W, 3) whose empty pixels are NaN, or a depth image (H, W)."""
    if is_depth_image(path):
        return read_depth_columns(path)
    array = np.load(path, allow_pickle=False)
    if array.dtype.kind not in "fiu" or array.ndim not in (2, 3) or array.shape[-1] < 3:
        raise InputError(f"{path}: an array {array.shape} is no cloud; save (N, 3) or (H, W, 3) numbers")
    table = array.reshape(-1, array.shape[-1])
    names = [*"xyz", *(f"scalar_{i}" for i in range(table.shape[1] - 3))]
    columns = dict(zip(names, table.T, strict=True))
    return measured_pixels(columns) if array.ndim == 3 else columns


def read_ptx(path: Path) -> dict[str, Array]:
    """Columns (N,) of Leica's PTX.

    The file has columns, rows, ten lines of frames, then x y z intensity; 0 0 0 where nothing was measured.
    """
    scans = ptx_scans(path)
    if len(scans) != 1:
        raise InputError(_several_scans_message(path, f"{len(scans)} scans"))
    rows = scans[0][_PTX_HEADER:]
    count = int(scans[0][0]) * int(scans[0][1])
    if len(rows) < count:
        raise InputError(f"{path}: {count} points announced, data for {len(rows)}; export it again")
    return dict(zip([*"xyz", "intensity"], np.loadtxt(rows, ndmin=2).T, strict=False))


def ptx_scans(path: Path) -> list[list[str]]:
    """Return the lines of each scan of a PTX file; columns and rows in the first two tell how many."""
    lines = [line for line in path.read_text(encoding="ascii", errors="replace").splitlines() if line.strip()]
    scans = []
    while lines:
        end = _PTX_HEADER + int(lines[0]) * int(lines[1])
        scans.append(lines[:end])
        lines = lines[end:]
    return scans


def read_las(path: Path) -> dict[str, Array]:
    """Columns (N,) x, y, z and intensity of LAS and LAZ, by laspy."""
    las = import_extra("laspy", path, "formats").read(path)
    xyz = np.asarray(las.xyz, float)
    return {**dict(zip("xyz", xyz.T, strict=True)), "intensity": np.asarray(las.intensity, float)}


def read_e57(path: Path) -> dict[str, Array]:
    """Columns (N,) of the one scan of an E57 in its own frame, by pye57."""
    file = import_extra("pye57", path, "formats").E57(str(path))
    if file.scan_count != 1:
        raise InputError(_several_scans_message(path, f"{file.scan_count} scans"))
    scan = file.read_scan(0, ignore_missing_fields=True, transform=False)
    columns = {axis: np.asarray(scan[f"cartesian{axis.upper()}"], float) for axis in "xyz"}
    if "intensity" in scan:
        columns["intensity"] = np.asarray(scan["intensity"], float)
    return measured_pixels(columns)


def _several_scans_message(path: Path, held: str) -> str:
    return f"{path}: holds {held}, a file is one view; to fix: export every scan to a file of its own"


# PCD files: ascii, binary and binary_compressed, padding fields and counts too.
#
# Format: https://pointclouds.org/documentation/tutorials/pcd_file_format.html

_KINDS = {"F": "f", "U": "u", "I": "i"}


def read_pcd(path: Path) -> dict[str, Array]:
    """Columns by field name, (N,) each; padding ("_") and fields with a count above 1 are skipped.

    Raises:
        InputError: header or data do not fit together.
    """
    raw = path.read_bytes()
    header, encoding, start = _header(path, raw)
    layout, count = _binary_layout(path, header)
    body = raw[start:]
    if encoding == "ascii":
        return _ascii(path, body, header, count)
    if encoding == "binary":
        need = layout.itemsize * count
        if len(body) < need:
            raise InputError(
                f"{path}: {count} points announced, data for {len(body) // layout.itemsize}; export it again"
            )
        table = np.frombuffer(body, layout, count)
        return {name: table[str(i)] for name, i in _scalar_fields(header).items()}
    if encoding == "binary_compressed":
        return _compressed(path, body, header, layout, count)
    raise InputError(f"{path}: PCD DATA {encoding!r} is unknown; use ascii, binary or binary_compressed")


def _header(path: Path, raw: bytes) -> tuple[dict[str, list[str]], str, int]:
    header: dict[str, list[str]] = {}
    start = 0
    while True:
        end = raw.find(b"\n", start)
        if end < 0 or start > 65536:
            raise InputError(f"{path}: no DATA line; this is not a PCD file")
        words = raw[start:end].decode("ascii", "replace").split()
        start = end + 1
        if len(words) > 1 and words[0] == "DATA":
            return header, words[1], start
        if words and not words[0].startswith("#"):
            header[words[0]] = words[1:]


def _binary_layout(path: Path, header: dict[str, list[str]]) -> tuple[np.dtype[np.void], int]:
    try:
        fields = header["FIELDS"]
        counts = [int(c) for c in header.get("COUNT", ["1"] * len(fields))]
        kinds = [_KINDS[t] + s for t, s in zip(header["TYPE"], header["SIZE"], strict=True)]
        count = int(header["POINTS"][0]) if "POINTS" in header else int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
        if count < 0 or min(counts) < 1:
            raise ValueError("a negative number of points or values")
        columns = zip(kinds, counts, strict=True)
        return np.dtype([(f"{i}", "<" + k, (c,) if c > 1 else ()) for i, (k, c) in enumerate(columns)]), count
    except (KeyError, ValueError, IndexError) as error:
        raise InputError(
            f"{path}: PCD header is incomplete ({error}); it needs FIELDS, SIZE, TYPE and POINTS"
        ) from None


def _counts(header: dict[str, list[str]]) -> list[int]:
    return [int(c) for c in header.get("COUNT", ["1"] * len(header["FIELDS"]))]


def _scalar_fields(header: dict[str, list[str]]) -> dict[str, int]:
    """Field name -> position in FIELDS, without padding and vectors."""
    fields = zip(header["FIELDS"], _counts(header), strict=True)
    return {name: i for i, (name, count) in enumerate(fields) if count == 1 and name != "_"}


def _ascii(path: Path, body: bytes, header: dict[str, list[str]], count: int) -> dict[str, Array]:
    counts = _counts(header)
    rows = min(count, body.count(b"\n") + 1)
    if not body.strip():
        raise InputError(f"{path}: no points; leave this view out of views.csv or scan it again")
    table = np.loadtxt(io.BytesIO(body), ndmin=2, max_rows=rows).reshape(-1, sum(counts))
    if len(table) < count:
        raise InputError(f"{path}: {count} points announced, data for {len(table)}; export it again")
    first = np.concatenate([[0], np.cumsum(counts)])
    return {name: table[:, first[i]] for name, i in _scalar_fields(header).items()}


def _compressed(
    path: Path, body: bytes, header: dict[str, list[str]], layout: np.dtype[np.void], count: int
) -> dict[str, Array]:
    """LZF-compressed, and stored field by field."""
    packed, size = struct.unpack("<II", body[:8]) if len(body) >= 8 else (0, 0)
    if size != layout.itemsize * count or len(body) < 8 + packed:
        raise InputError(f"{path}: compressed data are cut short; export it again")
    data = lzf.decompress(body[8 : 8 + packed], size) if size else b""
    if data is None or len(data) != size:
        raise InputError(f"{path}: compressed data do not give its {count} points; export it again")
    sizes = [layout[name].itemsize for name in layout.names or ()]
    first = np.concatenate([[0], np.cumsum(sizes)]) * count
    return {name: np.frombuffer(data, layout[i], count, int(first[i])) for name, i in _scalar_fields(header).items()}


# Zivid's .zdf, by h5py: an HDF5 file as netCDF-4 writes it, in the layout of Zivid's own sample programs.
#
# /data/pointcloud is (H, W, 3), mm, NaN where nothing was measured; /data/rgba_image is (H, W, 4) with 8 bits. Source:
# read_zdf_without_zivid.py in github.com/zivid/zivid-python-samples.

_COLOURS = ("red", "green", "blue")


def read_zdf(path: Path) -> dict[str, Array]:
    """Columns (N,) of the measured pixels, with their colours.

    Raises:
        InputError: h5py is not installed, or another layout.
    """
    points, colours = read_zdf_image(path)
    columns = dict(zip("xyz", points.reshape(-1, 3).T, strict=True))
    if colours is not None:
        columns |= dict(zip(_COLOURS, colours.reshape(3, -1), strict=True))
    return measured_pixels(columns)


def read_zdf_image(path: Path) -> tuple[Array, Array | None]:
    """Points (H, W, 3) and colours (3, H, W), these where the file has them.

    Raises:
        InputError: h5py is not installed, or another layout.
    """
    with import_extra("h5py", path, "formats").File(path, "r") as file:
        told = file.get("data/pointcloud")
        if told is None or len(told.shape) != 3 or told.shape[2] != 3:
            raise InputError(f"{path}: no data/pointcloud of x, y, z in it; to fix: save it as PLY in Zivid Studio")
        points, image = np.asarray(told, float), file.get("data/rgba_image")
        if image is None or image.shape[:2] != points.shape[:2] or image.shape[2] < len(_COLOURS):
            return points, None
        return points, np.moveaxis(np.asarray(image[..., :3], float), 2, 0)


def read_ply(path: Path) -> dict[str, Array]:
    """Columns (N,) of the vertices of a PLY by name, as stored."""
    from plyfile import PlyData

    require_room(path)
    with path.open("rb") as stream:
        if stream.read(3) != b"ply":
            raise InputError(f"{path}: is not a PLY file; export it again, or name it by its kind")
    data: NDArray[np.void] = PlyData.read(_without_blank_lines(path))["vertex"].data
    # List properties have no column of numbers.
    return {name: data[name] for name in data.dtype.names or () if not data.dtype[name].hasobject}


def _without_blank_lines(path: Path) -> Path | io.BytesIO:
    """Return the file, or its bytes without the blank lines that some programs leave in the header."""
    with path.open("rb") as stream:
        header, end, _ = stream.read(_HEADER_BYTES).partition(b"end_header")
        lines = header.splitlines(keepends=True)
        if not end or all(line.strip() for line in lines):
            return path
        stream.seek(len(header))
        return io.BytesIO(b"".join(line for line in lines if line.strip()) + stream.read())


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


# Three numbers or more, apart by blanks or semicolons, with commas before the decimals.
_DECIMAL_COMMAS = re.compile(r"(?=.*,)(?:[+-]?\d+(?:,\d+)?(?:[eE][+-]?\d+)?(?:[ \t]+|;[ \t]*|$)){3,}")


def _read_text(path: Path) -> dict[str, Array]:
    """Numbers in columns, by comma, semicolon, space or tab; a header line names them, else x y z …

    The header may be a comment, as numpy writes it: the last line before the numbers, if it names x, y and z.
    """
    told = [line for line in path.read_text(encoding="utf-8-sig").splitlines() if line.strip()]
    lines = [line for line in told if not _is_comment(line)]
    # Leica's .pts and others write the number of points above them.
    if len(lines) > 1 and lines[0].strip().isdigit() and int(lines[0]) == len(lines) - 1:
        lines = lines[1:]
    if not lines:
        return {axis: np.empty(0) for axis in "xyz"}
    if _DECIMAL_COMMAS.fullmatch(lines[-1].strip()):
        told, lines = ([line.replace(",", ".") for line in some] for some in (told, lines))
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


_NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))
_TEXT_SUFFIXES = (".xyz", ".csv", ".txt", ".asc", ".pts")
# What reads a kind, by the ending of the file's name.
_READERS: dict[str, Callable[[Path], dict[str, Array]]] = {
    ".ply": read_ply,
    ".pcd": read_pcd,
    **dict.fromkeys(_TEXT_SUFFIXES, _read_text),
    **dict.fromkeys(MESHES, read_mesh),
    ".npy": read_array,
    ".ptx": read_ptx,
    ".e57": read_e57,
    ".las": read_las,
    ".laz": read_las,
    ".zdf": read_zdf,
    **dict.fromkeys(DEPTH_SUFFIXES, read_depth_columns),
}
CLOUD_SUFFIXES = tuple(_READERS)


@readable()
def read_cloud(path: Path, scale: float = 1.0) -> Cloud:
    """Read one scan; `scale` turns the file's unit into the session's. Points at 0 0 0 are left out.

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
    held = len(columns["x"])
    columns, codes = _without_codes(columns)
    coded = held - len(columns["x"])
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
    return Cloud(points if scale == 1.0 else points * scale, normals, scalars, codes=codes, coded=coded)


# How often a code for "nothing measured" stands, how far it lies from the others, in their own extents, and how many of
# these are looked at: of so many different numbers at least, and of this share of the points.
_CODE_TIMES, _CODE_AWAY, _CODE_SAMPLE, _CODE_VALUES, _CODE_REST = 3, 2.0, 4000, 20, 0.02


def _without_codes(columns: dict[str, Array]) -> tuple[dict[str, Array], tuple[float, ...]]:
    """Return the columns without points that are a code, as -99999 three times or z = -32.768, and the codes.

    A code is the least or largest value of a coordinate, the same to the last digit in several points, be it a few of
    them or most, and far outside of what the rest spans.
    """
    coded, codes = np.zeros(len(columns["x"]), bool), set[float]()
    for axis in "zxy":
        values = np.asarray(columns[axis])
        while (code := _code(values[~coded] if coded.any() else values)) is not None:
            coded |= values == code
            codes.add(code)
    if coded.any():
        for name in list(columns):
            columns[name] = columns[name][~coded] if len(columns[name]) == len(coded) else columns[name]
    return columns, tuple(sorted(codes))


def _code(values: Array) -> float | None:
    """The value (N,) that stands for nothing measured, if one does."""
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
