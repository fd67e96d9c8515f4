"""Scans as images: organised clouds with brightness or colour, and depth images with the colour image beside them."""

import re
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.session.reading.clouds import grid_shape, read_pcd, read_ply, read_zdf_image
from stitch.session.reading.depth_image import DEPTH_SUFFIXES, is_depth_image, read_depth
from stitch.session.reading.text_files import import_extra, reason_of
from stitch.session.session import RangeImage

# Poses that stand in the headers of scans: E57, Leica's PTX, PCD; and the times that stand in those of E57.
#
# Robot cells that save such files write the flange's pose there; software that has registered the scans already writes
# the scanner's own.

_HEAD = 4096
# From here E57 counts seconds (ASTM E2807).
_GPS_EPOCH, _LATEST_S = datetime(1980, 1, 6), 1e10
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


def times_in_scans(files: list[Path]) -> list[str] | None:
    """When each scan began, as 2026-12-31T23:59:59.250000, of E57; None where one does not say it.

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
    """Zero where the header has no time."""
    opened = import_extra("pye57", file, "formats").E57(str(file))
    try:
        return float(opened.get_header(0).acquisitionStart_dateTimeValue)
    except Exception:  # of libe57's own kinds: the standard lets the entry out
        return 0.0


def _e57(file: Path) -> Array | None:
    # A header is good for as long as its file is open.
    opened = import_extra("pye57", file, "formats").E57(str(file))
    header = opened.get_header(0)
    return frames.make(header.rotation_matrix, header.translation) if header.has_pose() else None


def _ptx(file: Path) -> Array:
    """Four lines of a matrix for rows of points: the translation stands in the last of them."""
    with file.open(encoding="ascii", errors="replace") as stream:
        lines = [line.split() for _, line in zip(range(_PTX_MATRIX.stop), stream, strict=False)]
    T = np.array(lines[_PTX_MATRIX], float).T
    # Seven digits of a rotation are not quite one.
    return frames.make(frames.rotations(T[:3, :3]).as_matrix()[0], T[:3, 3])


def _pcd(file: Path) -> Array | None:
    with file.open("rb") as stream:
        words = [line.split() for line in stream.read(_HEAD).split(b"\n")]
    told = next((line[1:] for line in words if line[:1] == [b"VIEWPOINT"]), None)
    if told is None or len(told) != 7:
        return None
    x, y, z, w, *axis = (float(word) for word in told)
    return frames.from_quaternion(np.array([x, y, z]), np.array([*axis, w]))


_PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
_COLOUR = re.compile(r"colou?r|rgb|image|gr[ae]y|intensity|texture|left|2d", re.IGNORECASE)
_RGB = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_GREY = ("intensity", "grey", "gray", "brightness", "reflectance")
# Share of pixels that may be brighter than the white of an intensity in counts.
_SATURATED = 0.5


def read_range_image(path: Path, scale: float = 1.0) -> RangeImage | None:
    """A scan as an image; None where its file holds no pixels, or no brightness lies in it or beside it.

    Args:
        scale: turns the file's unit into the session's.

    Raises:
        InputError: a file that cannot be read, or a picture of another size than its scan.
    """
    try:
        points, grey = _read_pixels(path)
    except InputError:
        raise
    except Exception as error:  # whatever a library raises at bytes that are no scan
        raise InputError(f"{path}: cannot be read ({reason_of(error)}); export it again") from None
    if points is None:
        return None
    if grey is None:
        beside = find_picture(path)
        if beside is None:
            return None
        grey = _read_picture(beside)
        if grey.shape != points.shape[:2]:
            sizes = [f"{shape[1]}×{shape[0]}" for shape in (grey.shape, points.shape)]
            raise InputError(
                f"{beside}: {sizes[0]} pixels, its scan {path.name} has {sizes[1]}; to fix: export the picture aligned "
                "to the depth"
            )
    seen = np.isfinite(points).all(axis=2) & points.any(axis=2)
    points = np.where(np.expand_dims(seen, 2), points, np.nan)
    return RangeImage(points * scale, grey)


def _read_pixels(path: Path) -> tuple[Array | None, NDArray[np.uint8] | None]:
    kind = path.suffix.lower()
    if kind in DEPTH_SUFFIXES or (kind == ".npy" and is_depth_image(path)):
        return read_depth(path), None
    if kind == ".npy":
        return _array_pixels(path)
    if kind == ".zdf":
        points, colours = read_zdf_image(path)
        return points, None if colours is None else _grey(colours)
    shape = grid_shape(path) if kind in (".ply", ".pcd") else None
    if shape is None:
        return None, None
    columns = read_pcd(path) if kind == ".pcd" else _full_grid(path, read_ply(path), shape)
    if len(columns["x"]) != shape[0] * shape[1]:
        return None, None
    points = np.stack([np.asarray(columns[axis], float) for axis in "xyz"], axis=1).reshape(*shape, 3)
    grey = _brightness_of_columns(columns)
    return points, None if grey is None else grey.reshape(shape)


def _full_grid(path: Path, columns: dict[str, Array], shape: tuple[int, int]) -> dict[str, Array]:
    """The vertices on their grid, where the file lists the measured ones and says which pixel has which."""
    from plyfile import PlyData

    if len(columns["x"]) == shape[0] * shape[1]:
        return columns
    data = PlyData.read(str(path))
    if "range_grid" not in data:
        return columns
    pixels = data["range_grid"].data["vertex_indices"]
    index = np.array([pixel[0] if len(pixel) else -1 for pixel in pixels])
    return {
        name: np.where(index >= 0, np.asarray(column, float)[index], np.nan if name in "xyz" else 0.0)
        for name, column in columns.items()
    }


def _array_pixels(path: Path) -> tuple[Array | None, NDArray[np.uint8] | None]:
    """(H, W, 3) without brightness, (H, W, 4) with it, (H, W, 6) with red, green and blue."""
    array = np.load(path, allow_pickle=False)
    if array.ndim != 3 or array.shape[2] < 3:
        return None, None
    rest = np.moveaxis(np.asarray(array[..., 3:], float), 2, 0)
    return np.asarray(array[..., :3], float), None if not len(rest) else _grey(rest[:3] if len(rest) >= 3 else rest[:1])


def _brightness_of_columns(columns: dict[str, Array]) -> NDArray[np.uint8] | None:
    for names in _RGB:
        if all(name in columns for name in names):
            return _grey(np.array([columns[name] for name in names], float))
    for name in ("rgb", "rgba"):
        if name in columns:
            # PCL packs red, green and blue into the bytes of one number.
            bits = np.ascontiguousarray(columns[name])
            packed = bits.view(np.uint32) if bits.dtype == np.float32 else bits.astype(np.uint32)
            return _grey(np.array([(packed >> shift) & 255 for shift in (16, 8, 0)], float))
    named = next((columns[name] for name in _GREY if name in columns), None)
    return None if named is None else _grey(np.asarray(named, float)[None])


def _grey(channels: Array) -> NDArray[np.uint8]:
    """Brightness of one channel or of three (c, …); counts beyond 8 bits are scaled to their brightest."""
    values = np.nan_to_num(channels.mean(axis=0))
    top = float(np.percentile(values, 100 - _SATURATED)) if values.size else 0.0
    white = 255.0 if 1.0 < top <= 255.0 else max(top, 1e-12)
    return np.asarray(np.clip(values * (255.0 / white), 0, 255), np.uint8)


def find_picture(scan: Path) -> Path | None:
    """The colour or grey image of a scan: named like it with another ending, or by colour and the same number."""
    numbers = re.findall(r"\d+", scan.stem)
    folders = [scan.parent, *(f for f in sorted(scan.parent.parent.iterdir()) if f.is_dir() and _COLOUR.search(f.name))]
    for folder in folders:
        for file in sorted(folder.iterdir()):
            if file == scan or file.suffix.lower() not in _PICTURES:
                continue
            told = _COLOUR.search(file.stem) or folder != scan.parent
            alike = told and numbers and re.findall(r"\d+", file.stem)[-1:] == numbers[-1:]
            if (file.stem == scan.stem or alike) and not is_depth_image(file):
                return file
    return None


def _read_picture(file: Path) -> NDArray[np.uint8]:
    from PIL import Image

    with Image.open(file) as image:
        return np.asarray(image.convert("L"))
