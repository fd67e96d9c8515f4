"""Holes in a camera image. Needs OpenCV, which only `stitch[dev]` installs: `pip install opencv-python-headless`."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stitch.errors import InputError, NoResultError
from stitch.frames import Array


def _opencv() -> Any:
    try:
        import cv2
    except ImportError:
        raise InputError(
            "finding holes in images needs OpenCV; install opencv-python-headless, or give u, v of the holes in a CSV"
        ) from None
    return cv2


def find_holes(image: NDArray[np.uint8], min_width: float = 20.0) -> Array:
    """Centres (N, 2) in pixels of the dark, nearly elliptic spots wider than `min_width`; (0, 0) is a pixel's middle.

    A spot's centre is the grey-weighted mean over its surroundings, so that partly covered edge pixels count.

    Raises:
        InputError: OpenCV is not installed, or the image is not one grey channel.
    """
    cv2 = _opencv()
    if image.ndim != 2 or image.dtype != np.uint8:
        raise InputError(f"the image has shape {image.shape} and type {image.dtype}; give one grey channel of 8 bits")
    _, mask = cv2.threshold(image, 0, 255, cv2.THRESH_BINARY_INV + cv2.THRESH_OTSU)
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    centres = []
    for contour in contours:
        if len(contour) < 20:
            continue
        _, (a, b), _ = cv2.fitEllipse(contour)
        area = cv2.contourArea(contour)
        # Scratches and letters fill their ellipse badly; a hole fills it to a few per cent.
        if min(a, b) < min_width or abs(area / (np.pi * a * b / 4) - 1) > 0.1:
            continue
        centres.append(_centroid(image, cv2.boundingRect(contour)))
    return np.array(centres, float).reshape(-1, 2)


def order_grid(centres: Array, rows: int = 3, columns: int = 3) -> Array:
    """Centres of a hole array (rows·columns, 2), sorted by rows from the top and by columns from the left.

    Raises:
        NoResultError: another number of holes.
    """
    if len(centres) != rows * columns:
        raise NoResultError(
            f"{len(centres)} holes found, {rows * columns} expected; light the plate evenly and keep it in the image"
        )
    by_row = centres[np.argsort(centres[:, 1])].reshape(rows, columns, 2)
    return np.concatenate([row[np.argsort(row[:, 0])] for row in by_row])


def _centroid(image: NDArray[np.uint8], box: tuple[int, int, int, int]) -> Array:
    """Mean of the pixels in and just around a box, weighted by how much darker they are than the plate."""
    u, v, width, height = box
    margin = 6
    rows = slice(max(v - margin, 0), v + height + margin)
    columns = slice(max(u - margin, 0), u + width + margin)
    patch = image[rows, columns].astype(float)
    plate = float(np.median(np.concatenate([patch[0], patch[-1], patch[:, 0], patch[:, -1]])))
    # Noise on the plate must not pull the mean: only what is clearly darker counts.
    weight = np.where(patch < plate - 0.1 * (plate - patch.min()), plate - patch, 0.0)
    v_index, u_index = np.mgrid[
        rows.start : rows.start + patch.shape[0], columns.start : columns.start + patch.shape[1]
    ]
    return np.asarray([(weight * u_index).sum() / weight.sum(), (weight * v_index).sum() / weight.sum()], float)
