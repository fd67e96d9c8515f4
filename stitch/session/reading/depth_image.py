"""Depth images (PNG, TIFF, EXR, NPY) with intrinsics as points: distance along the axis, 0 where nothing was seen.

Images of heights have a pitch in place of the intrinsics.

Points keep the file's unit: millimetres where whole numbers are stored, as sensors do, metres in floating point; or
metres where the intrinsics state `depth_scale`.
"""

from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.numerics.frames import Array
from stitch.session.reading.announced_points import require_exr_room
from stitch.session.reading.intrinsics import Intrinsics, find_intrinsics
from stitch.system.packages import import_extra

DEPTH_SUFFIXES = (".png", ".tif", ".tiff", ".exr")
# A table of points has fewer columns, an image more.
_FEWEST_COLUMNS = 17
# Modes of Pillow with one number a pixel and more than 8 bits.
_DEEP = ("I;16", "I;16B", "I;16L", "I", "F")
_CHANNELS = ("Z", "Y", "depth", "Depth", "R", "RGB")


def is_depth_image(path: Path) -> bool:
    """Return True if a file holds an image with one number per pixel, of more than 8 bits; all EXR count.

    Only the head of the file is read. Of a .npy: a table with more columns than points have, and several rows.
    """
    from PIL import Image, UnidentifiedImageError

    kind = path.suffix.lower()
    if kind == ".exr":
        return True
    if kind == ".npy":
        try:
            array = np.load(path, mmap_mode="r", allow_pickle=False)
        except (ValueError, OSError, EOFError):
            return False
        return (
            array.ndim == 2 and array.shape[1] >= _FEWEST_COLUMNS and array.shape[0] > 1 and array.dtype.kind in "fiu"
        )
    try:
        with Image.open(path) as image:
            return image.mode in _DEEP
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError):
        return False


def read_depth(path: Path) -> Array:
    """Return the points (H, W, 3) of a depth image, camera frame, NaN where nothing was measured.

    In the file's unit, or in metres where the intrinsics state a depth scale. An EXR may hold the points themselves.

    Raises:
        InputError: no depth image, no intrinsics, or those of another size of image.
    """
    pixels = _pixels(path)
    if pixels.ndim == 3:
        return np.where(pixels.any(axis=2, keepdims=True), pixels, np.nan)
    return points_of_image(path, pixels, find_intrinsics(path))


def read_depth_columns(path: Path) -> dict[str, Array]:
    """Return x, y, z (N,) of all pixels that measured something, camera frame."""
    points = read_depth(path).reshape(-1, 3)
    return dict(zip("xyz", points[np.isfinite(points[:, 2])].T, strict=True))


def _pixels(path: Path) -> Array:
    """Return the numbers (H, W) of a depth image as they are stored; of an EXR that holds them, points (H, W, 3).

    Raises:
        InputError: a picture, with colours or 8 bits.
    """
    from PIL import Image

    if path.suffix.lower() == ".npy":
        return np.load(path, allow_pickle=False).astype(float)
    if path.suffix.lower() == ".exr":
        return _exr(path)
    with Image.open(path) as image:
        if image.mode not in _DEEP:
            raise InputError(
                f"{path}: pixels of mode {image.mode} are a picture, no depth; to fix: store depth with 16 bits or as "
                "floating point"
            )
        return np.array(image, float)


def _exr(path: Path) -> Array:
    """Return the points (H, W, 3) of an EXR that holds coordinates; else its depth (H, W), or colours (H, W, 3)."""
    require_exr_room(path)
    with import_extra("OpenEXR", path, "formats").File(str(path)) as file:
        channels = {name: np.asarray(channel.pixels, float) for name, channel in file.channels().items()}
    if all(axis in channels for axis in "XYZ"):
        return np.dstack([channels[axis] for axis in "XYZ"])
    name = next((name for name in _CHANNELS if name in channels), next(iter(channels)))
    pixels = channels[name]
    if pixels.ndim == 2:
        return pixels
    is_colour = np.ptp(pixels[..., :3], axis=2).any()
    return pixels[..., :3] if is_colour else pixels[..., 0]


def points_of_image(where: Path | str, image: Array, camera: Intrinsics) -> Array:
    """Return the points (H, W, 3) of a depth image, or of a height map if the intrinsics have a pitch.

    Scanner frame; NaN where nothing was measured.

    Args:
        where: file, or name of the scan, for messages.
        image: (H, W) depths or heights as stored.

    Raises:
        InputError: the intrinsics are those of another size of image.
    """
    if camera.pitch is not None:
        return _points_of_heights(image, camera.pitch)
    return _points_of_depths(where, image, camera)


def _points_of_heights(heights: Array, pitch: tuple[float, float, float]) -> Array:
    """Return the points (H, W, 3) of a height map in the unit of the pitch, NaN where nothing was measured.

    x = column · pitch x, y = −row · pitch y, since rows run down, z = height · pitch z.

    Args:
        heights: (H, W) counts of either sign; 0 or NaN where nothing was measured.
        pitch: from pixel to pixel along x and y, and z of one count.
    """
    step_x, step_y, step_z = pitch
    rows, columns = np.indices(heights.shape)
    z = np.where(np.isfinite(heights) & (heights != 0), heights * step_z, np.nan)
    return np.dstack([columns * step_x, -rows * step_y, z])


def _points_of_depths(where: Path | str, depth: Array, camera: Intrinsics) -> Array:
    """Return the points (H, W, 3) of a depth image, camera frame, NaN where nothing was measured.

    In metres where the camera states its units per metre, else in the unit of the depth.

    Args:
        where: file, or name of the scan, for messages.
        depth: (H, W) distance along the optical axis; 0, negative or NaN where nothing was measured.

    Raises:
        InputError: the intrinsics are those of another size of image.
    """
    height, width = depth.shape
    if camera.size is not None and camera.size != (width, height):
        raise InputError(
            f"{where}: {width}×{height} pixels, {camera.source.name} is of {camera.size[0]}×{camera.size[1]}; to fix: "
            "put the intrinsics of this image there"
        )
    if not (0 <= camera.cx <= width and 0 <= camera.cy <= height):
        raise InputError(
            f"{camera.source}: the axis meets the image at ({camera.cx:g}, {camera.cy:g}), outside its "
            f"{width}×{height} pixels; to fix: put the intrinsics of this image there"
        )
    z = np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)
    if camera.units_per_metre is not None:
        z = z / camera.units_per_metre
    return np.dstack([_rays(camera, width, height), np.ones(depth.shape)]) * z[..., None]


def _rays(camera: Intrinsics, width: int, height: int) -> Array:
    """Return x/z and y/z (H, W, 2) of the ray of each pixel, camera frame, the lens's distortion undone."""
    u, v = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    if not len(camera.distortion):
        return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], axis=2)
    cv2 = import_extra("cv2", camera.source, "vision")
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    pixels = np.stack([u, v], axis=2).reshape(-1, 1, 2)
    rays: Array = cv2.undistortPoints(pixels, K, camera.distortion)
    return rays.reshape(height, width, 2)
