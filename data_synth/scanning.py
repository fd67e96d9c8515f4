"""One scan: rays cast on a mesh, and what a real scanner does to the points.

Noise along the ray that grows with range squared, a smooth error over the field of its own, mixed
pixels at edges, drop-outs at grazing incidence and on dark surfaces, quantisation, intensity.
"""

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from data_synth.scanner import Cloud, Scanner, half_field, profile_times, rays, scan_waves

Array = NDArray[np.float64]
_BLOCK = 1 << 18  # rays cast at a time


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
    """One view: T_part_scanner (4, 4), or (K, 4, 4) for the K rows of a scanner that moves meanwhile.

    Points of such a scanner are given in the frame of their own row.
    """
    # Block by block: a hundred numbers a ray would fill the memory where a view has millions.
    blocks = _blocks(scanner)
    distance, cosine, albedo = np.empty((3, scanner.rows, scanner.columns))
    for rows in blocks:
        directions, poses = _aim(scanner, T_part_scanner, rows)
        _, far, cos = cast(mesh, poses, directions)
        shape = (-1, scanner.columns)
        distance[rows], cosine[rows] = far.reshape(shape), cos.reshape(shape)
        albedo[rows] = _albedo(far, directions, poses).reshape(shape)
    if scanner.edge_bias:
        distance += scanner.edge_bias * _beside_an_edge(distance, scanner)
    _mix(distance, scanner, rng, blocks)
    seen = np.concatenate([_returned(distance, cosine, albedo, scanner, rows, rng) for rows in blocks])
    d = np.concatenate([_aim(scanner, T_part_scanner, rows)[0][seen[rows].ravel()] for rows in blocks])
    r, cos, bright = distance[seen], cosine[seen], albedo[seen]
    sigma = scanner.noise * (r / scanner.standoff) ** 2
    r = r + sigma * _white(scanner, len(r), rng) + _field(d, scanner, field_weights)
    if scanner.scan_error:
        r = r + scan_waves(scanner, d, rng)
    if scanner.quantisation:
        r = np.round(r / scanner.quantisation) * scanner.quantisation
    intensity = bright * cos * (scanner.standoff / r) ** 2
    intensity *= 1 + scanner.intensity_noise * rng.standard_normal(len(r))
    points = d * (r / np.linalg.norm(d, axis=1))[:, None]
    time = profile_times(scanner)[np.nonzero(seen)[0]] if T_part_scanner.ndim == 3 else None
    return Cloud(points, intensity, cos, time)


def _blocks(scanner: Scanner) -> list[slice]:
    rows = max(1, _BLOCK // scanner.columns)
    return [slice(first, min(first + rows, scanner.rows)) for first in range(0, scanner.rows, rows)]


def _aim(scanner: Scanner, T_part_scanner: Array, rows: slice) -> tuple[Array, Array]:
    """Directions of some rows, and the pose that they share (4, 4) or one for each."""
    directions = rays(scanner, rows)
    if T_part_scanner.ndim == 2:
        return directions, T_part_scanner
    poses = T_part_scanner[rows]
    if scanner.kind == "line":
        directions = np.tile(directions, (len(poses), 1))
    return directions, np.repeat(poses, scanner.columns, axis=0)


def _albedo(distance: Array, directions: Array, T_part_scanner: Array) -> Array:
    """0.25 … 1: a smooth pattern fixed to the part, 15 to 60 mm in size."""
    reach = np.where(np.isfinite(distance), distance, 0.0)
    local = directions * (reach / np.linalg.norm(directions, axis=1))[:, None]
    R, t = T_part_scanner[..., :3, :3], T_part_scanner[..., :3, 3]
    p = (local @ R.T if R.ndim == 2 else np.einsum("rij,rj->ri", R, local)) + t
    waves = np.sin(p @ [0.11, 0.05, 0.09]) + np.sin(p @ [-0.04, 0.23, 0.06] + 1.0) + np.sin(p @ [0.2, -0.11, -0.21])
    return np.asarray(0.625 + 0.125 * waves)


def _white(scanner: Scanner, count: int, rng: np.random.Generator) -> Array:
    """(count,) numbers of variance 1."""
    if not scanner.tail:
        return rng.standard_normal(count)
    return np.asarray(rng.standard_t(scanner.tail, count) * np.sqrt(1 - 2 / scanner.tail))


def _beside_an_edge(image: Array, scanner: Scanner) -> NDArray[np.bool_]:
    """Pixels within two of a jump or of the background, along rows and columns."""
    missing = ~np.isfinite(image)
    edge = missing | _edges(image, scanner)
    return np.asarray(binary_dilation(edge, iterations=2) & ~missing)


def _mix(image: Array, scanner: Scanner, rng: np.random.Generator, blocks: list[slice]) -> None:
    """Pixels on an edge see front and back at once and report something between; changes the ranges in place."""
    if not scanner.mixed_pixels:
        return
    chosen = [_edges(image[rows], scanner) & (rng.random(image[rows].shape) < scanner.mixed_pixels) for rows in blocks]
    for rows, edge in zip(blocks, chosen, strict=True):
        share = rng.random(edge.shape)[edge]
        here = image[rows]
        beside = np.roll(here, 1, axis=1)[edge]
        here[edge] += share * (beside - here[edge])


def _edges(image: Array, scanner: Scanner) -> NDArray[np.bool_]:
    """Pixels that stand far before or behind their left neighbour."""
    pixel = 2 * np.tan(np.radians(scanner.field_of_view / 2)) / scanner.columns
    edge = np.zeros(image.shape, bool)
    with np.errstate(invalid="ignore"):
        step = image[:, :-1] - image[:, 1:]
        # Steeper than 80° between neighbours is a jump, not a surface.
        edge[:, 1:] = np.isfinite(step) & (np.abs(step) > 6 * pixel * image[:, 1:])
    return edge


def _returned(
    distance: Array, cosine: Array, albedo: Array, scanner: Scanner, rows: slice, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Which rays of some rows come back; all images are (rows, columns)."""
    distance, cosine, albedo = distance[rows], cosine[rows], albedo[rows]
    slant = np.linalg.norm(rays(scanner, rows), axis=1).reshape(-1, scanner.columns)
    depth = distance / slant
    seen = np.isfinite(distance) & (np.abs(depth - scanner.standoff) < scanner.depth_of_field / 2)
    limit = np.cos(np.radians(scanner.grazing))
    fading = np.clip((cosine - limit) / (0.5 * limit), 0.0, 1.0)
    dark = 1.0 - scanner.dropout * np.clip((0.5 - albedo) / 0.25, 0.0, 1.0)
    return np.asarray(seen & (rng.random(distance.shape) < fading * dark))


def _field(directions: Array, scanner: Scanner, weights: Array) -> Array:
    """Smooth error along the ray at directions (N, 3) with z = 1."""
    if not scanner.field_error:
        return np.zeros(len(directions))
    u, v = (np.pi * (directions[:, :2] / half_field(scanner) + 1) / 2).T
    return np.asarray(
        np.einsum("ij,in,jn->n", weights, np.cos(np.outer(np.arange(3), u)), np.cos(np.outer(np.arange(3), v)))
    )
