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
    """Return True if the file's head says one number a pixel, of more than 8 bits; colours are none."""
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
    """Return (H, W, 3) points, camera frame, NaN where nothing was measured; an EXR may hold them as they are.

    Raises:
        InputError: no depth image, no intrinsics, or those of another size of image.
    """
    pixels = _pixels(path)
    if pixels.ndim == 3:
        return np.where(pixels.any(axis=2, keepdims=True), pixels, np.nan)
    return lifted(path, pixels, find_intrinsics(path))


def read_depth_columns(path: Path) -> dict[str, Array]:
    """Return x, y, z (N,) of all pixels that measured something, camera frame."""
    points = read_depth(path).reshape(-1, 3)
    return dict(zip("xyz", points[np.isfinite(points[:, 2])].T, strict=True))


def _pixels(path: Path) -> Array:
    """Return (H, W) numbers as stored, or (H, W, 3) points."""
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
    is_colour = pixels.ndim == 3 and np.ptp(pixels[..., :3], axis=2).any()
    return pixels[..., :3] if is_colour else pixels if pixels.ndim == 2 else pixels[..., 0]


def lifted(where: Path | str, depth: Array, camera: Intrinsics) -> Array:
    """Return (H, W, 3) points of a depth image (H, W), camera frame, NaN where nothing was measured.

    Args:
        where: file, or name of the scan, for messages.
        depth: distance along the axis; 0, negative or NaN where nothing was measured.

    Raises:
        InputError: the intrinsics are those of another size of image.
    """
    height, width = depth.shape
    if camera.pitch is not None:
        # Rows of an image run down, heights up.
        x, y, up = camera.pitch
        rows, columns = np.indices(depth.shape)
        z = np.where(np.isfinite(depth) & (depth != 0), depth * up, np.nan)
        return np.dstack([columns * x, -rows * y, z])
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
    """Return (H, W, 2): x/z and y/z of every pixel."""
    u, v = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    if not len(camera.distortion):
        return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], axis=2)
    cv2 = import_extra("cv2", camera.source, "vision")
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    pixels = np.stack([u, v], axis=2).reshape(-1, 1, 2)
    rays: Array = cv2.undistortPoints(pixels, K, camera.distortion)
    return rays.reshape(height, width, 2)
