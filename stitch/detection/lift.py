"""Points of an image into space: the plane and the grid of the pixels around them, not one pixel's distance.

Around an image point a plane is fitted to what the pixels measured, robustly; on that plane the places of the pixels
are a smooth function of column and row, here of second order, which gives the place of the point itself. Nothing is
assumed of the camera. What the pixels scatter by gives the point's sigma.
"""

import numpy as np

from stitch.frames import Array, Mask
from stitch.measurement.range_image import RangeImage

# Pixels around a corner, and how many must have measured something.
_MIN_WINDOW, _MAX_WINDOW = 3, 25
_MIN_WINDOW_PIXELS, _SHARE = 12, 0.3
# Pixels further off the plane than so many robust sigmas belong to something else.
_PLANE_GATE = 3.5
_DRAWS = 40
# The pixels that are left lie around the point: their middle is this much of the window's radius off at most.
_MAX_OFFSET_SHARE = 0.5
# Of the window's size.
_ROUNDED = 1e-6


def lift_points(image: RangeImage, pixels: Array, radius: Array, pixel_sigma: float) -> tuple[Array, Array]:
    """Places (K, 3) and sigma of a coordinate (K,) of image points (K, 2); NaN where too little was measured.

    Args:
        radius: (K,) half width of the window, pixels.
        pixel_sigma: of the image points themselves, pixels.
    """
    found = [_lift_pixel(image, pixel, r, pixel_sigma) for pixel, r in zip(pixels, radius, strict=True)]
    return np.array([point for point, _ in found]).reshape(-1, 3), np.array([sigma for _, sigma in found])


def _lift_pixel(image: RangeImage, pixel: Array, radius: float, pixel_sigma: float) -> tuple[Array, float]:
    nothing = np.full(3, np.nan), float("nan")
    reach = int(np.clip(round(radius), _MIN_WINDOW, _MAX_WINDOW))
    column, row = (round(float(x)) for x in pixel)
    rows, columns = (np.arange(max(x - reach, 0), x + reach + 1) for x in (row, column))
    window = image.points[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    v, u = np.mgrid[rows[0] : rows[0] + window.shape[0], columns[0] : columns[0] + window.shape[1]]
    seen = np.isfinite(window).all(axis=2)
    if seen.sum() < max(_MIN_WINDOW_PIXELS, _SHARE * (2 * reach + 1) ** 2):
        return nothing
    points, offset = window[seen], np.stack([u[seen], v[seen]], axis=1) - pixel
    kept = _on_plane(points)
    points, offset = points[kept], offset[kept]
    if len(points) < _MIN_WINDOW_PIXELS or np.linalg.norm(offset.mean(axis=0)) > _MAX_OFFSET_SHARE * reach:
        return nothing
    middle = points.mean(axis=0)
    axes = np.linalg.svd(points - middle, full_matrices=False)[2]
    local = (points - middle) @ axes.T
    du, dv = (offset / reach).T
    design = np.stack([np.ones(len(du)), du, dv, du * du, du * dv, dv * dv], axis=1)
    coefficients, *_ = np.linalg.lstsq(design, local[:, :2], rcond=None)
    at = coefficients[0]
    # In the plane: the grid's own scatter, and the image point's.
    free = max(len(points) - 6, 1)
    grid = ((local[:, :2] - design @ coefficients) ** 2).sum(axis=0) / free
    shape = np.linalg.pinv(design.T @ design)
    in_plane = grid * shape[0, 0] + (coefficients[1:3] ** 2).sum(axis=0) * (pixel_sigma / reach) ** 2
    # Across it: a plane of three parameters at that place.
    rows_plane = np.column_stack([np.ones(len(local)), local[:, :2]])
    height = (local[:, 2] ** 2).sum() / max(len(points) - 3, 1)
    here = np.append(1.0, at)
    across = height * float(here @ np.linalg.pinv(rows_plane.T @ rows_plane) @ here)
    return middle + at @ axes[:2], float(np.sqrt((in_plane.sum() + across) / 3))


def _on_plane(points: Array) -> Mask:
    """Which points (N, 3) lie on the plane that most lie on (least median of squares, Rousseeuw 1984)."""
    draws = np.random.default_rng(0).integers(len(points), size=(_DRAWS, 3))
    a, b, c = (points[draws[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    good = length > 1e-12 * max(float(np.ptp(points)) ** 2, 1e-300)
    if not good.any():
        return np.zeros(len(points), bool)
    normals = normals[good] / length[good, None]
    off = np.abs((points[None] - a[good][:, None]) @ normals[:, :, None])[..., 0]
    best = int(np.argmin(np.median(off, axis=1)))
    # Without noise the scatter is what numbers are rounded to.
    floor = _ROUNDED * float(np.linalg.norm(np.ptp(points, axis=0)))
    kept = off[best] <= _PLANE_GATE * 1.4826 * np.median(off[best]) + floor
    for _ in range(3):
        middle = points[kept].mean(axis=0)
        normal = np.linalg.svd(points[kept] - middle, full_matrices=False)[2][2]
        off_now: Array = np.abs((points - middle) @ normal)
        kept = off_now <= _PLANE_GATE * 1.4826 * np.median(off_now[kept]) + floor
    return np.asarray(kept, bool)
