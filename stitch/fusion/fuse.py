"""Fuse registered views into one cloud: overlap averaged by weight on a grid of the scans' spacing.

The grid lies along the principal axes of what was scanned, about its middle: how the base's axes run, and where they
begin, changes no point. What a view shows in a cell is a voxel of it. A point counts where it is supported
(`support.py`).

Scans of which memory holds only some points are read once more, slab by slab of the part. The slabs end where cells of
the grid end, so that what comes out does not depend on how many there are. A voxel takes normal, edge and support from
the nearest point in memory, whose surface was that of all points.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from threading import Lock

import numpy as np
from pykdtree.kdtree import KDTree

from stitch.fusion.support import (
    PlacedPoints,
    cell_numbers,
    edge_credit,
    find_support,
    pack_cells,
    weighted_sums,
)
from stitch.model.forward import moves_points, point_correction
from stitch.model.model import Model
from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices, Mask
from stitch.run_data import FusedCloud, Unsupported
from stitch.session.capture import Capture
from stitch.session.measurement import MIN_COSINE, Measurement, intensity_scale
from stitch.session.scan import Scan, box_corners, centroid
from stitch.session.session import Cloud, SessionData, WholeCloud
from stitch.system.threads import map_parts, parallel

# Points seen at a grazing angle weigh little and edges less, but a place only they saw stays.
_EDGE_WEIGHT = 0.05
# Points of a slab; as many slabs are at work as there are cores, at some 200 bytes a point.
_SLAB = 1_250_000
# A scan is read for so many slabs at once; points of slabs that are to come wait in memory, at 24 bytes a point.
_AHEAD = 16
# Effects of scanner and part move a point by less than this share of the view's size.
_MAX_MOVE = 0.02
# A voxel on the surface of the nearest point in memory lies within so many times the edge of the square that this one
# has for itself: those in memory may stand in rows, as far apart as half of this.
_WITHIN = 4.0
# It lies off its plane by less than so many sigmas and this share of the distance, more where little is junk.
_SIGMAS, _OFF_PLANE = 4.0, 0.15


@dataclass(frozen=True)
class RegisteredSession:
    """A session under its model, with single views registered."""

    session: SessionData
    measurement: Measurement  # with the effects in use
    model: Model
    capture: Capture  # without them
    poses: Array  # (V, 4, 4) T_reference_scanner

    @cached_property
    def intensity_scale(self) -> tuple[float, float] | None:
        """Mean and standard deviation by which the model's effects count intensities."""
        return intensity_scale(self.session)


def fuse_every_point(registered: RegisteredSession) -> tuple[FusedCloud, Unsupported]:
    """Return the fused cloud of all supported points that were scanned, and how many points were left out.

    Support is decided for the points in memory. If these are all points, they are fused at once. Else the points are
    read from the files, slab by slab across the part, and each takes the support of its neighbour in memory; threads
    fuse several slabs at a time.

    A cloud of several slabs is held in temporary files.

    Raises:
        InputError: a scan is not what it was when it was read, or there is no room for the fused cloud.
    """
    scans = registered.capture.scans
    T_part = part_axes(scans, registered.poses)
    poses = frames.inverse(T_part) @ registered.poses
    registered = replace(registered, poses=poses)
    cell = float(np.median([scan.scanned_spacing for scan in scans]))
    whole = has_whole_clouds(registered.session)
    # The edge of the square that a point in memory has for itself. Points in memory may stand in rows, so that it is
    # not their spacing.
    place = float(np.sqrt(np.median([np.median(scan.area) for scan in scans]))) if whole else registered.capture.spacing
    placed = place_scans(scans, poses)
    support = find_support(scans, poses, placed, place)
    if not whole:
        dropped = Unsupported(len(support.kept), int(support.alone.sum()), int(support.looked_through.sum()))
        return fuse_points(placed.take(support.kept) if support.kept.any() else placed, cell, T_part), dropped
    del placed  # of every view: memory is for the slabs
    # One point in memory is looked up for a block of voxels, which is no larger than the place of such a point.
    slabs = _cut_into_slabs(registered, cell, max(1, int(place / cell)))
    split = np.cumsum([len(scan.points) for scan in scans])[:-1]
    parts = zip(np.split(support.alone, split), np.split(support.looked_through, split), support.junk, strict=True)
    views = [_ViewInSlabs(registered, v, slabs, *part) for v, part in enumerate(parts)]
    dropped = Unsupported()

    def fuse_slab(number: int) -> tuple[FusedCloud | None, Unsupported]:
        """Return the fused cloud of one slab, None where it is empty, and how many of its points support nothing."""
        voxels, unsupported = zip(*(view.voxels(number) for view in views), strict=True)
        together = _Voxels(
            *(np.concatenate(columns) for columns in zip(*(vars(x).values() for x in voxels), strict=True))
        )
        del voxels
        cloud = _moved(_fuse_voxels(together), T_part) if len(together.cell) else None
        return cloud, sum(unsupported, Unsupported())

    def clouds() -> Iterator[FusedCloud]:
        """Yield the clouds of slabs that hold some, and count what was dropped."""
        nonlocal dropped
        for cloud, unsupported in parallel(fuse_slab, range(slabs.count), "fusing slabs"):
            dropped += unsupported
            if cloud is not None:
                yield cloud

    cloud = next(clouds()) if slabs.count == 1 else FusedCloud(**map_parts(vars(cloud) for cloud in clouds()))
    return cloud, dropped


def has_whole_clouds(session: SessionData) -> bool:
    """Return whether memory holds only some of the points that were scanned."""
    return any(view.cloud is not None and view.cloud.whole is not None for view in session.views)


def fuse_points(placed: PlacedPoints, cell: float, T_part: Array) -> FusedCloud:
    """Return placed points averaged in cells of a grid, in the reference frame.

    `residual` is the rms distance of the views' surfaces from the fused one along its normal, length_unit, NaN where
    one view alone shows it; `count` the number of views per point.

    Args:
        placed: in the part's frame, along whose axes the grid lies.
        cell: edge of a cell, length_unit.
        T_part: (4, 4) T_reference_part.
    """
    return _moved(_fuse_voxels(_voxels(placed, cell_numbers(placed.points, cell))), T_part)


def place_scans(scans: Sequence[Scan], poses: Array) -> PlacedPoints:
    """Return all points of all scans in the reference frame, one view after the other."""
    placed = [_place_scan(scan, T, v) for v, (scan, T) in enumerate(zip(scans, poses, strict=True))]
    return PlacedPoints(*(np.concatenate(columns) for columns in zip(*(vars(p).values() for p in placed), strict=True)))


def _place_scan(scan: Scan, T: Array, v: int) -> PlacedPoints:
    """Return the points of view v under T (4, 4), with the weight by which each is averaged."""
    points, normals = frames.transform(T, scan.points), frames.rotate(T, scan.normals)
    # By their cosine of incidence, and by whether they lie on a smooth surface.
    weight = scan.confidence**2 * np.where(scan.usable, 1.0, _EDGE_WEIGHT)
    return PlacedPoints(points, normals, weight, np.full(len(points), v), np.asarray(scan.usable, bool))


def part_axes(scans: Sequence[Scan], poses: Array) -> Array:
    """Return T_reference_part (4, 4): centroid and principal axes of all points, the shortest first.

    Each axis points to where the third moment is positive, so that the order of cells does not depend on how the part
    lies; the last one makes the frame right-handed.

    Args:
        poses: (V, 4, 4) T_reference_scanner.
    """
    points = np.concatenate([frames.transform(T, scan.points) for scan, T in zip(scans, poses, strict=True)])
    middle = centroid(points)
    points -= middle
    _, axes = np.linalg.eigh(points.T @ points)
    along = points @ axes
    # A library's power of three takes ten times as long.
    skew = (along * along * along).sum(axis=0)
    axes = axes * np.where(skew < 0, -1.0, 1.0)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return frames.make(axes, middle)


def _moved(cloud: FusedCloud, T: Array) -> FusedCloud:
    """Return a fused cloud with its points and normals moved by T (4, 4)."""
    return replace(cloud, points=frames.transform(T, cloud.points), normals=frames.rotate(T, cloud.normals))


@dataclass(frozen=True)
class _Voxels:
    """What views show in cells of the grid, one row for a view in a cell; a view's rows stand in the order of cells."""

    cell: Indices  # (G,)
    weight: Array  # (G,)
    points: Array  # (G, 3) weighted mean
    normals: Array  # (G, 3) weighted mean, shorter than 1


def _voxels(placed: PlacedPoints, cells: Indices) -> _Voxels:
    """Return per cell and view the weighted mean of the points there, given the number of each point's cell (N,).

    Rows are sorted by cell, then by view.
    """
    different, at = np.unique(cells, return_inverse=True)
    views = int(placed.view.max(initial=0)) + 1
    keys, at = np.unique(at * views + placed.view, return_inverse=True)
    weight = np.bincount(at, placed.weight).astype(float, copy=False)
    points = weighted_sums(at, placed.weight, placed.points) / weight[:, None]
    normals = weighted_sums(at, placed.weight, placed.normals) / weight[:, None]
    return _Voxels(different[keys // views], weight, points, normals)


def _fuse_voxels(voxels: _Voxels) -> FusedCloud:
    """Return per cell the mean point and normal over its views, and the rms distance of the views along the normal.

    Cells are in the order of their numbers. The residual is NaN in a cell of one view.
    """
    _, at = np.unique(voxels.cell, return_inverse=True)
    weight = np.bincount(at, voxels.weight)
    points = weighted_sums(at, voxels.weight, voxels.points) / weight[:, None]
    normals = weighted_sums(at, voxels.weight, voxels.normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    offset = np.zeros(len(at))
    # One axis after the other, as rows of three take several times the memory of what they come to.
    for p, m, n in zip(voxels.points.T, points.T, normals.T, strict=True):
        offset += (p - m[at]) * n[at]
    count = np.bincount(at)
    square = np.bincount(at, voxels.weight * offset**2)
    residual = np.where(count > 1, np.sqrt(square / weight), np.nan)
    return FusedCloud(points, normals, residual, count.astype(np.int32))


@dataclass(frozen=True)
class _Slabs:
    """Slabs of the grid of cells, across one axis of the frame of the registered poses: its cells are fused together.

    A block is a cube of cells for which one point in memory is looked up.
    """

    cell: float  # edge of a cell
    block: int  # cells along an edge of a block
    axis: int  # across the slabs
    ends: Array  # (S + 1,) along the axis: number of the first cell of each slab, and of the one after the last; ±inf

    @property
    def count(self) -> int:
        """S."""
        return len(self.ends) - 1

    def of(self, coordinate: Array) -> Indices:
        """(N,) numbers of the slabs in which coordinates along the axis lie."""
        return np.searchsorted(self.ends, np.floor(coordinate / self.cell), side="right") - 1

    def cells(self, columns: Iterable[Array]) -> list[Indices]:
        """Numbers of the cells, a column for each of x, y, z."""
        return [np.floor(column / self.cell).astype(np.int64) for column in columns]


def _cut_into_slabs(registered: RegisteredSession, cell: float, block: int) -> _Slabs:
    """Return slabs across the part's longest axis, each with about `_SLAB` of the points that were scanned.

    A slab consists of whole layers, one block thick, so that no block lies in two slabs. The points of a layer are
    estimated from those in memory: each stands for its view's number scanned over its number in memory.

    Args:
        cell: edge of a cell, length_unit.
        block: cells along an edge of a block.
    """
    thickness = block * cell
    placed = zip(registered.capture.scans, registered.poses, strict=True)
    clouds = [frames.transform(T, scan.points) for scan, T in placed]
    low = np.min([points.min(axis=0) for points in clouds], axis=0)
    high = np.max([points.max(axis=0) for points in clouds], axis=0)
    axis = int(np.argmax(high - low))
    first = np.floor(low[axis] / thickness)
    scanned = [1.0 if v.cloud is None else v.cloud.count / len(v.cloud.points) for v in registered.session.views]
    layers = int(np.floor(high[axis] / thickness) - first) + 1
    count = np.zeros(layers)
    for points, per_point in zip(clouds, scanned, strict=True):
        layer = (np.floor(points[:, axis] / thickness) - first).astype(np.int64)
        count += per_point * np.bincount(layer, minlength=layers)
    # Points are counted from below: a layer belongs to the slab in which its middle point falls.
    slab_of_layer = np.floor((np.cumsum(count) - count / 2) / _SLAB)
    ends = first + np.flatnonzero(np.diff(slab_of_layer) > 0) + 1
    # The outer slabs have no end: points that are not in memory may lie beyond those that are.
    return _Slabs(cell, block, axis, np.array([-np.inf, *(block * ends), np.inf]))


class _ViewInSlabs:
    """One view, and what it shows in each slab; every slab is asked for once."""

    def __init__(
        self, registered: RegisteredSession, v: int, slabs: _Slabs, alone: Mask, through: Mask, junk: float
    ) -> None:
        """Prepare what every slab needs of view v: support of its points, their search tree, the slabs that it reaches.

        Args:
            slabs: the same for all views.
            alone: (N,) points in memory that lie on no surface.
            through: (N,) points in memory that other views look through.
            junk: share of the view's points that lie on no surface by a wide margin.
        """
        self.registered = registered
        self.v = v
        self.slabs = slabs
        self.scan = registered.capture.scans[v]
        self.T = registered.poses[v]
        cloud = registered.session.views[v].cloud
        self.whole = None if cloud is None else cloud.whole
        self.moves = moves_points(registered.model.terms)
        self.kept = ~(alone | through)
        self.through = through
        self.surface = np.flatnonzero(~alone) if not alone.all() else np.arange(len(alone))
        some = len(self.surface) < len(alone)
        self.tree = KDTree(self.scan.points[self.surface], leafsize=16) if some else self.scan.tree
        self.off_plane = _OFF_PLANE * (1 + edge_credit(junk))
        self.first = 0
        self.last = slabs.count - 1
        self.margin = slabs.cell
        if self.whole is not None:
            self.margin += _MAX_MOVE * float(np.ptp(self.whole.box, axis=0).max()) if self.moves else 0.0
            height = frames.transform(self.T, box_corners(self.whole.box))[:, slabs.axis]
            self.first, self.last = slabs.of(np.array([height.min() - self.margin, height.max() + self.margin]))
        self.waiting: dict[int, list[Array]] = {}  # points of slabs to come
        self.in_memory: PlacedPoints | None = None  # while there are some
        self.lock = Lock()

    def voxels(self, slab: int) -> tuple[_Voxels, Unsupported]:
        """Return the view's voxels of a slab, and how many of its points were left out without support."""
        return self._voxels_in_memory(slab) if self.whole is None else self._voxels_of_file(slab, self.whole)

    def _voxels_in_memory(self, slab: int) -> tuple[_Voxels, Unsupported]:
        """Return the same where memory holds the whole scan: its supported points are averaged by cell."""
        placed = _place_scan(self.scan, self.T, self.v)
        inside = self.slabs.of(placed.points[:, self.slabs.axis]) == slab
        alone = ~self.kept & ~self.through & inside
        kept = placed.take(inside & self.kept)
        voxels = _voxels(kept, pack_cells(self.slabs.cells(kept.points.T), self.slabs.axis))
        return voxels, Unsupported(int(inside.sum()), int(alone.sum()), int((self.through & inside).sum()))

    def _voxels_of_file(self, slab: int, whole: WholeCloud) -> tuple[_Voxels, Unsupported]:
        """Return the same of all points of the file, averaged by cell.

        Each voxel takes normal, weight and support from the nearest point in memory. It is left out too where it lies
        too far from that point, or too far off its tangent plane.
        """
        in_memory, columns = self._points_in(slab, whole)
        cells = self.slabs.cells(columns)
        if in_memory is None:
            return _Voxels(cells[0], np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3))), Unsupported()
        occupied, voxel_of_point = np.unique(pack_cells(cells, self.slabs.axis), return_inverse=True)
        count = np.bincount(voxel_of_point, minlength=len(occupied))
        mean = np.stack([np.bincount(voxel_of_point, x, len(occupied)) for x in columns], axis=1) / count[:, None]
        nearest = self._nearest(mean, count)
        normal = in_memory.normals[nearest]
        offset = mean - in_memory.points[nearest]
        square_distance = np.einsum("ij,ij->i", offset, offset)
        height = np.abs(np.einsum("ij,ij->i", offset, normal))
        del offset  # of every point: memory is short here
        most_height = _SIGMAS * self.scan.noise + self.off_plane * np.sqrt(square_distance)
        alone = square_distance > _WITHIN**2 * self.scan.area[nearest]
        alone |= self.scan.usable[nearest] & (height > most_height)
        through = self.through[nearest] & ~alone
        keep = ~(alone | through)
        weight = (count * in_memory.weight[nearest])[keep]
        voxels = _Voxels(occupied[keep], weight, mean[keep], normal[keep])
        return voxels, Unsupported(len(voxel_of_point), int(count[alone].sum()), int(count[through].sum()))

    def _points_in(self, slab: int, whole: WholeCloud) -> tuple[PlacedPoints | None, list[Array]]:
        """Return the view's points in memory, None if the slab is empty, and x, y, z (N,) of its points in the slab.

        Both are in the frame of the slabs, with the effects in use taken out. The file is read for `_AHEAD` slabs at
        once, whose points wait in `waiting`. The lock lets threads of other slabs wait for that reading.
        """
        if not self.first <= slab <= self.last:
            return None, [np.zeros(0)] * 3
        with self.lock:
            if slab not in self.waiting:
                start = slab - (slab - self.first) % _AHEAD
                self.waiting |= self._cut(whole, start, min(start + _AHEAD, self.last + 1))
                self.in_memory = _place_scan(self.scan, self.T, self.v)
            columns, in_memory = self.waiting.pop(slab), self.in_memory
            if not self.waiting:
                self.in_memory = None  # of hundreds of views they are half a gigabyte
        return in_memory if len(columns[0]) else None, columns

    def _cut(self, whole: WholeCloud, start: int, stop: int) -> dict[int, list[Array]]:
        """Return by slab, `start` to `stop` − 1, x, y, z (N,) of the view's points there, read from its file.

        Effects in use and stock are taken out; `margin` says how far that may move a point across the slabs.
        """
        cloud = whole.read()
        height = _along(self.T, cloud.points, self.slabs.axis)
        low, high = self.slabs.cell * self.slabs.ends[[start, stop]]
        near = np.flatnonzero((height >= low - self.margin) & (height < high + self.margin))
        points = self._corrected(cloud, near) if self.moves else cloud.points[near]
        if self.scan.stock is not None:
            nearest = self.scan.tree.query(points)[1]
            off = self.scan.stock.thickness * self.scan.stock.points[nearest]
            points = points - off[:, None] * self.scan.normals[nearest]
        columns = [_along(self.T, points, i) for i in range(3)]
        # Numbers of 16 bits are sorted in a fifth of the time.
        slab = self.slabs.of(columns[self.slabs.axis]).astype(np.int16)
        order = np.argsort(slab, kind="stable")
        ends = np.searchsorted(slab[order], np.arange(start, stop + 1))
        return {k: [c[order[a:b]] for c in columns] for k, (a, b) in enumerate(pairwise(ends), start)}

    def _corrected(self, cloud: Cloud, index: Indices) -> Array:
        """Return points `index` of a cloud (N, 3), scanner frame, with the effects in use taken out.

        Normals, for the cosine of incidence, are those of the nearest points in memory.
        """
        registered, terms = self.registered, self.registered.model.terms
        scan, scale = registered.measurement.capture.scans[self.v], registered.intensity_scale
        T = registered.capture.poses(registered.model.T_mount)[self.v]
        corrected = []
        for block in np.array_split(index, len(index) // _SLAB + 1):
            points = cloud.points[block]
            _, nearest = scan.tree.query(points, k=1)
            cosine = np.abs(np.einsum("ij,ij->i", scan.normals[nearest], scan.rays(points)))
            view = replace(
                registered.measurement.scan_views[self.v],
                cosine=np.maximum(cosine, MIN_COSINE),
                intensity=None if scale is None else (cloud.scalars["intensity"][block] - scale[0]) / scale[1],
            )
            corrected.append(points + point_correction(terms, points, view, T))
        return np.concatenate(corrected)

    def _nearest(self, mean: Array, count: Indices) -> Indices:
        """Return per voxel (G,) the number of the point in memory nearest to the centroid of the voxel's block.

        One look-up a block: blocks are no larger than the place of a point in memory.

        Args:
            mean: (G, 3) points of the voxels, frame of the slabs.
            count: (G,) scanned points in each.
        """
        cells = [c // self.slabs.block for c in self.slabs.cells(mean.T)]
        different, at = np.unique(pack_cells(cells, self.slabs.axis), return_inverse=True)
        middle = weighted_sums(at, count.astype(float), mean) / np.bincount(at, count, len(different))[:, None]
        _, index = self.tree.query(frames.transform(frames.inverse(self.T), middle), k=1)
        return self.surface[index][at]


def _along(T: Array, points: Array, axis: int) -> Array:
    """(N,) one coordinate of points (N, 3) under T."""
    # A product of matrices this narrow takes ten times as long.
    (x, y, z), (a, b, c, t) = points.T, T[axis]
    return x * a + y * b + z * c + t
