"""Depth images (PNG, TIFF, EXR, NPY) with intrinsics as points: distance along the axis, 0 where nothing was seen.

Points keep the file's unit: millimetres where whole numbers are stored, as sensors do, metres in floating point; or
metres where the intrinsics state `depth_scale`.
"""

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stitch.errors import InputError
from stitch.numerics.frames import Array
from stitch.session.reading.text_files import import_extra, read_text, shortened

# What a depth image's pixels look along: the camera's intrinsics from the file that lies beside it.
#
# Read as tools write them: ROS camera_info and OpenCV's YAML (camera_matrix, or K and D), Open3D's JSON
# (intrinsic_matrix by columns), RealSense's (fx, fy, ppx, ppy, coeffs), Zivid's YAML (FX, FY, CX, CY, K1 …), a 3×3
# matrix as text.

_NAMED = re.compile(r"intrinsic|camera_?info|calib|camera|^k$", re.IGNORECASE)
_ENDINGS = (".json", ".yaml", ".yml", ".txt")
_LARGEST_MB = 5.0
_FIX = "to fix: put them beside it or in the folder above, as intrinsics.json with fx, fy, cx, cy"
# Units per metre, or metres per unit: what lies between means neither.
_PER_METRE, _METRES_PER = 50.0, 0.02


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole with OpenCV's distortion, in pixels; (0, 0) is the middle of the first pixel."""

    source: Path
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Array  # (n,) k1, k2, p1, p2, k3 …; none where all are zero
    size: tuple[int, int] | None  # width, height
    units_per_metre: float | None  # of the depth, where the file states it


def find_intrinsics(image: Path) -> Intrinsics:
    """Intrinsics of an image: a file of its own name, or the one of its folder or of the folder above.

    Raises:
        InputError: none, several, or one that cannot be read.
    """
    own = [image.with_suffix(ending) for ending in _ENDINGS if image.with_suffix(ending).is_file()]
    for file in own:
        found = _read_intrinsics(file)
        if found is not None:
            return found
    for folder in (image.parent, image.parent.parent):
        files = [f for f in sorted(folder.iterdir()) if f.suffix.lower() in _ENDINGS and _NAMED.search(f.stem)]
        of_depth = [f for f in files if "depth" in f.stem.lower()]
        read = [found for f in of_depth or files if (found := _read_intrinsics(f)) is not None]
        if len(read) > 1:
            names = ", ".join(found.source.name for found in read[:3])
            raise InputError(
                f"{folder}: several files hold intrinsics ({names}); to fix: call that of the depth depth_…"
            )
        if read:
            return read[0]
    raise InputError(f"{image}: a depth image needs intrinsics, none lie beside it; {_FIX}")


def _read_intrinsics(file: Path) -> Intrinsics | None:
    """None for a file that holds no intrinsics."""
    if file.stat().st_size > _LARGEST_MB * 1e6:
        return None
    try:
        told = read_text(file, "name a file of intrinsics", _LARGEST_MB)
        if file.suffix.lower() == ".txt":
            document: Any = {"K": np.array(told.replace(",", " ").split(), float).tolist()}
        elif file.suffix.lower() == ".json":
            document = json.loads(told)
        else:
            from stitch.session.reading.yaml_file import parse_yaml

            documents = parse_yaml(file, told)
            document = documents[0] if documents else None
    except (ValueError, RecursionError, InputError):
        return None
    for level in _document_levels(document):
        found = _intrinsics_of_level(file, level)
        if found is not None:
            return found
    return None


def _document_levels(document: Any) -> Iterator[dict[str, Any]]:
    """Every mapping of a document, those of the depth first."""
    if isinstance(document, dict):
        plain = {str(key).lower(): value for key, value in document.items()}
        yield plain
        for key in sorted(plain, key=lambda key: "depth" not in key):
            yield from _document_levels(plain[key])


def _intrinsics_of_level(file: Path, level: dict[str, Any]) -> Intrinsics | None:
    matrix = _camera_matrix(level)
    if matrix is None:
        return None
    fx, fy, cx, cy = matrix
    if not (np.isfinite(matrix).all() and fx > 0 and fy > 0):
        raise InputError(
            f"{file}: fx = {fx:g}, fy = {fy:g} are no focal lengths; to fix: state them in pixels, above 0"
        )
    width, height = (_whole_number(level, *names) for names in (("width", "image_width"), ("height", "image_height")))
    size = None if width is None or height is None else (width, height)
    return Intrinsics(
        file, fx, fy, cx, cy, distortion=_distortion(level), size=size, units_per_metre=_units_per_metre(file, level)
    )


def _camera_matrix(level: dict[str, Any]) -> tuple[float, float, float, float] | None:
    """fx, fy, cx, cy."""
    inner = level.get("cameramatrix")
    if isinstance(inner, dict):
        level = {str(key).lower(): value for key, value in inner.items()}
    for names in (("fx", "fy", "cx", "cy"), ("fx", "fy", "ppx", "ppy")):
        if all(isinstance(level.get(name), (int, float)) for name in names):
            fx, fy, cx, cy = (float(level[name]) for name in names)
            return fx, fy, cx, cy
    for name, by_columns in (("camera_matrix", False), ("k", False), ("intrinsic_matrix", True)):
        K = _list_numbers(level.get(name))
        if len(K) == 9:
            K = K.reshape(3, 3)
            # Open3D writes by columns: its last row 0 0 1 tells.
            K = K.T if by_columns and np.allclose(K[:, 2], [0, 0, 1]) else K
            return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    return None


def _list_numbers(value: Any) -> Array:
    """Numbers of a list, of a list of lists, or of a mapping with `data`; none of anything else."""
    if isinstance(value, dict):
        value = value.get("data", [])
    try:
        return np.asarray(value if isinstance(value, list) else [], float).ravel()
    except (TypeError, ValueError):
        return np.zeros(0)


def _distortion(level: dict[str, Any]) -> Array:
    inner = level.get("distortion")
    if isinstance(inner, dict):
        named = {str(key).lower(): value for key, value in inner.items()}
        found = np.array([float(named.get(name, 0.0)) for name in ("k1", "k2", "p1", "p2", "k3")])
    else:
        names = ("distortion_coefficients", "coeffs", "d", "distortion")
        found = next((x for name in names if len(x := _list_numbers(level.get(name)))), np.zeros(0))
    return found if found.any() else np.zeros(0)


def _whole_number(level: dict[str, Any], *names: str) -> int | None:
    return next((int(level[name]) for name in names if isinstance(level.get(name), (int, float))), None)


def _units_per_metre(file: Path, level: dict[str, Any]) -> float | None:
    value = level.get("depth_scale")
    if value is None:
        return None
    if isinstance(value, (int, float)) and value >= _PER_METRE:
        return float(value)
    if isinstance(value, (int, float)) and 0 < value <= _METRES_PER:
        return 1.0 / float(value)
    raise InputError(
        f"{file}: depth_scale {shortened(value)} is neither units per metre (1000) nor metres per unit (0.001); to "
        "fix: write one of these"
    )


DEPTH_SUFFIXES = (".png", ".tif", ".tiff", ".exr")
# A table of points has fewer columns, an image more.
_FEWEST_COLUMNS = 17
# Modes of Pillow with one number a pixel and more than 8 bits.
_DEEP = ("I;16", "I;16B", "I;16L", "I", "F")
_CHANNELS = ("Z", "Y", "depth", "Depth", "R", "RGB")


def is_depth_image(path: Path) -> bool:
    """True if the file's head says one number a pixel, of more than 8 bits; colours are none."""
    from PIL import Image, UnidentifiedImageError

    kind = path.suffix.lower()
    if kind == ".exr":
        return True
    if kind == ".npy":
        return _is_depth_array(path)
    try:
        with Image.open(path) as image:
            return image.mode in _DEEP
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError):
        return False


def _is_depth_array(path: Path) -> bool:
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, OSError, EOFError):
        return False
    return array.ndim == 2 and array.shape[1] >= _FEWEST_COLUMNS and array.shape[0] > 1 and array.dtype.kind in "fiu"


def read_depth(path: Path) -> Array:
    """(H, W, 3) points, NaN where nothing was measured.

    Raises:
        InputError: no depth image, no intrinsics, or those of another size of image.
    """
    return lifted(path, _pixels(path), find_intrinsics(path))


def lifted(where: Path | str, depth: Array, camera: Intrinsics) -> Array:
    """Return (H, W, 3) points of a depth image (H, W), camera frame, NaN where nothing was measured.

    Args:
        where: file, or name of the scan, for messages.
        depth: distance along the axis; 0, negative or NaN where nothing was measured.

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
    return np.asarray(np.dstack([_rays(camera, width, height), np.ones(depth.shape)]) * z[..., None])


def read_depth_columns(path: Path) -> dict[str, Array]:
    """x, y, z (N,) of all pixels that measured something, scanner frame."""
    points = read_depth(path).reshape(-1, 3)
    return dict(zip("xyz", points[np.isfinite(points[:, 2])].T, strict=True))


def _pixels(path: Path) -> Array:
    """(H, W) as stored."""
    from PIL import Image

    if path.suffix.lower() == ".npy":
        return np.asarray(np.load(path, allow_pickle=False), float)
    if path.suffix.lower() == ".exr":
        return _exr(path)
    with Image.open(path) as image:
        if image.mode not in _DEEP:
            raise InputError(
                f"{path}: pixels of mode {image.mode} are a picture, no depth; to fix: store depth with 16 bits or as "
                "floating point"
            )
        return np.asarray(image, float)


def _exr(path: Path) -> Array:
    with import_extra("OpenEXR", path, "formats").File(str(path)) as file:
        channels = {name: np.asarray(channel.pixels, float) for name, channel in file.channels().items()}
    name = next((name for name in _CHANNELS if name in channels), next(iter(channels)))
    return channels[name] if channels[name].ndim == 2 else np.asarray(channels[name][..., 0])


def _rays(camera: Intrinsics, width: int, height: int) -> Array:
    """(H, W, 2) x/z and y/z of every pixel."""
    u, v = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    if not len(camera.distortion):
        return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], axis=2)
    cv2 = import_extra("cv2", camera.source, "vision")
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    pixels = np.stack([u, v], axis=2).reshape(-1, 1, 2)
    rays: Array = cv2.undistortPoints(pixels, K, camera.distortion)
    return rays.reshape(height, width, 2)
