"""Scanners: rays cast on a mesh, and what a real one does to the points.

Noise along the ray that grows with range squared, a smooth error over the field of its own, mixed
pixels at edges, drop-outs at grazing incidence and on dark surfaces, quantisation, intensity.
"""

from dataclasses import dataclass, field

import numpy as np
import trimesh
from numpy.typing import NDArray

Array = NDArray[np.float64]


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
    field_error: float = 0.0  # rms over the field of a smooth error along the ray, new for every cell
    mixed_pixels: float = 0.0  # share of edge pixels that lie between front and back
    grazing: float = 78.0  # incidence from which nothing returns; fewer and fewer do on the way there
    dropout: float = 0.0  # share lost on the darkest surface
    quantisation: float = 0.0  # step of the range
    intensity_noise: float = 0.02  # relative
    sweep: float = 120.0  # length of a sweep of a line scanner, along y
    speed: float = 100.0  # mm/s of that sweep


@dataclass(frozen=True)
class Cloud:
    """Points (N, 3) in the scanner frame and their scalars (N,)."""

    points: Array
    intensity: Array
    incidence: Array = field(repr=False)  # cosine, for nature only: no scanner knows it
    time: Array | None = None  # s after the view's time, line scanners only


def half_field(scanner: Scanner) -> Array:
    """(2,) largest x/z and y/z that the scanner sees."""
    y = scanner.field_of_view_y or scanner.field_of_view
    return np.asarray(np.tan(np.radians([scanner.field_of_view / 2, y / 2])))


def rays(scanner: Scanner) -> Array:
    """(rows·columns, 3) directions with z = 1, row by row."""
    half_x, half_y = half_field(scanner)
    y = np.linspace(-half_y, half_y, scanner.rows) if scanner.kind == "area" else np.zeros(1)
    a, b = np.meshgrid(np.linspace(-half_x, half_x, scanner.columns), y)
    return np.stack([a.ravel(), b.ravel(), np.ones(a.size)], axis=1)


def field_map(scanner: Scanner, rng: np.random.Generator) -> Array:
    """(3, 3) coefficients of the smooth error: cosines over the field, rms `field_error`."""
    weights = rng.standard_normal((3, 3)) / (1 + np.add.outer(np.arange(3), np.arange(3)))
    weights[0, 0] = 0.0  # a constant is no error of the field
    scale = np.sqrt((weights**2 * np.outer([1, 0.5, 0.5], [1, 0.5, 0.5])).sum())
    return np.asarray(weights * scanner.field_error / max(scale, 1e-12))


def cast(mesh: trimesh.Trimesh, T_part_scanner: Array, directions: Array) -> tuple[NDArray[np.int64], Array, Array]:
    """First hits of rays: triangle (−1 none), range along the unit ray (inf), cosine of incidence.

    Args:
        T_part_scanner: (4, 4) for all rays or (R, 4, 4) one each.
        directions: (R, 3) in the scanner frame, any length.
    """
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    R, origin = T_part_scanner[..., :3, :3], T_part_scanner[..., :3, 3]
    ray = unit @ R.T if R.ndim == 2 else np.einsum("rij,rj->ri", R, unit)
    origins = np.ascontiguousarray(np.broadcast_to(origin, ray.shape))
    triangle = np.asarray(mesh.ray.intersects_first(origins, ray), np.int64)
    hit = triangle >= 0
    # The caster works in single precision and only says which triangle; its plane gives the range in double.
    normal, corner = mesh.face_normals[triangle], mesh.triangles[:, 0][triangle]
    slope = np.einsum("ij,ij->i", normal, ray)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.einsum("ij,ij->i", corner - origins, normal) / slope
    # A ray from inside or along the surface sees nothing.
    hit &= slope < -1e-6
    return triangle, np.where(hit, distance, np.inf), np.where(hit, -slope, 0.0)


def scan(
    mesh: trimesh.Trimesh, T_part_scanner: Array, scanner: Scanner, field_weights: Array, rng: np.random.Generator
) -> Cloud:
    """One view: T_part_scanner (4, 4), or (K, 4, 4) for the K profiles of a line scanner.

    Points of a line scanner are given in the frame of their own profile.
    """
    directions = rays(scanner)
    time = None
    if scanner.kind == "line":
        profiles = len(T_part_scanner)
        time = np.repeat((np.arange(profiles) - (profiles - 1) / 2) * scanner.sweep / profiles / scanner.speed,
                         len(directions))  # fmt: skip
        T_part_scanner = np.repeat(T_part_scanner, len(directions), axis=0)
        directions = np.tile(directions, (profiles, 1))
    _, distance, cosine = cast(mesh, T_part_scanner, directions)
    albedo = _albedo(distance, directions, T_part_scanner)
    distance = _mixed(distance.reshape(scanner.rows, scanner.columns), scanner, rng).ravel()
    seen = _returned(distance, cosine, albedo, directions, scanner, rng)
    d, r, cos = directions[seen], distance[seen], cosine[seen]
    sigma = scanner.noise * (r / scanner.standoff) ** 2
    r = r + sigma * rng.standard_normal(len(r)) + _field(d, scanner, field_weights)
    if scanner.quantisation:
        r = np.round(r / scanner.quantisation) * scanner.quantisation
    intensity = albedo[seen] * cos * (scanner.standoff / r) ** 2
    intensity *= 1 + scanner.intensity_noise * rng.standard_normal(len(r))
    points = d * (r / np.linalg.norm(d, axis=1))[:, None]
    return Cloud(points, intensity, cos, None if time is None else time[seen])


def _albedo(distance: Array, directions: Array, T_part_scanner: Array) -> Array:
    """0.25 … 1: a smooth pattern fixed to the part, 15 to 60 mm in size."""
    reach = np.where(np.isfinite(distance), distance, 0.0)
    local = directions * (reach / np.linalg.norm(directions, axis=1))[:, None]
    R, t = T_part_scanner[..., :3, :3], T_part_scanner[..., :3, 3]
    p = (local @ R.T if R.ndim == 2 else np.einsum("rij,rj->ri", R, local)) + t
    waves = np.sin(p @ [0.11, 0.05, 0.09]) + np.sin(p @ [-0.04, 0.23, 0.06] + 1.0) + np.sin(p @ [0.2, -0.11, -0.21])
    return np.asarray(0.625 + 0.125 * waves)


def _mixed(image: Array, scanner: Scanner, rng: np.random.Generator) -> Array:
    """Pixels on an edge see front and back at once and report something between."""
    if not scanner.mixed_pixels:
        return image
    beside = np.full_like(image, np.inf)
    beside[:, 1:] = image[:, :-1]
    pixel = 2 * np.tan(np.radians(scanner.field_of_view / 2)) / scanner.columns
    with np.errstate(invalid="ignore"):
        step = beside - image
        # Steeper than 80° between neighbours is a jump, not a surface.
        edge = np.isfinite(step) & (np.abs(step) > 6 * pixel * image)
    chosen = edge & (rng.random(image.shape) < scanner.mixed_pixels)
    return np.where(chosen, image + rng.random(image.shape) * np.where(edge, step, 0.0), image)


def _returned(
    distance: Array, cosine: Array, albedo: Array, directions: Array, scanner: Scanner, rng: np.random.Generator
) -> NDArray[np.bool_]:
    depth = distance / np.linalg.norm(directions, axis=1)
    seen = np.isfinite(distance) & (np.abs(depth - scanner.standoff) < scanner.depth_of_field / 2)
    limit = np.cos(np.radians(scanner.grazing))
    fading = np.clip((cosine - limit) / (0.5 * limit), 0.0, 1.0)
    dark = 1.0 - scanner.dropout * np.clip((0.5 - albedo) / 0.25, 0.0, 1.0)
    return seen & (rng.random(len(distance)) < fading * dark)


def _field(directions: Array, scanner: Scanner, weights: Array) -> Array:
    """Smooth error along the ray at directions (N, 3) with z = 1."""
    if not scanner.field_error:
        return np.zeros(len(directions))
    u, v = (np.pi * (directions[:, :2] / half_field(scanner) + 1) / 2).T
    return np.asarray(
        np.einsum("ij,in,jn->n", weights, np.cos(np.outer(np.arange(3), u)), np.cos(np.outer(np.arange(3), v)))
    )
