"""The part as a shaded surface, and how the patches of the field colour it."""

from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from pykdtree.kdtree import KDTree
from scipy.sparse import csr_array

from stitch.errors import NoResultError
from stitch.numerics.frames import Array, Indices
from stitch.output.comparison.disagreement_field import Patches, facing_side, group_points
from stitch.output.mesh import TriangleMesh, mesh_of, spacing
from stitch.run_data import FusedCloud
from stitch.session.scan import even_indices
from stitch.system.packages import unless_missing
from stitch.system.threads import remembered, take_mapped

# From where the part is looked at: what is long stands upright, and the side that shows most comes to the front.

_ELEVATION = np.radians(18.0)
# A part this much longer than wide stands upright although nobody knows where up is.
_LONG = 1.4


class Camera(NamedTuple):
    """Unit vectors in the reference frame."""

    right: Array  # (3,)
    up: Array  # (3,)
    towards: Array  # (3,) from the part to the eye

    @property
    def axes(self) -> Array:
        """(3, 3) rows right, up, towards: part coordinates to the screen's."""
        return np.array([self.right, self.up, self.towards])


def camera_for(points: Array, normals: Array, upright: bool) -> Camera:
    """A camera for points (N, 3) with unit normals (N, 3).

    Args:
        upright: z of the reference frame is up, as in the base of a robot; else what is long stands upright.
    """
    up = np.array([0.0, 0.0, 1.0])
    if not upright:
        values, vectors = np.linalg.eigh(np.cov((points - points.mean(axis=0)).T))
        if values[2] > _LONG**2 * values[1]:
            up = vectors[:, 2] * (1.0 if vectors[2, 2] >= 0 else -1.0)
    aside = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    aside /= np.linalg.norm(aside)
    ahead = np.cross(aside, up)
    angles = np.radians(np.arange(0, 360, 15))[:, None]
    towards = np.cos(_ELEVATION) * (np.cos(angles) * aside + np.sin(angles) * ahead) + np.sin(_ELEVATION) * up
    best = towards[np.maximum(normals @ towards.T, 0).sum(axis=0).argmax()]
    right = np.cross(up, best)
    right /= np.linalg.norm(right)
    return Camera(right, np.cross(best, right), best)


# Points along the part's longest side: what a screen shows, and a page of a few megabytes holds.
_FINENESS = 120
# Many for each of the cells; more would not be seen.
_POINTS = 1_000_000
# Cells by which the surface is sought outside: the sides of the thinnest sheet are one cell apart there.
_OUTSIDE = 0.5
# Share of the triangles up to which a piece of surface for itself is not shown.
_CRUMB = 0.005
# Share of places seen once up to which they are not shown.
_FLYING = 0.25
_NEAREST = 3
_SAME_SIDE = 0.3


@dataclass(frozen=True)
class PartSurface:
    """N vertices with unit normals, reference frame; without triangles where the points span no surface."""

    vertices: Array  # (N, 3)
    normals: Array  # (N, 3)
    triangles: Indices  # (T, 3)
    patch: Indices  # (N, 3) patches about a vertex
    weight: Array  # (N, 3) their weights, sum 1

    def coloured(self, values: Array) -> Array:
        """(N,) values (K,) of the patches between them; NaN where none about a vertex is known."""
        own = values[self.patch]
        weight = np.where(np.isfinite(own), self.weight, 0.0)
        total = weight.sum(axis=1)
        seen = total > 0
        return np.where(seen, (np.nan_to_num(own) * weight).sum(axis=1) / np.where(seen, total, 1.0), np.nan)


class PartShape(NamedTuple):
    """N vertices with unit normals, reference frame; without triangles where the points span no surface."""

    vertices: Array  # (N, 3)
    normals: Array  # (N, 3)
    triangles: Indices  # (T, 3)


def part_surface(fused: FusedCloud, patches: Patches) -> PartSurface:
    """The fused cloud as a mesh of what a screen can show, with the patches about it."""
    points, normals, triangles = part_shape(fused)
    count = min(4 * _NEAREST, len(patches.points))
    distance, index = KDTree(np.ascontiguousarray(patches.points)).query(points, k=count)
    distance, index = distance.reshape(len(points), -1), index.reshape(len(points), -1).astype(np.int64)
    # A thin sheet has two sides, each with patches of its own.
    facing = np.einsum("nki,ni->nk", patches.normals.take(index, axis=0), normals) > _SAME_SIDE
    weight = np.where(facing, 1.0, 1e-6) / (distance**2 + (0.2 * patches.radius) ** 2)
    best = np.argsort(-weight, axis=1)[:, :_NEAREST]
    index, weight = (np.take_along_axis(x, best, axis=1) for x in (index, weight))
    return PartSurface(points, normals, triangles, patch=index, weight=weight / weight.sum(axis=1, keepdims=True))


@remembered
def part_shape(fused: FusedCloud) -> PartShape:
    """The fused cloud as a mesh, made once for page and recording."""
    points, normals = _thinned(fused)
    triangles = np.zeros((0, 3), np.int64)
    with suppress(NoResultError), unless_missing():
        import igl

        mesh = _drawn_in(mesh_of(points, normals, _OUTSIDE), points, normals)
        points, triangles = _level_edges(*_whole_pieces(mesh))
        # A vertex whose triangles have no area has no normal.
        normals = np.nan_to_num(igl.per_vertex_normals(points, triangles))
    return PartShape(points, normals, triangles)


def _whole_pieces(mesh: TriangleMesh) -> tuple[Array, Indices]:
    """Vertices and triangles without the crumbs that lie about the part."""
    import igl

    _, piece = igl.facet_components(mesh.triangles)
    share = np.bincount(piece) / len(piece)
    kept, triangles = np.unique(mesh.triangles[share[piece] > _CRUMB], return_inverse=True)
    return mesh.vertices[kept], triangles.reshape(-1, 3).astype(np.int64)


# Spacings of the points beyond which a vertex is drawn in towards the point next to it, along that point's plane; from
# the second on it is levelled with its neighbours, in so many steps.
_BESIDE, _LOOSE, _STEPS = 0.6, 0.8, 10


def _drawn_in(mesh: TriangleMesh, points: Array, normals: Array) -> TriangleMesh:
    """The mesh without what runs on beyond points (N, 3) with unit normals (N, 3)."""
    import igl

    tree = KDTree(np.ascontiguousarray(points))
    size, nearest = spacing(points, tree), tree.query(mesh.vertices, k=1)[1].astype(np.int64)
    off = mesh.vertices - points[nearest]
    along = off - np.einsum("ni,ni->n", off, normals[nearest])[:, None] * normals[nearest]
    far = np.linalg.norm(along, axis=1)
    vertices = mesh.vertices - (np.maximum(1 - _BESIDE * size / np.maximum(far, 1e-300), 0)[:, None] * along)
    links = igl.adjacency_matrix(mesh.triangles)
    loose = (far > _LOOSE * size) | (links @ (far > _LOOSE * size) > 0)
    count = np.maximum(np.asarray(links.sum(axis=1)), 1).reshape(-1, 1)
    for _ in range(_STEPS):
        vertices[loose] = 0.5 * (vertices + links @ vertices / count)[loose]
    return TriangleMesh(vertices, mesh.triangles)


# The grid of cells leaves teeth along an edge: what is narrower than twice so many triangles is not shown.
_TOOTH = 3
# Steps towards the neighbours along an edge, and the share of the surface that has to be left.
_EDGE_STEPS, _LEFT = 12, 0.8


def _level_edges(vertices: Array, triangles: Indices) -> tuple[Array, Indices]:
    """Vertices and triangles without teeth along open edges (an opening of the surface), the edges levelled."""
    import igl

    next_to = igl.adjacency_matrix(triangles)
    gone = _open_edges(triangles).sum(axis=1) > 0
    for _ in range(_TOOTH - 1):
        gone = gone | (next_to @ gone > 0)
    kept = ~gone
    for _ in range(_TOOTH):
        kept = kept | (next_to @ kept > 0)
    inside = kept[triangles].all(axis=1)
    if inside.mean() < _LEFT:
        return vertices, triangles
    used, own = np.unique(triangles[inside], return_inverse=True)
    vertices, triangles = vertices[used].copy(), own.reshape(-1, 3).astype(np.int64)
    links = _open_edges(triangles)
    # Where edges meet the corner stays.
    along = np.flatnonzero(links.sum(axis=1) == 2)
    for _ in range(_EDGE_STEPS):
        vertices[along] = 0.5 * vertices[along] + 0.25 * (links[along] @ vertices)
    return vertices, triangles


def _open_edges(triangles: Indices) -> csr_array:
    """(N, N) 1 where two of N vertices follow one another along an open edge."""
    import igl

    a, b = igl.boundary_facets(triangles)[0].T
    count = int(triangles.max()) + 1
    return csr_array((np.ones(2 * len(a)), (np.append(a, b), np.append(b, a))), shape=(count, count))


def _thinned(fused: FusedCloud) -> tuple[Array, Array]:
    """(N, 3) mean points and unit normals of cells, both sides of a sheet apart."""
    some = even_indices(len(fused.points), _POINTS)
    once = take_mapped(fused.count, some) < 2
    # Where views meet almost everywhere, what one view alone saw are its flying points.
    keep = ~once | (once.mean() > _FLYING)
    # As stitched.ply holds them: a page that is made anew is the same.
    points, normals = (take_mapped(x, some)[keep].astype("f4").astype(float) for x in (fused.points, fused.normals))
    size = float(np.ptp(points, axis=0).max()) / _FINENESS
    _, point, normal = group_points(points.T, normals.T, facing_side(normals.T), size)
    return point, normal
