"""An area scanner: a pinhole pattern of rays, cast on a mesh, with noise along the ray."""

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class AreaScanner:
    """Rays leave the scanner's origin around +z. Lengths in the mesh's unit."""

    columns: int = 220
    rows: int = 220
    field_of_view: float = 28.0  # degrees, full, in both directions
    noise: float = 0.02  # 1-sigma along the ray at the standoff; grows with range²
    standoff: float = 420.0
    grazing: float = 80.0  # degrees of incidence beyond which nothing returns


def rays(scanner: AreaScanner) -> Array:
    """(columns·rows, 3) unit directions in the scanner frame."""
    half = np.tan(np.radians(scanner.field_of_view / 2))
    x, y = np.meshgrid(np.linspace(-half, half, scanner.columns), np.linspace(-half, half, scanner.rows))
    directions = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def scan(mesh: trimesh.Trimesh, T_part_scanner: Array, scanner: AreaScanner, rng: np.random.Generator) -> Array:
    """(N, 3) points in the scanner frame of a mesh in the part frame."""
    directions = rays(scanner)
    origin = T_part_scanner[:3, 3]
    cast = directions @ T_part_scanner[:3, :3].T
    hit, ray, triangle = mesh.ray.intersects_location(np.tile(origin, (len(cast), 1)), cast, multiple_hits=False)
    cosine = -np.einsum("ij,ij->i", mesh.face_normals[triangle], cast[ray])
    keep = cosine > np.cos(np.radians(scanner.grazing))
    # Rays come back in the order of the tree; the order of the sensor is that of the file.
    order = np.argsort(ray[keep], kind="stable")
    distance = np.linalg.norm(hit[keep][order] - origin, axis=1)
    sigma = scanner.noise * (distance / scanner.standoff) ** 2
    distance = distance + sigma * rng.standard_normal(len(distance))
    return np.asarray(directions[ray[keep][order]] * distance[:, None])
