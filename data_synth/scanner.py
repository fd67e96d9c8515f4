"""Scanners: their fields, rays and error parameters, and the clouds that they give."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
# Plane waves that a smooth error of a single scan is the sum of.
_WAVES = 120


@dataclass(frozen=True)
class Scanner:
    """Around +z of its frame. Lengths in mm, angles in degrees; `kind` is "area" or "line"."""

    kind: str = "area"
    columns: int = 220  # rays across, along x
    rows: int = 220  # rays down, along y; a line scanner takes this many profiles in a sweep
    field_of_view: float = 28.0  # full angle along x
    field_of_view_y: float | None = None  # default: as along x
    standoff: float = 420.0
    depth_of_field: float = 400.0  # full, about the standoff
    noise: float = 0.02  # 1-sigma along the ray at the standoff, grows with range²
    tail: float = 0.0  # degrees of freedom of Student's t for that noise, above 2; 0 is Gaussian
    field_error: float = 0.0  # rms over the field of a smooth error along the ray, new for every cell
    scan_error: float = 0.0  # rms of another smooth error along the ray, new in every scan
    scan_error_length: float = 0.15  # sigma of its correlation over the field, as a share of that
    mixed_pixels: float = 0.0  # share of edge pixels that lie between front and back
    edge_bias: float = 0.0  # pixels within two of an edge lie this much too far
    grazing: float = 78.0  # incidence from which nothing returns; fewer and fewer do on the way there
    dropout: float = 0.0  # share lost on the darkest surface
    quantisation: float = 0.0  # step of the range
    intensity_noise: float = 0.02  # relative
    sweep: float = 120.0  # length of a sweep of a line scanner, along y
    speed: float = 100.0  # mm/s of that sweep
    exposure: float = 0.0  # s from the first row of an area scanner to the last, while it moves; 0 takes all at once


@dataclass(frozen=True)
class Cloud:
    """Points (N, 3) in the scanner frame and their scalars (N,)."""

    points: Array
    intensity: Array
    incidence: Array = field(repr=False)  # cosine, for nature only: no scanner knows it
    time: Array | None = None  # s after the view's time, of scanners that move meanwhile


def half_field(scanner: Scanner) -> Array:
    """(2,) largest x/z and y/z that the scanner sees."""
    y = scanner.field_of_view_y or scanner.field_of_view
    return np.asarray(np.tan(np.radians([scanner.field_of_view / 2, y / 2])))


def rays(scanner: Scanner, rows: slice = slice(None)) -> Array:
    """(rows·columns, 3) directions with z = 1, row by row; all rows or some of them."""
    half_x, half_y = half_field(scanner)
    y = np.linspace(-half_y, half_y, scanner.rows)[rows] if scanner.kind == "area" else np.zeros(1)
    a, b = np.meshgrid(np.linspace(-half_x, half_x, scanner.columns), y)
    return np.stack([a.ravel(), b.ravel(), np.ones(a.size)], axis=1)


def field_map(scanner: Scanner, rng: np.random.Generator) -> Array:
    """(3, 3) coefficients of the smooth error: cosines over the field, rms `field_error`."""
    weights = rng.standard_normal((3, 3)) / (1 + np.add.outer(np.arange(3), np.arange(3)))
    weights[0, 0] = 0.0  # a constant is no error of the field
    scale = np.sqrt((weights**2 * np.outer([1, 0.5, 0.5], [1, 0.5, 0.5])).sum())
    return np.asarray(weights * scanner.field_error / max(scale, 1e-12))


def scan_waves(scanner: Scanner, directions: Array, rng: np.random.Generator) -> Array:
    """(N,) one draw of the smooth error of a single scan at directions (N, 3) with z = 1, rms `scan_error`.

    A sum of plane waves over the field whose lengths are normal: its correlation falls like a normal density.
    """
    width = 2 * half_field(scanner)[0] * scanner.scan_error_length
    numbers = rng.standard_normal((_WAVES, 2)) / width
    phase = rng.uniform(0, 2 * np.pi, _WAVES)
    return scanner.scan_error * np.sqrt(2 / _WAVES) * np.cos(directions[:, :2] @ numbers.T + phase).sum(axis=1)


def profile_times(scanner: Scanner) -> Array:
    """(rows,) s from the middle of a sweep, or of an area scan that takes a while, to each row."""
    middle = (scanner.rows - 1) / 2
    whole = scanner.sweep / scanner.speed if scanner.kind == "line" else scanner.exposure
    return np.asarray((np.arange(scanner.rows) - middle) * whole / scanner.rows)
