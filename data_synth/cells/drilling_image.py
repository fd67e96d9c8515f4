"""The calibration plate as the cell's camera sees it: every pixel looks along its own ray at the plate."""

import numpy as np

from data_synth.cells.drilling import FOCAL, HEIGHT, HOLE_DIAMETER, IMAGE, NINE, DrillingCell
from stitch.numerics import frames

_FINE = 4  # rays per pixel and direction
_NOISE = 2.0  # grey levels


def render_plate(cell: DrillingCell) -> np.ndarray:
    """Image (2050, 2448) of 8 bits: bright plate, uneven light, nine dark holes, a dark bar that is no hole."""
    return render_holes(cell, NINE, HEIGHT + cell.sizes.plate_height)


def render_holes(cell: DrillingCell, centres: np.ndarray, height: float) -> np.ndarray:
    """Image of holes at x, y (N, 2) of a plane at one height of the flange frame."""
    v, u = np.mgrid[: IMAGE[1], : IMAGE[0]]
    image = 190 + 20 * (u / IMAGE[0] - 0.5) - 15 * (v / IMAGE[1] - 0.5)
    image[1950:1980, 300:900] = 30
    for centre in centres:
        at = cell.image(np.array([[*centre, height]]))[0].round().astype(int)
        rows, columns = (slice(at[axis] - 90, at[axis] + 90) for axis in (1, 0))
        covered = _covered(cell, rows, columns, centre, height)
        image[rows, columns] += (35 - image[rows, columns]) * covered
    image += cell.rng.normal(0, _NOISE, image.shape)
    return np.clip(image.round(), 0, 255).astype(np.uint8)


def _covered(cell: DrillingCell, rows: slice, columns: slice, centre: np.ndarray, height: float) -> np.ndarray:
    """Share of each pixel of a patch whose rays meet the hole."""
    sub = (np.arange(_FINE) + 0.5) / _FINE - 0.5
    v = (np.arange(rows.start, rows.stop)[:, None] + sub).ravel()
    u = (np.arange(columns.start, columns.stop)[:, None] + sub).ravel()
    real = np.stack(np.meshgrid(u, v), -1) - np.array(IMAGE) / 2 + 0.5
    arm, corner = real, np.hypot(*IMAGE) / 2
    for _ in range(10):
        arm = real / (1 + cell.sizes.k1 * (arm**2).sum(-1, keepdims=True) / corner**2)
    rays = np.concatenate([arm / FOCAL, np.ones((*arm.shape[:2], 1))], -1) @ cell.T_flange_camera[:3, :3].T
    origin = cell.T_flange_camera[:3, 3]
    hit = origin[:2] + rays[..., :2] * ((height - origin[2]) / rays[..., 2:])
    inside = (hit - centre) ** 2 @ np.ones(2) < (HOLE_DIAMETER / 2) ** 2
    shape = (rows.stop - rows.start, _FINE, columns.stop - columns.start, _FINE)
    return np.asarray(inside.reshape(shape).mean(axis=(1, 3)))


def ellipse_centres(cell: DrillingCell) -> np.ndarray:
    """Centres (9, 2) of the holes' image ellipses, exact for k1 = 0: the image conic is H⁻ᵀ C H⁻¹ of the circle C."""
    P = (
        np.array([[FOCAL, 0, IMAGE[0] / 2 - 0.5], [0, FOCAL, IMAGE[1] / 2 - 0.5], [0, 0, 1]])
        @ frames.inverse(cell.T_flange_camera)[:3]
    )
    height = HEIGHT + cell.sizes.plate_height
    inverse = np.linalg.inv(np.column_stack([P[:, 0], P[:, 1], P[:, 2] * height + P[:, 3]]))
    centres = []
    for x, y in NINE:
        circle = np.array([[1, 0, -x], [0, 1, -y], [-x, -y, x * x + y * y - (HOLE_DIAMETER / 2) ** 2]])
        conic = inverse.T @ circle @ inverse
        centres.append(np.linalg.solve(conic[:2, :2], -conic[:2, 2]))
    return np.array(centres)
