"""A triangle mesh of the fused cloud, on request."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pykdtree.kdtree import KDTree

from stitch.errors import NoResultError
from stitch.numerics.frames import Array, Indices
from stitch.system.ply_file import write_ply
from stitch.system.threads import parallel

# A cell's edge is one spacing of the points: finer, and cells on the surface have no point beside them; coarser, and
# sheets are lost that are thinner than a cell. At least this share of the largest side bounds memory and time.
_CELL_SHARE = 1 / 512
# Points that say how far the surface lies: enough to average the noise, few enough to follow a fillet.
_NEIGHBOURS = 16
# A cell with a corner farther than so many cells from all points holds no surface: the mesh ends where the points do.
_REACH = 2.5
# The mesh reaches at most so many cells beyond the last points: holes between points are narrower.
_OVERHANG = 1.0
# Points that tell the spacing; places that are worked on at a time, as many as stay in a core's cache.
_SAMPLES, _IN_CACHE = 20_000, 4096
# Ends where the points do; closed; with a tenth of the triangles. Open3D makes the latter two.
OPEN, WATERTIGHT, LIGHT = KINDS = ("open", "watertight", "light")
NO_SURFACE = "no mesh: the fused points span no surface; run without --mesh"
# In the order in which libigl counts the corners of a cell.
_CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])


@dataclass(frozen=True)
class TriangleMesh:
    """V vertices and T triangles, counter-clockwise seen from outside."""

    vertices: Array  # (V, 3)
    triangles: Indices  # (T, 3)


def write_mesh(mesh: TriangleMesh, path: Path) -> None:
    """Write a mesh as binary PLY."""
    vertices = np.empty(len(mesh.vertices), [(axis, "<f8") for axis in "xyz"])
    for axis, column in zip("xyz", mesh.vertices.T, strict=True):
        vertices[axis] = column
    faces = np.empty(len(mesh.triangles), [("vertex_indices", "<i4", (3,))])
    faces["vertex_indices"] = mesh.triangles
    write_ply(path, {"vertex": vertices, "face": faces})


def mesh_of(points: Array, normals: Array, outside: float = 0.0) -> TriangleMesh:
    """Return the surface through points (N, 3) with unit normals (N, 3), open where there are no points.

    Marching cubes (Lorensen & Cline 1987) find the zero of a signed distance: that from the weighted tangent planes of
    the nearest points, implicit moving least squares (Kolluri 2008). Only cells near points are searched, so that no
    hole is closed.

    Args:
        outside: offset in cell edges. The surface at this distance is found first, then its vertices are moved back.
            A sheet thinner than a cell would have no corner of a cell inside it, and be missed.

    Raises:
        NoResultError: the points span no surface.
    """
    import igl

    if len(points) < _NEIGHBOURS:
        raise NoResultError(NO_SURFACE)
    tree = KDTree(np.ascontiguousarray(points, float))
    size = max(spacing(points, tree), _CELL_SHARE * float(np.ptp(points, axis=0).max()))
    places, cells = _cells_about(points, size)
    heights, nearest = _heights(places, points, normals, tree, size)
    cells = cells[(nearest < _REACH * size)[cells].all(axis=1)]
    vertices, triangles, _ = igl.marching_cubes(heights, places, cells, outside * size)
    # Beyond the rim of the points the tangent planes run on: triangles too far from every point are dropped.
    gap, nearest = tree.query(vertices, k=1)
    triangles = triangles[(gap < np.hypot(_OVERHANG, outside) * size)[triangles].all(axis=1)]
    if not len(triangles):
        raise NoResultError(NO_SURFACE)
    kept, triangles = np.unique(triangles, return_inverse=True)
    vertices, nearest = vertices[kept], nearest[kept].astype(np.int64)
    if outside:
        vertices = vertices - _heights(vertices, points, normals, tree, size)[0][:, None] * normals[nearest]
    return TriangleMesh(vertices, triangles.reshape(-1, 3))


def spacing(points: Array, tree: Any) -> float:
    """Return the mean spacing of points (N, 3), the edge of the square of surface per point, in their unit.

    The disc of radius r to the 8th neighbour holds 8 squares s²: s = r √(π/8), the median over a sample of the points.

    Args:
        tree: KDTree of the points.
    """
    distance, _ = tree.query(points[:: max(1, len(points) // _SAMPLES)], k=9)
    return float(np.median(distance[:, -1]) * np.sqrt(np.pi / 8))


def _cells_about(points: Array, size: float) -> tuple[Array, Indices]:
    """Return the cells of a cubic grid that hold a point or touch such a cell, by their corners.

    Returns:
        Positions (P, 3) of the corners, each once; and (C, 8) indices of the corners of each cell, in the order of
        `_CORNERS`.
    """
    # A margin of two cells: neighbours of the outermost cells have indices inside the grid.
    origin = points.min(axis=0) - 2 * size
    cell = np.floor((points - origin) / size).astype(np.int64)
    shape = cell.max(axis=0) + 3
    # A cell or corner (i, j, k) as one number.
    steps = np.array([shape[1] * shape[2], shape[2], 1])
    around = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    keys = np.unique(np.unique(cell @ steps)[:, None] + around @ steps)
    corners, cells = np.unique(keys[:, None] + _CORNERS @ steps, return_inverse=True)
    places = origin + size * np.stack(np.unravel_index(corners, shape), axis=1)
    return places, cells.reshape(-1, 8).astype(np.int64)


def _heights(places: Array, points: Array, normals: Array, tree: Any, size: float) -> tuple[Array, Array]:
    """Return the signed distance of P places from the surface through N points, and that from the nearest point.

    It is the weighted mean of (place − point)·(normal + n̄) / 2 over the nearest points, n̄ their mean normal. Weights
    are exp(−(d² − d₀²) / size²) for distances d, d₀ the least, times the cosine to the normal of the nearest point.

    Args:
        places: (P, 3), in the frame and unit of the points.
        points, normals: (N, 3); normals of unit length, outwards.
        tree: KDTree of the points.
        size: edge of a cell, and width of the weights.

    Returns:
        Signed distances (P,), positive outside; distances (P,) from the nearest point.
    """
    # Coordinates first, then neighbours, each in one piece: sums over rows of three or sixteen take longer.
    point_columns = np.ascontiguousarray(points.T)
    normal_columns = np.ascontiguousarray(normals.T)

    def heights_of(block: Array) -> tuple[Array, Array]:
        """Return both distances (B,) of a block of places (B, 3); arrays are (axis i, neighbour k, place p)."""
        distance, index = (np.ascontiguousarray(x.T) for x in tree.query(block, k=_NEIGHBOURS))
        facing = np.array([column.take(index) for column in normal_columns])
        away = np.array([at - column.take(index) for column, at in zip(point_columns, block.T, strict=True)])
        # Normals that face away belong to the other side of a thin sheet: their weight is zero.
        cosine = np.maximum(np.einsum("ikp,ip->kp", facing, facing[:, 0]), 0)
        weight = cosine * np.exp((distance[0] ** 2 - distance**2) / size**2)
        weight /= weight.sum(axis=0)
        mean = np.einsum("kp,ikp->ip", weight, facing)
        mean /= np.sqrt(np.einsum("ip,ip->p", mean, mean))
        # Tangent planes at the points lie above a convex surface, one at the place with the mean normal below it: on a
        # ball the mean of both normals is exact, as in symmetric ICP (Rusinkiewicz 2019).
        facing += mean[:, None]
        return np.einsum("kp,kp->p", weight, np.einsum("ikp,ikp->kp", facing, away)) / 2, distance[0]

    blocks = parallel(heights_of, np.array_split(places, len(places) // _IN_CACHE + 1), "blocks of the mesh")
    heights, nearest = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    return heights, nearest
