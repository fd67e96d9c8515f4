"""Scans as images: organised clouds with brightness or colour, and depth images with the colour image beside them."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stitch.errors import InputError
from stitch.numerics.frames import Array
from stitch.session.reading.depth_image import DEPTH_SUFFIXES, is_depth_image, read_depth
from stitch.session.reading.pcd_file import read_pcd
from stitch.session.reading.scan_files import grid_shape, read_ply, read_zdf_image
from stitch.session.reading.text_files import reason_of
from stitch.system import ply_file

_PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
_COLOUR = re.compile(r"colou?r|rgb|image|gr[ae]y|intensity|texture|left|2d", re.IGNORECASE)
_RGB = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_GREY = ("intensity", "grey", "gray", "brightness", "reflectance")
# Share of pixels that may be brighter than the white of an intensity in counts.
_SATURATED = 0.5


@dataclass(frozen=True)
class RangeImage:
    """One scan pixel by pixel, H rows and W columns; lengths in length_unit."""

    points: Array  # (H, W, 3) scanner frame; NaN where nothing was measured
    grey: NDArray[np.uint8]  # (H, W)


def read_range_image(path: Path, scale: float = 1.0) -> RangeImage | None:
    """Return a scan as an image of points and brightness.

    The brightness is in the file, or in a picture beside it. None where the scan is not stored pixel by pixel, or has
    no brightness.

    Args:
        scale: factor from the file's unit to the session's length_unit.

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
        picture = _find_picture(path)
        if picture is None:
            return None
        grey = _read_picture(picture)
        if grey.shape != points.shape[:2]:
            sizes = [f"{shape[1]}×{shape[0]}" for shape in (grey.shape, points.shape)]
            raise InputError(
                f"{picture}: {sizes[0]} pixels, its scan {path.name} has {sizes[1]}; to fix: export the picture "
                "aligned to the depth"
            )
    measured = np.isfinite(points).all(axis=2) & points.any(axis=2)
    points = np.where(np.expand_dims(measured, 2), points, np.nan)
    return RangeImage(points * scale, grey)


def _read_pixels(path: Path) -> tuple[Array | None, NDArray[np.uint8] | None]:
    """Return the points (H, W, 3) of a file, in its unit, and their brightness (H, W).

    Points are None where the file is not stored pixel by pixel; the brightness is None where the file holds none.
    """
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
    """Return columns (H·W,) of a PLY, a value for each pixel of its grid (H, W); NaN and 0 where none was measured.

    Unchanged where they have as many rows as pixels already, or where no list says which pixel has which vertex.
    """
    if len(columns["x"]) == shape[0] * shape[1]:
        return columns
    pixels = ply_file.read_ply(path).get("range_grid", {}).get("vertex_indices")
    if not isinstance(pixels, ply_file.Lists):
        return columns
    index = np.full(len(pixels.lengths), -1)
    measured = pixels.lengths > 0
    first = np.cumsum(pixels.lengths) - pixels.lengths  # where each pixel's list begins among all values
    index[measured] = pixels.values[first[measured]]
    return {
        name: np.where(index >= 0, np.asarray(column, float)[index], np.nan if name in "xyz" else 0.0)
        for name, column in columns.items()
    }


def _array_pixels(path: Path) -> tuple[Array | None, NDArray[np.uint8] | None]:
    """Return points (H, W, 3) and brightness (H, W) of a .npy: x, y, z and then nothing, grey, or red, green, blue.

    None for both where it holds no image of points; None for a brightness that it does not hold.
    """
    array = np.load(path, allow_pickle=False)
    if array.ndim != 3 or array.shape[2] < 3:
        return None, None
    points = array[..., :3].astype(float)
    colours = np.moveaxis(array[..., 3:].astype(float), 2, 0)
    if not len(colours):
        return points, None
    return points, _grey(colours[:3] if len(colours) >= 3 else colours[:1])


def _brightness_of_columns(columns: dict[str, Array]) -> NDArray[np.uint8] | None:
    """Return the brightness (N,), 0 to 255, of points from columns of colours, or of grey; None without either."""
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
    """Return the mean (...) of one channel or of three (c, ...) as brightness 0 to 255.

    Values up to 1, and those above 255, are scaled: the brightest but for `_SATURATED` per cent of them become 255.
    """
    values = np.nan_to_num(channels.mean(axis=0))
    top = float(np.percentile(values, 100 - _SATURATED)) if values.size else 0.0
    white = 255.0 if 1.0 < top <= 255.0 else max(top, 1e-12)
    return np.clip(values * (255.0 / white), 0, 255).astype(np.uint8)


def _find_picture(scan: Path) -> Path | None:
    """Return the picture of a scan, colour or grey; None without one.

    In its folder, or one beside that which is named after colour. It has the scan's name with another ending, or a name
    after colour with the same last number.
    """
    numbers = re.findall(r"\d+", scan.stem)
    folders = [scan.parent, *(f for f in sorted(scan.parent.parent.iterdir()) if f.is_dir() and _COLOUR.search(f.name))]
    for folder in folders:
        for file in sorted(folder.iterdir()):
            if file == scan or file.suffix.lower() not in _PICTURES:
                continue
            is_colour = _COLOUR.search(file.stem) or folder != scan.parent
            alike = is_colour and numbers and re.findall(r"\d+", file.stem)[-1:] == numbers[-1:]
            if (file.stem == scan.stem or alike) and not is_depth_image(file):
                return file
    return None


def _read_picture(file: Path) -> NDArray[np.uint8]:
    """Return the brightness (H, W), 0 to 255, of a picture, with colours or without."""
    from PIL import Image

    with Image.open(file) as image:
        return np.array(image.convert("L"))
