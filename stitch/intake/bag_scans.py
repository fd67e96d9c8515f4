"""PointCloud2 and depth images of a bag as arrays: (N, k), or (H, W, k) where the scan is an image; lengths in m."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stitch.errors import InputError
from stitch.frames import Array

_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
# Depth in whole numbers counts millimetres (REP 118).
_METRES_PER_MM = 1e-3


def cloud_array(message: Any, where: str) -> Array:
    """x, y, z, and red, green, blue or intensity behind them; NaN where a pixel measured nothing.

    Raises:
        InputError: no x, y, z, or fewer bytes than announced.
    """
    order = ">" if message.is_bigendian else "<"
    fields = {f.name: f for f in message.fields}
    if not all(axis in fields for axis in "xyz"):
        raise InputError(f"{where}: a PointCloud2 without x, y, z; to fix: name another topic with --topic")
    layout = np.dtype(
        {
            "names": list(fields),
            "formats": [order + _KINDS.get(f.datatype, "u1") for f in fields.values()],
            "offsets": [f.offset for f in fields.values()],
            "itemsize": message.point_step,
        }
    )
    data = np.ascontiguousarray(message.data, np.uint8)
    if len(data) < message.row_step * message.height or message.row_step < message.point_step * message.width:
        raise InputError(f"{where}: a PointCloud2 is cut short; to fix: record it again")
    rows = data[: message.row_step * message.height].reshape(message.height, -1)
    points = np.ascontiguousarray(rows[:, : message.point_step * message.width]).view(layout)
    columns = [np.asarray(points[axis], float) for axis in "xyz"] + _brightness(points)
    table: Array = np.stack(columns, axis=-1).reshape(message.height, message.width, len(columns))
    return table if message.height > 1 else _without_empty_points(table[0])


def _brightness(points: NDArray[np.void]) -> list[Array]:
    names = points.dtype.names or ()
    for name in ("rgb", "rgba"):
        if name in names:
            bits = np.ascontiguousarray(points[name]).view(np.uint32)
            return [((bits >> shift) & 255).astype(float) for shift in (16, 8, 0)]
    return [np.asarray(points["intensity"], float)] if "intensity" in names else []


def _without_empty_points(table: Array) -> Array:
    return table[np.isfinite(table[:, :3]).all(axis=1) & table[:, :3].any(axis=1)]


def depth_array(message: Any, camera: Any) -> Array:
    """(H, W, 3) points of a depth image by its CameraInfo, which must be of an image without distortion."""
    order = ">" if message.is_bigendian else "<"
    kind, scale = ("f4", 1.0) if message.encoding == "32FC1" else ("u2", _METRES_PER_MM)
    rows = np.ascontiguousarray(message.data, np.uint8).reshape(message.height, message.step)
    width = message.width * np.dtype(kind).itemsize
    z = np.ascontiguousarray(rows[:, :width]).view(order + kind).astype(float) * scale
    z = np.where(np.isfinite(z) & (z > 0), z, np.nan)
    fx, cx, fy, cy = (float(_camera_matrix(camera)[i]) for i in (0, 2, 4, 5))
    v, u = np.mgrid[: message.height, : message.width]
    return np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], axis=-1)


def _camera_matrix(camera: Any) -> Any:
    """K, in ROS 1 and 2."""
    return camera.k if hasattr(camera, "k") else camera.K
