"""A casting: the part with stock on it, every facet moved out along its own normal."""

from collections.abc import Callable

import numpy as np
import trimesh
from numpy.typing import NDArray

Array = NDArray[np.float64]


def with_stock(mesh: trimesh.Trimesh, stock: Callable[[Array], Array]) -> trimesh.Trimesh:
    """The mesh grown by `stock` (N,) in mm at places (N, 3) of it; negative is too little.

    Facets part at convex edges and cross at concave ones. Both gaps and crossings are as wide as the stock; what lies
    on a facet is exact.
    """
    corners = np.asarray(mesh.triangles)  # (F, 3, 3)
    grown = corners + stock(corners.reshape(-1, 3)).reshape(-1, 3, 1) * mesh.face_normals[:, None]
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    return trimesh.Trimesh(grown.reshape(-1, 3), faces, process=False)


def around(mesh: trimesh.Trimesh, views: int, distance: float, rng: np.random.Generator) -> Array:
    """T_part_scanner (V, 4, 4): from all around the part's z, turn about above and below, leaned a little."""
    poses = []
    middle = mesh.bounds.mean(axis=0)
    for view in range(views):
        turn = 2 * np.pi * view / views + rng.uniform(-0.1, 0.1)
        rise = (0.5 if view % 2 else -0.5) + rng.uniform(-0.15, 0.15)
        z = -np.array([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)])
        x = np.cross([0.0, 0.0, 1.0], z)
        x /= np.linalg.norm(x)
        T = np.eye(4)
        T[:3, :3] = np.column_stack([x, np.cross(z, x), z])
        T[:3, 3] = middle - distance * z
        poses.append(T)
    return np.array(poses)
