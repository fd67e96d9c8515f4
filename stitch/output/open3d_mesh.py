"""Meshes that Open3D makes of the fused cloud: closed, or with a tenth of the triangles."""

import numpy as np
from pykdtree.kdtree import KDTree
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from stitch.errors import NoResultError
from stitch.numerics.frames import Array, Indices
from stitch.numerics.units import length_text
from stitch.output.mesh import LIGHT, NO_SURFACE, WATERTIGHT, TriangleMesh, mesh_of, spacing
from stitch.run_data import FusedCloud
from stitch.system.open3d_library import import_open3d

# Poisson counts the density of points in levels of its octree. Where it is so many levels below the median, one point
# stands for eight: nobody looked there, and the surface is the solver's own.
_SPARSE_LEVELS = 1.5
_FEWEST_POINTS = 100
# Poisson solves in a cube so many times as large as the points' box.
_BOX_SCALE = 1.1
# Parts with a smaller share of the largest one's triangles are scraps of the trimming.
_PART_SHARE = 0.01
_LIGHT_SHARE = 0.1
# Points that say how far the mesh is off the cloud.
_ASKED = 20_000
_SEEN_SPACINGS = 2.5


def make_mesh(cloud: FusedCloud, kind: str) -> "tuple[TriangleMesh, MeshFit]":
    """Return a mesh of the fused points and how far off them it lies; reference frame, length_unit.

    Args:
        kind: "open" ends where the points do, "watertight" is closed, "light" is open with a tenth of the triangles.

    Raises:
        InputError: Open3D is not installed, or lacks a library of the system.
        NoResultError: the points span no surface.
    """
    if kind == WATERTIGHT:
        mesh = watertight(cloud.points, cloud.normals)
    else:
        mesh = mesh_of(cloud.points, cloud.normals)
        mesh = light(mesh, max(1, round(_LIGHT_SHARE * len(mesh.triangles)))) if kind == LIGHT else mesh
    return mesh, MeshFit(mesh, cloud.points)


def watertight(points: Array, normals: Array) -> TriangleMesh:
    """Return the closed surface through points (N, 3) with unit normals (N, 3).

    Screened Poisson reconstruction (Kazhdan & Hoppe 2013), trimmed where its points are sparse. Each opening that the
    trimming leaves is closed by triangles from its middle. One thread solves, so that results repeat to the last bit.

    Raises:
        InputError: Open3D is not installed, or lacks a library of the system.
        NoResultError: the points span no surface.
    """
    o3d = import_open3d("--mesh watertight")
    if len(points) < _FEWEST_POINTS:
        raise NoResultError(NO_SURFACE)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.asarray(points, float)))
    cloud.normals = o3d.utility.Vector3dVector(np.asarray(normals, float))
    solve = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        surface, density = solve(cloud, depth=_octree_depth(points), scale=_BOX_SCALE, n_threads=1)
    # Density of the points at each vertex, as a level of the octree: one level less has an eighth of the points.
    levels = np.asarray(density)
    triangles = np.asarray(surface.triangles, np.int64)
    triangles = triangles[(levels > np.median(levels) - _SPARSE_LEVELS)[triangles].all(axis=1)]
    return _capped(np.asarray(surface.vertices), _large_parts(_without_pinches(triangles)))


def light(mesh: TriangleMesh, triangles: int) -> TriangleMesh:
    """Return a mesh simplified to about `triangles` triangles, by quadric error metrics (Garland & Heckbert 1997).

    Raises:
        InputError: Open3D is not installed, or lacks a library of the system.
    """
    o3d = import_open3d("--mesh light")
    whole = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices), o3d.utility.Vector3iVector(mesh.triangles.astype(np.int32))
    )
    simplified = whole.simplify_quadric_decimation(triangles)
    return TriangleMesh(np.asarray(simplified.vertices), np.asarray(simplified.triangles, np.int64))


class MeshFit:
    """How far a mesh lies from the points (N, 3) that it was made of, in the same frame and unit."""

    def __init__(self, mesh: TriangleMesh, points: Array) -> None:
        """Measure the distance of up to `_ASKED` points (N, 3) from a mesh, and the area of the mesh far from any."""
        import igl

        tree = KDTree(np.ascontiguousarray(points, float))
        asked = np.ascontiguousarray(points[:: max(1, len(points) // _ASKED)], float)
        distance = np.sqrt(igl.point_mesh_squared_distance(asked, mesh.vertices, mesh.triangles)[0])
        corners = mesh.vertices[mesh.triangles]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        far = tree.query(corners.mean(axis=1))[0] > _SEEN_SPACINGS * spacing(points, tree)
        self.triangles = len(mesh.triangles)
        self.closed = not len(igl.boundary_facets(mesh.triangles)[0])  # every edge belongs to two triangles
        self.median, self.p95 = map(float, np.quantile(distance, [0.5, 0.95]))  # of the points from the mesh
        self.unseen = float(area[far].sum() / area.sum())  # share of the area far from all points

    def sentence(self, length_unit: str) -> str:
        """Return the numbers as sentences for people; those on unseen area only of a closed mesh."""
        unseen = f" Nobody looked at {self.unseen:.0%} of its area." if self.closed else ""
        return (
            f"mesh.ply: {'closed' if self.closed else 'open'}, {self.triangles:,} triangles. Half of the fused points "
            f"lie within {length_text(self.median, length_unit)} of it, 95 % within "
            f"{length_text(self.p95, length_unit)}.{unseen}"
        )


def _octree_depth(points: Array) -> int:
    """Return the least depth at which an octree's cell is no larger than the spacing of points (N, 3).

    The octree's cube is `_BOX_SCALE` times as large as the points' longest side; each level halves its cells.
    """
    size = float(np.ptp(points, axis=0).max())
    return int(np.ceil(np.log2(_BOX_SCALE * size / spacing(points, KDTree(np.ascontiguousarray(points, float))))))


def _without_pinches(triangles: Indices) -> Indices:
    """Return triangles (M, 3) without those at a vertex where two openings meet.

    There two boundary edges begin, and openings could not be told apart. Removal may create new such vertices, hence
    the loop; it ends since triangles only become fewer.
    """
    import igl

    while len(triangles):
        pinched = np.bincount(igl.boundary_facets(triangles)[0][:, 0], minlength=triangles.max() + 1) > 1
        if not pinched.any():
            break
        triangles = triangles[~pinched[triangles].any(axis=1)]
    return triangles


def _large_parts(triangles: Indices) -> Indices:
    """Return those of triangles (T, 3) in connected parts with at least `_PART_SHARE` of the largest part's triangles.

    Raises:
        NoResultError: there are no triangles.
    """
    import igl

    if not len(triangles):
        raise NoResultError(NO_SURFACE)
    _, part = igl.facet_components(triangles)
    sizes = np.bincount(part)
    return triangles[(sizes >= _PART_SHARE * sizes.max())[part]]


def _capped(vertices: Array, triangles: Indices) -> TriangleMesh:
    """Return the mesh of vertices (V, 3) and triangles (T, 3) with every opening closed, unused vertices removed.

    Each boundary edge of an opening makes a triangle with the opening's middle, a new vertex: a fan.
    """
    import igl

    rim, _, _ = igl.boundary_facets(triangles)  # directed edges (E, 2)
    chains = coo_array((np.ones(len(rim), bool), rim.T), shape=(len(vertices), len(vertices)))
    of_vertex = connected_components(chains, directed=False)[1]
    # Labels of connected parts, renumbered: opening 0, 1, … of each boundary edge.
    _, opening = np.unique(of_vertex[rim[:, 0]], return_inverse=True)
    count = np.bincount(opening)[:, None]
    middles = np.column_stack([np.bincount(opening, column) for column in vertices[rim[:, 0]].T]) / np.maximum(count, 1)
    fans = np.column_stack([rim[:, ::-1], len(vertices) + opening])
    kept, triangles = np.unique(np.vstack([triangles, fans]), return_inverse=True)
    return TriangleMesh(np.vstack([vertices, middles])[kept], triangles.reshape(-1, 3))
