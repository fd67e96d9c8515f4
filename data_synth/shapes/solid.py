"""Closed solids: what the parts are cut and joined from, in double precision.

trimesh's own booleans go through single precision, which is 60 nm at 1 m and tears fine fillets.
"""

from collections.abc import Callable, Iterable

import manifold3d
import numpy as np
import trimesh
from manifold3d import CrossSection, Manifold
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def polygon(corners: ArrayLike) -> CrossSection:
    """The inside of (N, 2) corners in counter-clockwise order."""
    return CrossSection([np.ascontiguousarray(corners, dtype=np.float64)])


def circle(radius: float, centre: ArrayLike = (0.0, 0.0), sides: int = 96) -> CrossSection:
    """A regular polygon with its corners on the circle."""
    x, y = np.asarray(centre, dtype=np.float64)
    return CrossSection.circle(radius, sides).translate((x, y))


def rounded(outline: CrossSection, outer: float, inner: float = 0.0, segments: int = 96) -> CrossSection:
    """Round convex corners with radius `outer` and concave ones with radius `inner`."""
    join = manifold3d.JoinType.Round
    for step in (-outer, outer + inner, -inner):
        outline = outline.offset(step, join, circular_segments=segments) if step else outline
    return outline


def extrude(outline: CrossSection, low: float, high: float, axis: str = "z", divisions: int = 0) -> Manifold:
    """A prism between two positions along an axis.

    The outline's (x, y) become (x, y) for axis z, (y, z) for axis x and (x, z) for axis y.
    """
    prism = outline.extrude(high - low, divisions).translate((0.0, 0.0, low))
    turns = {
        "z": np.eye(3),
        "x": np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]]),
        # Two axes swap: a mirror, which manifold3d answers by turning the triangles round.
        "y": np.array([[1, 0, 0], [0, 0, 1], [0, 1, 0]]),
    }
    return prism.transform(np.column_stack([turns[axis], np.zeros(3)]))


def loft(rings: Array) -> Manifold:
    """Skin over (K, N, 3) counter-clockwise rings, each flat in its own z, from the lowest to the highest."""
    count, n = rings.shape[:2]
    here = np.arange(n)
    following = (here + 1) % n
    faces = []
    for start in n * np.arange(count - 1):
        a, b = start + here, start + following
        faces += [np.column_stack([a, b, b + n]), np.column_stack([a, b + n, a + n])]
    faces.append(manifold3d.triangulate([np.ascontiguousarray(rings[0, :, :2])])[:, ::-1])
    faces.append(manifold3d.triangulate([np.ascontiguousarray(rings[-1, :, :2])]) + n * (count - 1))
    return from_arrays(rings.reshape(-1, 3), np.vstack(faces))


def slab(upper: Array, lower: Array) -> Manifold:
    """The solid between two (M, N, 3) grids; from row to column turns right-handed about upper's outside."""
    m, n = upper.shape[:2]
    index = np.arange(m * n).reshape(m, n)
    a, b, c, d = (index[s].ravel() for s in (np.s_[:-1, :-1], np.s_[1:, :-1], np.s_[1:, 1:], np.s_[:-1, 1:]))
    top = np.vstack([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    rim = np.concatenate([index[:-1, 0], index[-1, :-1], index[:0:-1, -1], index[0, :0:-1]])
    following = np.roll(rim, -1)
    sides = np.vstack(
        [
            np.column_stack([rim, rim + m * n, following + m * n]),
            np.column_stack([rim, following + m * n, following]),
        ]
    )
    points = np.concatenate([upper.reshape(-1, 3), lower.reshape(-1, 3)])
    return from_arrays(points, np.vstack([top, top[:, ::-1] + m * n, sides]))


def union(solids: Iterable[Manifold]) -> Manifold:
    """All of them as one solid."""
    return Manifold.batch_boolean(list(solids), manifold3d.OpType.Add)


def warp(solid: Manifold, move: Callable[[Array], Array]) -> Manifold:
    """The solid with its vertices (N, 3) moved by a function."""
    return solid.warp_batch(lambda points: move(np.asarray(points)))


def refined(solid: Manifold, length: float) -> Manifold:
    """The solid with no edge longer than a length in mm."""
    count = 0
    # One pass leaves longer edges inside slivers.
    while count != solid.num_tri():
        count = solid.num_tri()
        solid = solid.refine_to_length(length)
    return solid


def from_arrays(points: Array, faces: ArrayLike) -> Manifold:
    """A solid of closed, outward triangles. Raises ValueError where they are not closed."""
    mesh = manifold3d.Mesh64(
        np.ascontiguousarray(points, dtype=np.float64), np.ascontiguousarray(faces, dtype=np.uint64)
    )
    solid = Manifold(mesh)
    if solid.status() != manifold3d.Error.NoError:
        raise ValueError(f"the triangles do not enclose a solid: {solid.status().name}")
    return solid


def to_mesh(solid: Manifold) -> trimesh.Trimesh:
    """The solid as a mesh; vertices and faces sorted, so that equal solids give equal bytes.

    Raises ValueError for an empty solid: the parameters leave no material.
    """
    if solid.is_empty():
        raise ValueError("the parameters leave no material")
    data = solid.to_mesh64()
    points, faces = np.asarray(data.vert_properties)[:, :3], np.asarray(data.tri_verts, dtype=np.int64)
    order = np.lexsort(points.T[::-1])
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    faces = place[faces]
    first = faces.argmin(axis=1)
    faces = faces[np.arange(len(faces))[:, None], (first[:, None] + np.arange(3)) % 3]
    return trimesh.Trimesh(points[order], faces[np.lexsort(faces.T[::-1])], process=False)
