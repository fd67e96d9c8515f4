"""A camera's intrinsics, from the file that lies beside a depth image.

Read as tools write them: ROS camera_info and OpenCV's YAML (camera_matrix, or K and D), Open3D's JSON (intrinsic_matrix
by columns), RealSense's (fx, fy, ppx, ppy, coeffs), Zivid's YAML (FX, FY, CX, CY, K1 …), a 3×3 matrix as text. Of an
image of heights: pitch_x, pitch_y, from pixel to pixel, and z_scale, what a count is high.
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
from stitch.session.reading.text_files import read_text, shortened

_NAMED = re.compile(r"intrinsic|camera_?info|calib|camera|^k$|pitch|height|surface", re.IGNORECASE)
_PITCH = re.compile(
    r"(pitch|pixel_?size|spacing|resolution|scale)_?([xyz])|([xyz])_?(pitch|pixel_?size|spacing|resolution|scale)"
)
_ENDINGS = (".json", ".yaml", ".yml", ".txt")
_LARGEST_MB = 5.0
_FIX = (
    "to fix: put them beside it or in the folder above, as intrinsics.json with fx, fy, cx, cy, or with pitch_x, "
    "pitch_y of heights"
)
# Units per metre are more, metres per unit less: what lies between means neither.
_PER_METRE = 50.0
_METRES_PER = 0.02


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
    pitch: tuple[float, float, float] | None = None  # of heights: from pixel to pixel along x and y, and of a count


def find_intrinsics(image: Path) -> Intrinsics:
    """Return the intrinsics of an image, from the first place that has some.

    The places: a file of the image's name, its folder, the folder above. In a folder names with "depth" go first.

    Raises:
        InputError: none, several, or one that cannot be read.
    """
    for ending in _ENDINGS:
        file = image.with_suffix(ending)
        camera = _read_intrinsics(file) if file.is_file() else None
        if camera is not None:
            return camera
    for folder in (image.parent, image.parent.parent):
        files = [f for f in sorted(folder.iterdir()) if f.suffix.lower() in _ENDINGS and _NAMED.search(f.stem)]
        of_depth = [f for f in files if "depth" in f.stem.lower()]
        cameras = [camera for f in of_depth or files if (camera := _read_intrinsics(f)) is not None]
        if len(cameras) > 1:
            names = ", ".join(camera.source.name for camera in cameras[:3])
            raise InputError(
                f"{folder}: several files hold intrinsics ({names}); to fix: call that of the depth depth_…"
            )
        if cameras:
            return cameras[0]
    raise InputError(f"{image}: a depth image needs intrinsics, none lie beside it; {_FIX}")


def _read_intrinsics(file: Path) -> Intrinsics | None:
    """Return the intrinsics that a JSON, YAML or text file states; None where it holds none, or is too large."""
    if file.stat().st_size > _LARGEST_MB * 1e6:
        return None
    try:
        text = read_text(file, "name a file of intrinsics", _LARGEST_MB)
        if file.suffix.lower() == ".txt":
            document: Any = {"K": np.array(text.replace(",", " ").split(), float).tolist()}
        elif file.suffix.lower() == ".json":
            document = json.loads(text)
        else:
            from stitch.session.reading.yaml_file import parse_yaml

            documents = parse_yaml(file, text)
            document = documents[0] if documents else None
    except (ValueError, RecursionError, InputError):
        return None
    cameras = (intrinsics_of_mapping(file, mapping) for mapping in _mappings_in(document))
    return next((camera for camera in cameras if camera is not None), None)


def _mappings_in(document: Any) -> Iterator[dict[str, Any]]:
    """Yield every mapping of a document at any depth, keys in small letters; inner ones named after depth first."""
    if isinstance(document, dict):
        plain = {str(key).lower(): value for key, value in document.items()}
        yield plain
        for key in sorted(plain, key=lambda key: "depth" not in key):
            yield from _mappings_in(plain[key])


def intrinsics_of_mapping(file: Path, mapping: dict[str, Any]) -> Intrinsics | None:
    """Return the camera, or the pitch of a height map, that one mapping states; None where it states neither.

    Args:
        file: for messages.
        mapping: of a document, with keys in small letters.

    Raises:
        InputError: numbers that no lens has.
    """
    matrix = _camera_matrix(mapping)
    named = {m[2] or m[3]: mapping[name] for name in mapping if (m := _PITCH.match(name))} if matrix is None else {}
    if {"x", "y"} <= named.keys() and all(isinstance(step, (int, float)) and step > 0 for step in named.values()):
        pitch = (float(named["x"]), float(named["y"]), float(named.get("z", 1.0)))
        return Intrinsics(file, 1.0, 1.0, 0.0, 0.0, np.zeros(0), None, None, pitch)
    if matrix is None:
        return None
    fx, fy, cx, cy = matrix
    if not (np.isfinite(matrix).all() and fx > 0 and fy > 0):
        raise InputError(
            f"{file}: fx = {fx:g}, fy = {fy:g} are no focal lengths; to fix: state them in pixels, above 0"
        )
    width = _whole_number(mapping, "width", "image_width")
    height = _whole_number(mapping, "height", "image_height")
    size = None if width is None or height is None else (width, height)
    distortion = _distortion(file, mapping)
    return Intrinsics(file, fx, fy, cx, cy, distortion, size, units_per_metre=_units_per_metre(file, mapping))


def _camera_matrix(mapping: dict[str, Any]) -> tuple[float, float, float, float] | None:
    """Return fx, fy, cx, cy, pixels, of a mapping that names them or holds a camera matrix; None where it has none."""
    inner = mapping.get("cameramatrix")
    if isinstance(inner, dict):
        mapping = {str(key).lower(): value for key, value in inner.items()}
    for names in (("fx", "fy", "cx", "cy"), ("fx", "fy", "ppx", "ppy")):
        if all(isinstance(mapping.get(name), (int, float)) for name in names):
            fx, fy, cx, cy = (float(mapping[name]) for name in names)
            return fx, fy, cx, cy
    for name, by_columns in (("camera_matrix", False), ("k", False), ("intrinsic_matrix", True)):
        K = _list_numbers(mapping.get(name))
        if len(K) == 9:
            K = K.reshape(3, 3)
            # Open3D writes by columns: its last row 0 0 1 tells.
            K = K.T if by_columns and np.allclose(K[:, 2], [0, 0, 1]) else K
            return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    return None


def _list_numbers(value: Any) -> Array:
    """Return the numbers (n,) of a list, of a list of lists, or of a mapping with `data`; none of anything else."""
    if isinstance(value, dict):
        value = value.get("data", [])
    try:
        return np.array(value if isinstance(value, list) else [], float).ravel()
    except (TypeError, ValueError):
        return np.zeros(0)


def _distortion(file: Path, mapping: dict[str, Any]) -> Array:
    """Return OpenCV's distortion k1, k2, p1, p2, k3 (5,), or (0,) where the lens has none.

    Raises:
        InputError: the numbers are those of another law.
    """
    inner = mapping.get("distortion")
    if isinstance(inner, dict):
        named = {str(key).lower(): value for key, value in inner.items()}
        distortion = np.array([float(named.get(name, 0.0)) for name in ("k1", "k2", "p1", "p2", "k3")])
    else:
        names = ("distortion_coefficients", "coeffs", "d", "distortion")
        distortion = next((x for name in names if len(x := _list_numbers(mapping.get(name)))), np.zeros(0))
    if not distortion.any():
        return np.zeros(0)
    law = str(mapping.get("distortion_model", mapping.get("model", "")))
    if re.search("inverse|modified|kannala|fish.?eye|equidistant|theta", law, re.IGNORECASE):
        raise InputError(
            f"{file}: the lens distorts by {law}, its numbers are not OpenCV's k1, k2, p1, p2, k3; to fix: "
            "pass the points that the scanner's own program makes of the image"
        )
    return distortion


def _whole_number(mapping: dict[str, Any], *names: str) -> int | None:
    return next((int(mapping[name]) for name in names if isinstance(mapping.get(name), (int, float))), None)


def _units_per_metre(file: Path, mapping: dict[str, Any]) -> float | None:
    """Return how many units of depth make a metre; None where the file does not say it.

    `depth_scale` may be that number, as 1000, or its inverse, as 0.001.

    Raises:
        InputError: a value in between, which could be neither.
    """
    value = mapping.get("depth_scale")
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
