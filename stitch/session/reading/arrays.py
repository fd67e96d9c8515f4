"""Clouds and poses as people hold them in a process, turned into what a file of the same scan would give.

Open3D and trimesh are known by the names of their modules: whoever passes such an object has imported them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.session.reading.clouds import cloud_of_columns
from stitch.session.reading.depth_image import points_of_image
from stitch.session.reading.intrinsics import Intrinsics, intrinsics_of_mapping
from stitch.session.reading.scan_files import measured_pixels
from stitch.session.reading.text_files import require_name
from stitch.session.session import Cloud, Sighting

Columns = dict[str, Array]
_KNOWN = (
    "(N, 3) or (H, W, 3) numbers, a structured array with x, y, z, a mapping with points, a PointCloud of trimesh or "
    "Open3D, or (depth image, intrinsics)"
)
_OF_REALSENSE = ("fx", "fy", "ppx", "ppy", "coeffs")
_NORMALS = ("nx", "ny", "nz")
_COLOURS = ("red", "green", "blue")
# A matrix that is a rotation within the first is taken as it is, to the last digit; within the second it is made one.
_ORTHONORMAL = 1e-9
_NEARLY_ORTHONORMAL = 1e-2
_LAST_ROW = (0, 0, 0, 1)


def cloud_of(item: Any, where: str, scale: float = 1.0) -> Cloud:
    """Return a scan in the session's unit with normals, colours and every scalar that it has.

    Colours become the scalars red, green and blue, 0 … 255, as a PLY file holds them. Points at 0 0 0, and pixels
    of which x, y and z are NaN, are left out.

    Args:
        item: an array, mapping or object of a library as `_KNOWN` lists them.
        where: the scan's name, for messages.
        scale: factor from the unit of the item to the session's length_unit.

    Raises:
        InputError: a kind that is not known, another shape, no points, or points that are not finite.
    """
    is_plain = type(item) is np.ndarray and item.dtype == np.float64 and item.ndim == 2 and item.shape[1] == 3
    # Where nothing is changed or left out, no copy is needed.
    if scale == 1.0 and is_plain and len(item) and np.isfinite(item).all() and item.any(axis=1).all():
        return Cloud(item)
    return cloud_of_columns(where, _columns(item, where), scale)


def _columns(item: Any, where: str) -> Columns:
    """Return the columns of a scan, name -> (N,): x, y, z, nx, ny, nz, red, green, blue, and any scalar.

    By its kind: a cloud of ours, a mapping, (depth image, intrinsics), an object of Open3D or trimesh, else an array.
    """
    if isinstance(item, Cloud):
        cloud = item if item.whole is None else item.whole.read()
        normals = {} if cloud.normals is None else dict(zip(_NORMALS, cloud.normals.T, strict=True))
        return dict(zip("xyz", cloud.points.T, strict=True)) | normals | cloud.scalars
    if isinstance(item, Mapping):
        return _mapping_columns(item, where)
    if isinstance(item, tuple) and len(item) == 2 and not isinstance(item[0], (int, float)):
        return _depth_columns(*item, where)
    library = type(item).__module__.split(".")[0]
    if library == "open3d":
        return _open3d_columns(item, where)
    if library == "trimesh" and hasattr(item, "vertices"):
        colours = getattr(item, "colors", None)
        has_colours = colours is not None and len(colours) > 0
        return _xyz_columns(np.asarray(item.vertices), where) | (_colour_columns(colours, where) if has_colours else {})
    array = _unmasked(item)
    if array.dtype.names is not None:
        columns = {name: array[name].ravel() for name in array.dtype.names if array[name].ndim == array.ndim}
        return measured_pixels(columns)
    columns = _xyz_columns(array, where)
    return measured_pixels(columns) if array.ndim == 3 or np.ma.isMaskedArray(item) else columns


def _unmasked(values: Any) -> Any:
    """Return an array without its mask: NaN where it is masked; an array without a mask as it is.

    Of points (..., 3) with one masked number all three become NaN; of a structured array masked rows are left out.
    """
    if not np.ma.isMaskedArray(values):
        return np.asarray(values)
    if values.dtype.names is not None:
        return values.data[~np.any([np.ma.getmaskarray(values[name]) for name in values.dtype.names], axis=0)]
    filled: Array = np.ma.filled(values.astype(float), np.nan)
    if filled.ndim > 1 and filled.shape[-1] == 3:
        filled[np.isnan(filled).any(axis=-1)] = np.nan
    return filled


def _xyz_columns(points: Array, where: str) -> Columns:
    """Return columns x, y, z of points (N, 3), or of all pixels of (H, W, 3), NaN included.

    Raises:
        InputError: another shape or type.
    """
    if points.ndim not in (2, 3) or points.shape[-1] != 3 or points.dtype.kind not in "fiu":
        raise InputError(f"{where}: {_array_kind(points)} is no cloud that is known; to fix: pass {_KNOWN}")
    return dict(zip("xyz", points.reshape(-1, 3).T, strict=True))


def _mapping_columns(item: Mapping[str, Any], where: str) -> Columns:
    """Return the columns of a mapping: three each from points, normals and colors, one from every other entry.

    Raises:
        InputError: columns of different lengths.
    """
    rest = {str(name): _unmasked(values) for name, values in item.items()}
    columns = _xyz_columns(rest.pop("points"), where) if "points" in rest else {}
    count = len(columns.get("x", ()))
    if "normals" in rest:
        columns |= _three_columns(_NORMALS, rest.pop("normals"), "normals", where)
    if "colors" in rest:
        columns |= _colour_columns(rest.pop("colors"), where)
    columns |= {name: values.ravel() for name, values in rest.items()}
    odd = next((name for name, column in columns.items() if len(column) != (count or len(columns[name]))), None)
    if odd is not None:
        raise InputError(f"{where}: {odd} has {len(columns[odd])} values for {count} points; to fix: pass one a point")
    return measured_pixels(columns)


def _colour_columns(colours: Any, where: str) -> Columns:
    """Return columns red, green, blue, 0 … 255, of colours (..., 3 or 4): integers as they are, floats times 255.

    A fourth value, the opacity, is left out.
    """
    values = np.asarray(colours)
    if values.dtype.kind == "f":
        values = np.round(values * 255)
    return _three_columns(_COLOURS, values[..., :3], "colors", where)


def _three_columns(names: Sequence[str], values: Array, what: str, where: str) -> Columns:
    """Return three columns by their names from values (..., 3); `what` names them in the error."""
    if values.ndim < 2 or values.shape[-1] != 3:
        raise InputError(f"{where}: {what} of shape {values.shape}; to fix: pass three numbers a point")
    return dict(zip(names, values.reshape(-1, 3).T, strict=True))


def _open3d_columns(item: Any, where: str) -> Columns:
    """Return the columns of a PointCloud of Open3D: of open3d.geometry, or of open3d.t.geometry with its attributes.

    Raises:
        InputError: an image, or another kind of object.
    """
    if hasattr(item, "depth"):
        raise InputError(f"{where}: an image has no points without its lens; to fix: pass (image, intrinsics)")
    if hasattr(item, "has_normals"):
        columns = _xyz_columns(np.asarray(item.points), where)
        columns |= _three_columns(_NORMALS, np.asarray(item.normals), "normals", where) if item.has_normals() else {}
        return columns | (_colour_columns(item.colors, where) if item.has_colors() else {})
    if "positions" not in getattr(item, "point", ()):
        raise InputError(f"{where}: {type(item).__name__} is no cloud that is known; to fix: pass {_KNOWN}")
    values = {name: item.point[name].cpu().numpy() for name in item.point}
    values = {"intensity" if name == "intensities" else name: x for name, x in values.items()}
    threes = {"points": values.pop("positions")} | {k: values.pop(k) for k in ("normals", "colors") if k in values}
    return _mapping_columns(threes | {name: x for name, x in values.items() if x.size == len(x)}, where)


def _depth_columns(image: Any, intrinsics: Any, where: str) -> Columns:
    """Return the columns of the points of a depth image, with brightness or colours of an RGB-D image of its size.

    Args:
        image: (H, W) array or image of depths, or an RGBDImage; 0 where nothing was measured.
        intrinsics: as `_intrinsics` takes them.
    """
    depth = _image_pixels(getattr(image, "depth", image))
    colour = getattr(image, "color", None)
    if depth.ndim != 2:
        raise InputError(
            f"{where}: {_array_kind(depth)} is no depth image; to fix: pass (H, W) numbers with intrinsics"
        )
    points = points_of_image(where, depth.astype(float), _intrinsics(intrinsics, where)).reshape(-1, 3)
    measured = np.isfinite(points[:, 2])
    columns = dict(zip("xyz", points[measured].T, strict=True))
    pixels = np.zeros(0) if colour is None else _image_pixels(colour)
    if pixels.shape[:2] != depth.shape:
        return columns
    if pixels.ndim == 2:
        return columns | {"intensity": pixels.ravel()[measured]}
    return columns | {name: values[measured] for name, values in _colour_columns(pixels, where).items()}


def _image_pixels(image: Any) -> Array:
    """Return the pixels (H, W), or (H, W, C) of C > 1 channels, of an array or of an image of Open3D."""
    for way in ("as_tensor", "cpu"):
        image = getattr(image, way)() if hasattr(image, way) else image
    values = image.numpy() if hasattr(image, "numpy") else np.asarray(image)
    return values[..., 0] if values.ndim == 3 and values.shape[2] == 1 else values


def _intrinsics(item: Any, where: str) -> Intrinsics:
    """Return the intrinsics from an object as people pass it.

    Args:
        item: a PinholeCameraIntrinsic of Open3D, a camera matrix (3, 3), RealSense's intrinsics, or a mapping with the
            names of a file of intrinsics.

    Raises:
        InputError: none of these, or without focal lengths.
    """
    if hasattr(item, "ppx"):
        item = {name: getattr(item, name, None) for name in (*_OF_REALSENSE, "model", "width", "height")}
    if hasattr(item, "intrinsic_matrix"):
        size = {"width": int(item.width), "height": int(item.height)} if item.width > 0 else {}
        item = {"camera_matrix": item.intrinsic_matrix} | size
    elif not isinstance(item, Mapping):
        item = {"camera_matrix": item.cpu().numpy() if hasattr(item, "cpu") else item}
    mapping = {str(name).lower(): _plain(value) for name, value in item.items()}
    intrinsics = intrinsics_of_mapping(Path(where), mapping)
    if intrinsics is None:
        raise InputError(
            f"{where}: the intrinsics are no matrix (3, 3) with focal lengths; to fix: pass fx, fy, cx, cy in pixels"
        )
    return replace(intrinsics, units_per_metre=None)  # depths are in the unit that is passed


def _plain(value: Any) -> Any:
    """Return the lists and numbers that a file would hold."""
    if hasattr(value, "tolist"):
        return value.tolist()
    return list(value) if isinstance(value, tuple) else value


def poses_of(poses: Any, where: str) -> Array:
    """Return poses (V, 4, 4) from matrices, scipy's RigidTransform, (Rotation, translation), or a list of any of these.

    Matrices that are stored by columns, with 0 0 0 1 as their last column, are transposed. Rotations that are exact
    stay to the last digit; others are made orthonormal.

    Args:
        where: for messages.

    Raises:
        InputError: another kind or shape, numbers that are not finite, or a pose that is no rigid motion.
    """
    T = _matrices(poses, where)
    if T.ndim != 3 or T.shape[1:] != (4, 4) or not len(T):
        raise InputError(
            f"{where}: poses of shape {T.shape}; to fix: pass (V, 4, 4), RigidTransform, (Rotation, translation), or "
            "a list of one a view"
        )
    if not np.isfinite(T).all():
        bad = int((~np.isfinite(T).all(axis=(1, 2))).argmax())
        raise InputError(f"{where}: pose {bad} is not finite; to fix: leave that view out")
    by_rows = _are_motions(T)
    M = T if by_rows else T.transpose(0, 2, 1)
    if not by_rows and not _are_motions(M):
        raise InputError(f"{where}: {_reason_not_rigid(T)}; write a rotation, and 0 0 0 1 in the last row")
    R = M[:, :3, :3]
    if by_rows and _off_orthonormal(R) < _ORTHONORMAL:
        return T
    return frames.make(Rotation.from_matrix(R).as_matrix(), M[:, :3, 3])


def _are_motions(T: Array) -> bool:
    """Return True if all matrices (V, 4, 4) have the last row 0 0 0 1 and, within `_NEARLY_ORTHONORMAL`, a rotation."""
    R = T[:, :3, :3]
    last_row = np.allclose(T[:, 3], _LAST_ROW, atol=1e-6)
    return last_row and _off_orthonormal(R) < _NEARLY_ORTHONORMAL and bool((np.linalg.det(R) > 0).all())


def _off_orthonormal(R: Array) -> float:
    return float(np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max())


def _matrices(poses: Any, where: str) -> Array:
    """Return the matrices (V, 4, 4) of many poses, (4, 4) of one, unchecked.

    Raises:
        InputError: they are no numbers, or of different shapes.
    """
    if hasattr(poses, "as_matrix") and not isinstance(poses, Rotation):
        return poses.as_matrix()
    if isinstance(poses, tuple) and len(poses) == 2 and isinstance(poses[0], Rotation):
        rotations = poses[0].as_matrix()
        shifts = np.asarray(poses[1], float)
        if shifts.shape != rotations.shape[:-1]:
            raise InputError(
                f"{where}: {rotations.shape[:-2] or 'one'} rotations and translations of shape {shifts.shape}; to fix: "
                "pass three numbers a rotation"
            )
        return frames.make(rotations, shifts)
    try:
        if isinstance(poses, Sequence) and not isinstance(poses, str):
            # A list may mix objects with a pose each, converted one by one, and arrays.
            is_object = [
                hasattr(p, "as_matrix") or (isinstance(p, tuple) and isinstance(p[0], Rotation)) for p in poses
            ]
            poses = [_matrices(p, where) if o else _unmasked(p) for p, o in zip(poses, is_object, strict=True)]
        if np.iscomplexobj(matrices := np.asarray(_unmasked(poses))):
            raise TypeError
        return matrices.astype(float)
    except (TypeError, ValueError):
        raise InputError(
            f"{where}: poses are not all matrices (4, 4); to fix: pass (V, 4, 4), RigidTransform, "
            "(Rotation, translation), or a list of one a view"
        ) from None


def _reason_not_rigid(T: Array) -> str:
    """Return why the worst of matrices (V, 4, 4) is no rigid motion: by its rotation, its determinant and last row."""
    R = T[:, :3, :3]
    off = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2)) + np.abs(T[:, 3] - _LAST_ROW).max(axis=1)
    det = np.linalg.det(R)
    worst = int(np.argmax(off + (det < 0)))
    size = np.abs(R[worst] @ R[worst].T - np.eye(3)).max()
    return f"pose {worst} is not a rigid motion (R·Rᵀ differs from 1 by {size:.2g}, det {det[worst]:+.3f})"


def sighting_of(item: Any, where: str) -> Sighting | None:
    """Return the labelled points of one view, sensor frame; None where it has none. Their sigmas are not known, NaN.

    Args:
        item: a mapping from target to its point (3,), a `Sighting`, which is returned as it is, or None.

    Raises:
        InputError: a place that is not three finite numbers.
    """
    if item is None or isinstance(item, Sighting):
        return item
    if not isinstance(item, Mapping):
        raise InputError(f"{where}: labelled points are of type {type(item).__name__}; to fix: pass {{target: (3,)}}")
    if not item:
        return None
    points = np.array([np.asarray(place, float) for place in item.values()])
    if points.shape != (len(item), 3) or not np.isfinite(points).all():
        raise InputError(f"{where}: labelled points are not three finite numbers each; to fix: pass {{target: (3,)}}")
    targets = tuple(require_name(where, str(name), "target") for name in item)
    return Sighting(targets, points, np.full(len(item), np.nan))


def per_view(values: Any, count: int, where: str, ndim: int = 1) -> Array:
    """Return numbers with one row per view as a float array (count, ...) of `ndim` axes; NaN where one is masked.

    Raises:
        InputError: another number of rows, another shape, or dates, which count in no unit.
    """
    try:
        found = _unmasked(values)
        if found.dtype.kind in "mM":
            raise InputError(f"{where}: dates or durations, not numbers; to fix: pass numbers in one unit")
        if found.dtype.kind == "c":
            raise InputError(f"{where}: complex numbers; to fix: pass their real part")
        found = found.astype(float)
    except (TypeError, ValueError):
        found = np.zeros((0,))
    if found.ndim != ndim or len(found) != count:
        raise InputError(f"{where}: shape {found.shape} for {count} views; to fix: pass one row of numbers a view")
    return found


def seconds_of(times: Any, count: int, where: str) -> Array:
    """Return times (count,) s: numbers as they are, durations in seconds, dates in seconds since the first of them.

    Raises:
        InputError: as of `per_view`.
    """
    values = np.asarray(times)
    if values.dtype.kind not in "mM":
        return per_view(times, count, where)
    since = values - values.ravel()[0] if values.dtype.kind == "M" and values.size else values
    seconds = np.where(np.isnat(values), np.nan, since / np.timedelta64(1, "s"))
    return per_view(np.where(np.ma.getmaskarray(times), np.nan, seconds), count, where)


def _array_kind(array: Array) -> str:
    return f"an array of shape {array.shape} and type {array.dtype}"
