"""Which points of the scans are surface: others hold them, in their view or in all, and no view looks past.

A point is *settled* where another view shows the same surface in the same cell. The rest is asked one by one: do its
neighbours in its own view lie on a surface through it; if not, do those of all views. What is left may be a body that
stands in the way of some views: others look past it, and it hangs together with nothing that two views show.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pykdtree.kdtree import KDTree

from stitch.fusion.look_through import range_images
from stitch.numerics.distributions import MAD_TO_SIGMA
from stitch.numerics.frames import Array, Indices, Mask
from stitch.session.scan import Scan
from stitch.system.threads import parallel

# Height of a point over no surface, in any unit.
_NONE = 1e100
# Bits for a coordinate of a cell: three of them are one integer.
_BITS = 21
# Neighbours of a point that are looked up, the votes of those that have to lie on one surface, and the vote of a
# neighbour on an edge; that of any other is 1.
_NEIGHBOURS, _LEAST, _EDGE_VOTE = 8, 3.0, 0.5
# Normals of one surface, as cosines to their mean.
_ALIKE = 0.6
# Sigmas across the surface within which a point lies on it.
_SIGMAS = 4.0
# A point that has so many times the solid angle of others for itself stands alone. On an edge it is twice, in a corner
# four times.
_ALONE = 6.0
_EDGE_ALONE = 3.0
# Noise and spacing of a view are believed up to so many times the median over the views.
_OF_OTHERS = 2.0
# Neighbours scatter about one surface by less than this share of their distance.
_FLAT = 0.2
# The centroid of neighbours all around lies within this share of the distance; beyond, the surface ends. There a point
# may lie off the plane of the others, by up to the second share.
_AROUND, _ROUNDED = 0.2, 0.3
# Share of points alone in a view at which an edge gets no more than the least credit: one point beside an edge is then
# as likely to be junk as surface. A tenth of it, and it gets that much more.
_JUNK, _LEAST_CREDIT = 0.1, 0.1
# Neighbours in all views lie within so many cells.
_NEAR = 1.5
# A view looks past a point if what it saw lies so many cells behind.
_MARGIN = 3.0
# Views that have to look past a point on a smooth surface; on an edge, one.
_PAST = 2
# Parts hang together over gaps of so many cells; at most so many such steps make the largest side.
_GAP, _STEPS = 4.0, 128
# A body is no part of what was scanned if so few of its points are seen twice, and so many, more than five, are looked
# past: of surfaces that one view alone saw, views look past next to none, where scans hold a third of junk too.
_SEEN_TWICE, _CONTRADICTED, _WITNESSES = 0.05, 0.05, 5


@dataclass(frozen=True)
class PlacedPoints:
    """Points of registered views in the reference frame."""

    points: Array  # (N, 3)
    normals: Array  # (N, 3)
    weight: Array  # (N,)
    view: Indices  # (N,)
    usable: Mask  # (N,): on a smooth surface

    def take(self, keep: Mask) -> "PlacedPoints":
        """Return some of them."""
        return PlacedPoints(*(column.compress(keep, axis=0) for column in vars(self).values()))


@dataclass(frozen=True)
class Support:
    """Per point of all views, one after the other."""

    alone: Mask  # no surface goes through it
    looked_through: Mask  # it is on one, and other views look past it
    junk: Array  # (V,) share of points that stand alone

    @property
    def kept(self) -> Mask:
        """What is surface."""
        return ~(self.alone | self.looked_through)


def find_support(scans: Sequence[Scan], poses: Array, placed: PlacedPoints, cell: float) -> Support:
    """Return which points of the views are supported, and which are left out for what reason.

    Three questions, in this order. Does another view show the same surface in the same cell (settled)? If not, does the
    point lie on a surface of its own view's neighbours, or of all views' (held)? If held but not settled, do other
    views look through it?

    Args:
        poses: (V, 4, 4) T_reference_scanner.
        placed: the points of the scans under these poses, one view after the other.
        cell: edge of the cells in which views are compared, length_unit.
    """
    settled, scatter = _points_on_surface(placed, cell)
    parts = np.split(settled, np.cumsum([len(scan.points) for scan in scans])[:-1])
    # A view full of stray points overestimates its own noise and spacing: both are limited by the other views'.
    noise, angles = (
        np.minimum(values, _OF_OTHERS * float(np.median(values)))
        for values in ([scan.noise for scan in scans], [scan.solid_angle for scan in scans])
    )
    tests = list(parallel(lambda item: _held_by_own_view(*item), zip(scans, parts, noise, angles, strict=True)))
    held = np.concatenate([test[0] for test in tests])
    junk = np.array([test[1] for test in tests])
    held |= _held_by_all_views(placed, held, scatter, cell)
    through = np.zeros(len(held), bool)
    asked = np.flatnonzero(held & ~settled)
    if len(asked) and len(scans) > 1:
        through[asked] = _looked_through(scans, poses, placed, held, settled, asked, cell)
    return Support(~held, through, junk)


def cell_numbers(points: Array, size: float) -> Indices:
    """(N,) a number for the cell of each point (N, 3) in the grid about the frame's origin."""
    return pack_cells([np.floor(column / size).astype(np.int64) for column in points.T], 0)


def pack_cells(cells: Sequence[Indices], axis: int) -> Indices:
    """(N,) one number for three of a cell, a million to either side of the origin, in the order along `axis`."""
    first, second, third = (cells[i] + (1 << _BITS - 1) for i in (axis, *(i for i in range(3) if i != axis)))
    return (first << 2 * _BITS) | (second << _BITS) | third


def weighted_sums(group: Indices, weight: Array, values: Array) -> Array:
    """(G, k) weighted sums of values (N, k) over the groups (N,) of their rows."""
    return np.stack([np.bincount(group, weight * column) for column in values.T], axis=1)


def edge_credit(junk: float) -> float:
    """Return how far an edge is believed in a view of which a share is junk: log10 of 0.1 / share, at least 0.1."""
    return float(max(np.log10(_JUNK / max(junk, 1e-9)), _LEAST_CREDIT))


def _points_on_surface(placed: PlacedPoints, cell: float) -> tuple[Mask, float]:
    """Return a mask (N,) of the points on a surface that another view shows in the same cell, and the scatter.

    The scatter, length_unit, is the robust sigma of points of several views about the mean plane of their cell. A point
    on an edge needs two other views.

    Args:
        cell: edge of the cells, length_unit.
    """
    views = int(placed.view.max()) + 1
    _, at = np.unique(cell_numbers(placed.points, cell), return_inverse=True)
    weight = np.bincount(at, placed.weight)
    mean = weighted_sums(at, placed.weight, placed.points)
    mean /= weight[:, None]
    normal = weighted_sums(at, placed.weight, placed.normals)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    off = np.zeros(len(at))
    cosine = np.zeros(len(at))
    # One axis after the other: of hundreds of views, rows of three are hundreds of megabytes.
    for p, n, m, across in zip(placed.points.T, placed.normals.T, mean.T, normal.T, strict=True):
        surface_normal = across[at]
        off += (p - m[at]) * surface_normal
        cosine += n * surface_normal
    off = np.abs(off)
    alike = cosine > _ALIKE
    del cosine, mean, normal
    groups, group = np.unique(at * views + placed.view, return_inverse=True)
    views_in_cell = np.bincount(groups // views, minlength=len(weight))
    several = placed.usable & (views_in_cell > 1)[at]
    scatter = MAD_TO_SIGMA * float(np.median(off[several])) if several.any() else 0.0
    near = off < _SIGMAS * scatter
    shows = np.bincount(group, placed.usable & near & alike, len(groups)) > 0
    others = np.bincount(groups // views, shows, len(weight))[at] - shows[group]
    return near & (others >= np.where(placed.usable, 1, 2)), scatter


def _held_by_own_view(scan: Scan, settled: Mask, noise: float, angle_each: float) -> tuple[Mask, float]:
    """Return a mask (N,) of points that are settled or lie on a surface of their neighbours, and the share of strays.

    A stray has more than `_ALONE` times the usual solid angle for itself. The more strays, the less far a point may lie
    off the plane of its neighbours where the surface ends (`edge_credit`).

    Args:
        settled: (N,) points that another view confirms: they are not tested.
        noise: of the scan across a surface, length_unit.
        angle_each: solid angle (sr) that a point on a smooth surface has for itself.
    """
    held = np.ones(len(scan.points), bool)
    asked = np.flatnonzero(~settled)
    if not len(asked) or len(scan.points) <= _NEIGHBOURS:
        return held, 0.0
    distance, index = scan.tree.query(scan.points[asked], k=_NEIGHBOURS + 1)
    index, radius = index[:, 1:], distance[:, -1]
    angle = radius**2 * np.pi / (_NEIGHBOURS + 1) * np.maximum(scan.confidence[asked], 0.1)
    angle /= np.einsum("ij,ij->i", scan.points[asked] - scan.eye, scan.points[asked] - scan.eye)
    share = angle / angle_each
    alone = share > _ALONE
    junk = float(alone.sum()) / len(scan.points)
    credit = edge_credit(junk)
    vote = np.where(scan.usable[index], 1.0, _EDGE_VOTE)
    around = scan.points.take(index, axis=0) - scan.points.take(asked, axis=0)[:, None]
    centroid = around.mean(axis=1)
    normals = scan.normals.take(index, axis=0)
    # Points that the first round rejects do not count as neighbours in the second.
    for _ in range(2):
        local = _LocalSurface(around, normals, vote * held[index])
        aside = np.linalg.norm(centroid - np.einsum("ij,ij->i", centroid, local.normal)[:, None] * local.normal, axis=1)
        rounded = np.minimum(credit * np.maximum(aside - _AROUND * radius, 0), _ROUNDED * radius)
        within = _SIGMAS * noise + local.bend * radius / 2 + np.where(share < _EDGE_ALONE, rounded, 0.0)
        flat = local.scatter < _FLAT * (1 + credit / 2) * radius
        held[asked] &= ~alone & (local.votes >= _LEAST) & flat & (np.abs(local.height) < within)
    return held, junk


class _LocalSurface:
    """The surface that k neighbours of N points span: votes, mean normal, height over the points, scatter, bend."""

    def __init__(self, around: Array, normals: Array, vote: Array) -> None:
        """Fit N surfaces to k neighbours each; all results are (N,) but the mean `normal` (N, 3).

        `votes`: sum of the votes of neighbours whose normals agree; `height`: median height of their tangent planes
        over the point; `scatter`: robust sigma of these heights; `bend`: median angle (rad) between normals.

        Args:
            around: (N, k, 3) neighbours from the point.
            normals: (N, k, 3) of these, unit.
            vote: (N, k) weight of each; 0: it does not count.
        """
        self.normal = np.einsum("nk,nki->ni", vote, normals)
        self.normal /= np.maximum(np.linalg.norm(self.normal, axis=1, keepdims=True), 1e-12)
        cosine = np.einsum("nki,ni->nk", normals, self.normal)
        counts = (vote > 0) & (cosine > _ALIKE)
        self.votes = (vote * counts).sum(axis=1)
        # On a ball the mean of both normals is exact, as in symmetric ICP (Rusinkiewicz 2019).
        heights = np.einsum("nki,nki->nk", normals + self.normal[:, None], around) / 2
        self.height = _masked_median(heights, counts)
        self.scatter = MAD_TO_SIGMA * _masked_median(np.abs(heights - self.height[:, None]), counts)
        self.bend = np.sqrt(np.maximum(2 * (1 - _masked_median(cosine, counts)), 0))


def _masked_median(values: Array, counts: Mask) -> Array:
    """Return the lower median (N,) of those values (N, k) that count; `_NONE`, a huge number, where none does."""
    ordered = np.sort(np.where(counts, values, _NONE), axis=1)
    middle = np.maximum(counts.sum(axis=1) - 1, 0) // 2
    return np.take_along_axis(ordered, middle[:, None], axis=1)[:, 0]


def _held_by_all_views(placed: PlacedPoints, held: Mask, scatter: float, cell: float) -> Mask:
    """Return a mask (N,) of points not held so far that lie on a surface of the held points of all views.

    Args:
        held: (N,) points on a surface of their own view, or settled.
        scatter: of several views across a surface, length_unit.
        cell: edge of the cells, length_unit; neighbours lie within `_NEAR` of these.
    """
    on_surface = np.zeros_like(held)
    asked = np.flatnonzero(~held)
    base = np.flatnonzero(held)
    if not len(asked) or len(base) < _NEIGHBOURS:
        return on_surface
    tree = KDTree(np.ascontiguousarray(placed.points[base]), leafsize=16)
    distance, index = tree.query(placed.points[asked], k=_NEIGHBOURS, distance_upper_bound=_NEAR * cell)
    near = np.isfinite(distance[:, -1])
    asked, index, radius = asked[near], base[index[near]], distance[near, -1]
    around = placed.points.take(index, axis=0) - placed.points[asked][:, None]
    local = _LocalSurface(around, placed.normals.take(index, axis=0), np.ones(index.shape))
    within = _SIGMAS * scatter + local.bend * radius / 2
    on_surface[asked] = (local.votes > _NEIGHBOURS / 2 - 1) & (np.abs(local.height) < within)
    return on_surface


def _looked_through(
    scans: Sequence[Scan],
    poses: Array,
    placed: PlacedPoints,
    held: Mask,
    settled: Mask,
    asked: Indices,
    cell: float,
) -> Mask:
    """Return a mask (A,) of the points `asked` that other views look through, singly or as part of a loose body.

    Singly: `_PAST` views measured a surface behind the point, one on an edge. A loose body is a group of a view's
    points, apart from all others, that hardly any second view confirms and that some views look through.

    Args:
        poses: (V, 4, 4) T_reference_scanner.
        held: (N,) points on a surface.
        settled: (N,) points that another view confirms.
        asked: (A,) numbers of the points to test.
        cell: edge of the cells, length_unit.
    """
    # A range image needs points of every view.
    kept = np.split(held, np.cumsum([len(scan.points) for scan in scans])[:-1])
    if not all(keep.any() for keep in kept):
        return np.zeros(len(asked), bool)
    images = range_images(scans, kept, cell)
    points, normals, view = placed.points[asked], placed.normals[asked], placed.view[asked]
    centres, radii = _balls_around(points, view, len(scans))
    columns = np.ascontiguousarray(points.T)

    def by_view(v: int) -> tuple[Indices, Indices]:
        """Return which of the points asked view v may concern, and its answer on each (`views_through`)."""
        concerned = images.may_concern(scans[v], poses[v], centres, radii)
        concerned[v] = False
        near = np.flatnonzero(concerned[view])
        return near, images.views_through(scans[v], poses[v], v, columns[:, near], normals[near], _MARGIN * cell)

    past = np.zeros(len(asked), np.int64)
    missed = np.zeros(len(asked), np.int64)
    for near, answer in parallel(by_view, range(len(scans))):
        past[near] += answer == 1
        missed[near] += answer == 2
    through = past >= np.where(placed.usable[asked], _PAST, 1)
    contradicted = np.zeros(len(held), bool)
    contradicted[asked] = past + missed > 0
    loose = np.zeros(len(held), bool)
    ends = np.cumsum([0, *(len(scan.points) for scan in scans)])
    for v in np.flatnonzero(np.bincount(view[contradicted[asked]]) > _WITNESSES):
        # Bodies are sought among the points of one view: in all views a stray body may touch the part.
        rows = ends[v] + np.flatnonzero(kept[v])
        loose[rows] = _in_loose_body(placed.points[rows], settled[rows], contradicted[rows], cell)
    return through | loose[asked]


def _balls_around(points: Array, view: Indices, views: int) -> tuple[Array, Array]:
    """Return centres (V, 3) and radii (V,) of balls around each view's points (N, 3), given the view (N,) of each."""
    count = np.maximum(np.bincount(view, minlength=views), 1)
    centres = np.stack([np.bincount(view, column, views) for column in points.T], axis=1) / count[:, None]
    radii = np.zeros(views)
    np.maximum.at(radii, view, np.linalg.norm(points - centres[view], axis=1))
    return centres, radii


def _in_loose_body(points: Array, settled: Mask, contradicted: Mask, cell: float) -> Mask:
    """Return a mask (N,) of a view's points in loose bodies: seen by hardly any second view, and looked through.

    Bodies are connected components of occupied cells whose edge is `_GAP` · cell: wider gaps separate them.

    Args:
        points: (N, 3) reference frame.
        settled: (N,) points that another view confirms.
        contradicted: (N,) points that another view looks through or ought to have seen.
        cell: length_unit.
    """
    # Imported here, since few sessions need it.
    from scipy.ndimage import label

    step = max(_GAP * cell, *(float(np.ptp(column)) / _STEPS for column in points.T))
    at = tuple(((column - column.min()) / step).astype(np.int32) for column in points.T)
    grid = np.zeros([int(i.max()) + 1 for i in at], bool)
    grid[at] = True
    body = label(grid, np.ones((3, 3, 3)))[0][at]
    size = np.bincount(body)
    twice = np.bincount(body, settled, len(size))
    against = np.bincount(body, contradicted, len(size))
    return ((twice < _SEEN_TWICE * size) & (against > np.maximum(_CONTRADICTED * size, _WITNESSES)))[body]
