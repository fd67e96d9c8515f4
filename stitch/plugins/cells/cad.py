"""The CAD surface: partners of scanned points, regions of the part, and what points count in a fit.

The two sides of a thin sheet are told apart by the way they look. Points are drawn evenly over the directions they
look to (normal-space sampling, Rusinkiewicz & Levoy 2001): on a large smooth sheet the few points of its flanks alone
hold it in its plane. Points and whole cells of the surface are weighted by Tukey's biweight, which is 95 % efficient on
normal noise and lets nothing pull beyond its limit (Huber & Ronchetti 2009).
"""

from bisect import bisect_right
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from pykdtree.kdtree import KDTree

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.distributions import TUKEY, mad_sigma, tukey
from stitch.numerics.frames import Array, Indices
from stitch.plugins.cells.placed_scans import JoinedScans
from stitch.session.reading.text_files import reason_of

# Normals of scan and CAD may differ by 45°: more is the other side of the sheet, or a wall.
_SAME_SIDE = np.cos(np.radians(45.0))
_FAR_SIDE = -0.5
_MOST_SAMPLES = 400_000
# Cells with fewer points have no mean worth judging; their points keep their own weights.
_MIN_CELL_POINTS = 5
_SAMPLED_POINTS = 20_000
# Normals are sorted into cells of a quarter of their unit length: about 15°.
_DIRECTIONS = 4


@dataclass(frozen=True)
class CadSurface:
    """A triangle mesh with two ways to search it; part frame."""

    mesh: Any  # trimesh.Trimesh
    boxes: Any  # igl.AABB: tree of bounding boxes over the triangles
    centre: Array  # (3,)
    size: float  # diagonal of the bounding box
    spacing: float  # of the samples
    samples: Array  # (S, 3) on the surface
    normals: Array  # (S, 3) outwards
    tree: Any  # KDTree over (samples, reach · normals)
    reach: float  # distance that counts as much as normals one radian apart


def read_cad(file: Path) -> CadSurface:
    """Read a mesh (STL, PLY, OBJ …) in length_unit.

    Raises:
        InputError: missing, unreadable or without triangles.
    """
    if not file.is_file():
        raise InputError(f"{file}: not found; to fix: name the CAD model as a mesh, STL, PLY or OBJ")
    try:
        mesh = trimesh.load_mesh(file)
    except Exception as error:
        raise InputError(f"{file}: cannot be read ({reason_of(error)}); to fix: export the mesh again") from None
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise InputError(f"{file}: holds no triangles; to fix: export the CAD model as a triangle mesh")
    return cad_surface(mesh)


def cad_surface(mesh: Any, fineness: float = 800) -> CadSurface:
    """Make a trimesh ready for searching, with so many samples along its diagonal."""
    import igl

    centre = mesh.bounds.mean(axis=0)
    size = float(np.linalg.norm(np.ptp(mesh.bounds, axis=0)))
    boxes = igl.AABB()
    boxes.init(*_arrays(mesh))
    count = int(min(_MOST_SAMPLES, max(5000, mesh.area / (size / fineness) ** 2)))
    samples, faces = trimesh.sample.sample_surface(mesh, count, seed=0)
    normals = np.asarray(mesh.face_normals[faces])
    reach = size / 30
    return CadSurface(
        mesh,
        boxes,
        centre,
        size=size,
        spacing=float(np.sqrt(mesh.area / count)),
        samples=np.asarray(samples),
        normals=normals,
        tree=KDTree(np.hstack([samples, reach * normals])),
        reach=reach,
    )


def nearest_partners(cad: CadSurface, points: Array, normals: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return partners on the CAD of points (N, 3) with normals (N, 3), part frame.

    First the nearest triangle; where that is a thin sheet's far side, the nearest of samples that look the same way.
    A normal that lies between is smeared over an edge and has no partner.

    Returns:
        Distance (N,) along the CAD's normal, positive outside; that normal (N, 3); whether the place is a partner (N,).
    """
    _, face, place = cad.boxes.squared_distance(*_arrays(cad.mesh), np.ascontiguousarray(points, float))
    normal = np.array(cad.mesh.face_normals[face])
    distance, accept = _accept_partners(points - place, normal, normals, 1e-3 * cad.spacing)
    other = np.flatnonzero(np.einsum("ij,ij->i", normal, normals) < _FAR_SIDE)
    if len(other):
        index = sample_partners(cad, points[other], normals[other])
        normal[other] = cad.normals[index]
        off = points[other] - cad.samples[index]
        distance[other], accept[other] = _accept_partners(off, normal[other], normals[other], 2 * cad.spacing)
    return distance, normal, accept


def _arrays(mesh: Any) -> tuple[Array, NDArray[np.int64]]:
    """Return vertices (V, 3) and faces (F, 3) as libigl takes them."""
    return np.ascontiguousarray(mesh.vertices, float), np.ascontiguousarray(mesh.faces, np.int64)


def sample_partners(cad: CadSurface, points: Array, normals: Array) -> NDArray[np.int64]:
    """Return the index of the sample nearest in place and direction to each point (N, 3) with normal (N, 3)."""
    query = np.ascontiguousarray(np.hstack([points, cad.reach * normals]))
    return np.asarray(cad.tree.query(query, k=1)[1], np.int64)


def _accept_partners(off: Array, normal: Array, scan_normals: Array, loose: float) -> tuple[Array, NDArray[np.bool_]]:
    """Return distances along the normal, and which count: a partner lies straight below its point, not past an edge."""
    distance = np.einsum("ij,ij->i", off, normal)
    aside = np.linalg.norm(off - distance[:, None] * normal, axis=1)
    same = np.einsum("ij,ij->i", normal, scan_normals) > _SAME_SIDE
    return distance, same & (aside <= 0.5 * np.abs(distance) + loose)


@dataclass(frozen=True)
class Box:
    """An axis-parallel box of the part frame."""

    name: str
    low: Array  # (3,)
    high: Array  # (3,)

    def holds(self, points: Array) -> NDArray[np.bool_]:
        """(N,) which points (N, 3) lie inside."""
        return np.asarray(((points >= self.low) & (points <= self.high)).all(axis=1))


@dataclass(frozen=True)
class Regions:
    """Expected: the fit rests on them alone, and the scan must cover them. Forbidden: clamps, glue, other parts."""

    expected: tuple[Box, ...] = field(default=())
    forbidden: tuple[Box, ...] = field(default=())

    def used(self, points: Array) -> NDArray[np.bool_]:
        """(N,) which points (N, 3), part frame, the fit may use."""
        inside = np.ones(len(points), bool)
        if self.expected:
            inside = np.any([box.holds(points) for box in self.expected], axis=0)
        for box in self.forbidden:
            inside &= ~box.holds(points)
        return inside


def coverage(box: Box, cad: CadSurface, points: Array, normals: Array) -> float:
    """Return the share of the CAD in a box (part frame) that has a scanned point (N, 3) close by.

    Of a thin sheet only one side can be seen, so the samples that look the way the scan's points in the box look count.
    """
    inside = box.holds(points)
    samples = np.flatnonzero(box.holds(cad.samples))
    if not len(samples) or not inside.any():
        return 0.0
    facing = cad.normals[samples] @ normals[inside].mean(axis=0) > 0.5
    cell = max(3 * cad.spacing, float(np.ptp(cad.samples[samples], axis=0).max()) / 20)
    visible = {tuple(c) for c in np.floor(cad.samples[samples[facing]] / cell).astype(int)}
    scanned = {tuple(c) for c in np.floor(points[inside] / cell).astype(int)}
    return len(visible & scanned) / max(len(visible), 1)


def tukey_slope(e: Array, scale: float) -> Array:
    """Return the change (...) of weight · residual with the residual e (...), for the covariance of a robust fit."""
    u = e / (TUKEY * scale)
    return np.where(np.abs(u) < 1, (1 - u**2) * (1 - 5 * u**2), 0.0)


def surface_cells(points: Array, normals: Array, cell: float) -> Indices:
    """Return the cell (N,) of each point: a cube of edge `cell` (part frame) and a side that its points look to."""
    key = np.hstack([np.floor(points / cell), np.round(normals)]).astype(np.int64)
    return np.unique(key, axis=0, return_inverse=True)[1].ravel()


def cell_weights(cells: Indices, distance: Array, used: NDArray[np.bool_], scale: float) -> Array:
    """Return the weight (N,) of each point's cell (N,) by its mean distance.

    The scale is the cells' own spread (median), at least what the points' `scale` leaves in a mean: where a scan is
    only as good as its robot, all cells are off a little and none is thrown out for it.
    """
    count = np.bincount(cells, used)
    mean = np.bincount(cells, used * distance) / np.maximum(count, 1)
    full = count >= _MIN_CELL_POINTS
    if not full.any():
        return np.ones(len(cells))
    spread = max(mad_sigma(mean[full]), float(scale / np.sqrt(np.median(count[full]))))
    return np.where(full, tukey(mean, spread), 1.0)[cells]


def sample_normal_space(scan: JoinedScans, T_base_part: Array) -> Indices:
    """Return indices (n,) of at most 20,000 usable points, as many of each direction as there are to share out.

    Args:
        T_base_part: (4, 4) near where the part lies: directions count in its frame.
    """
    usable = np.flatnonzero(scan.usable)
    directions = np.round(frames.rotate(frames.inverse(T_base_part), scan.normals[usable]) * _DIRECTIONS)
    _, bucket, counts = np.unique(directions.astype(int), axis=0, return_inverse=True, return_counts=True)
    # The largest share per direction that keeps the sum within the points to draw.
    shares = range(1, _SAMPLED_POINTS + 1)
    quota = max(1, bisect_right(shares, _SAMPLED_POINTS, key=lambda share: np.minimum(counts, share).sum()))
    order = np.argsort(bucket.ravel(), kind="stable")
    first = np.cumsum(counts) - counts
    picked = [order[f + np.linspace(0, c - 1, min(quota, c)).astype(int)] for f, c in zip(first, counts, strict=True)]
    return usable[np.sort(np.concatenate(picked))] if picked else usable
