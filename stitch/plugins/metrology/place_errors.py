"""Where the points of a run are, and how far they may lie from where they truly are: sources, each a sum of modes."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stitch.model.forward import PointSlopes
from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices, Mask
from stitch.observations.surfaces.scanner_errors import error_shapes
from stitch.plugins.metrology.scan_errors import ScanErrors
from stitch.run_data import FusedCloud
from stitch.session.capture import Capture
from stitch.session.measurement import Measurement
from stitch.system.files import whole_file
from stitch.system.ply_file import vertex_columns, write_ply

# What is seen at more than 60° errs most with incidence, and other views see it better.
_LEAST_COSINE = 0.5
# A view has a part in a fused point where it has one of its own within so many cells.
_WITHIN = 1.5
# Numbers that are held at a time: points of a block by modes of all sources.
_HELD = 20_000_000


@dataclass(frozen=True)
class ErrorSource:
    """m independent modes of unit variance; lengths in length_unit, angles in rad."""

    name: str
    views: Array  # (6V, m) left twists about `PlaceErrors.centre` by which the registered views err
    shapes: Array  # (P + K, m) errors of parameters of effects that change points, then smooth errors of the scanner
    degrees: float  # of freedom with which its size is known
    scan: int | None = None  # its modes are those of `ScanErrors`, of this scan alone


@dataclass(frozen=True)
class RunPoints:
    """N usable points of all registered views, without the effects in use; reference frame."""

    points: Array  # (N, 3)
    normals: Array  # (N, 3) unit, towards the scanner
    view: Indices  # (N,)
    index: Indices  # (N,) in its scan

    def take(self, keep: Indices) -> "RunPoints":
        """The points of some indices."""
        return RunPoints(self.points[keep], self.normals[keep], self.view[keep], self.index[keep])


@dataclass(frozen=True)
class PlaceErrors:
    """Where the points of a run are, and all that may be wrong about it."""

    measurement: Measurement
    capture: Capture  # without the effects in use
    poses: Array  # (V, 4, 4) T_reference_scanner, registered
    centre: Array  # (3,) reference frame
    sources: tuple[ErrorSource, ...]
    slopes: PointSlopes | None  # of the P parameters that change points
    half: Array  # (2,) of the scanner's field
    scan_errors: ScanErrors | None  # smooth errors that are new in each scan

    @property
    def points(self) -> RunPoints:
        """All usable points that the scanner does not see at a slant."""
        scans = self.capture.scans
        kept = [np.flatnonzero(scan.usable.astype(bool) & (scan.confidence > _LEAST_COSINE)) for scan in scans]
        return RunPoints(
            np.vstack([frames.transform(T, s.points[k]) for s, T, k in zip(scans, self.poses, kept, strict=True)]),
            np.vstack([frames.rotate(T, s.normals[k]) for s, T, k in zip(scans, self.poses, kept, strict=True)]),
            np.repeat(np.arange(len(scans)), [len(k) for k in kept]),
            np.concatenate(kept).astype(np.int64),
        )

    def loadings(self, at: RunPoints, gradient: Array) -> Array:
        """Return what each mode of all sources, side by side, does to numbers (q, M) with these slopes (q, N, 3) in the
        points, reference frame."""
        views = np.zeros((len(gradient), len(self.poses), 6))
        shapes = np.zeros((len(gradient), len(self.sources[0].shapes)))
        of_scans = dict[int | None, Array]()
        for v in np.unique(at.view):
            of_view = np.flatnonzero(at.view == v)
            g = gradient[:, of_view]
            views[:, v] = twist_slopes(at.points[of_view] - self.centre, g)
            index = at.index[of_view]
            g_scanner = frames.rotate(frames.inverse(self.poses[v]), g)
            shapes += np.einsum("qni,kni->qk", g_scanner, self.point_modes(v, index))
            if self.scan_errors is not None:
                along_ray, modes = self.scan_modes(v, index)
                of_scans[int(v)] = np.einsum("qni,ni->qn", g_scanner, along_ray) @ modes
        twists = views.reshape(len(gradient), -1)
        return np.hstack([twists @ s.views + shapes @ s.shapes + of_scans.get(s.scan, 0.0) for s in self.sources])

    def point_shapes(self, at: RunPoints) -> Array:
        """Return by how much points move per unit of the parameters and smooth errors (P + K, N, 3), reference
        frame."""
        shapes = np.zeros((len(self.sources[0].shapes), len(at.points), 3))
        for v in np.unique(at.view):
            of_view = np.flatnonzero(at.view == v)
            shapes[:, of_view] = frames.rotate(self.poses[v], self.point_modes(v, at.index[of_view]))
        return shapes

    def scan_shapes(self, at: RunPoints, v: int) -> Array:
        """Return by how much points move per mode of the smooth errors of scan v (M, N, 3), reference frame."""
        assert self.scan_errors is not None
        of_view = np.flatnonzero(at.view == v)
        shapes = np.zeros((self.scan_errors.count, len(at.points), 3))
        along_ray, modes = self.scan_modes(v, at.index[of_view])
        shapes[:, of_view] = modes.T[:, :, None] * frames.rotate(self.poses[v], along_ray)
        return shapes

    def moved(self, at: RunPoints, twists: Array, points: Array) -> Array:
        """Return points (M, N, 3) of some views, moved with their views by left twists (M, 6V) about the centre."""
        views, index = np.unique(at.view, return_inverse=True)
        T = frames.moved_about(self.centre, twists.reshape(len(twists), -1, 6)[:, views], np.eye(4))
        moved = np.empty_like(points)
        for v in range(len(views)):
            of_view = index == v
            moved[:, of_view] = points[:, of_view] @ T[:, v, :3, :3].transpose(0, 2, 1) + T[:, None, v, :3, 3]
        return moved

    def point_modes(self, v: int, index: Indices) -> Array:
        """(P + K, N, 3) by which points of view v move per unit of each parameter and smooth error, scanner frame."""
        scan = self.capture.scans[v]
        cosine = self.measurement.scan_views[v].cosine[index]
        smooth = -error_shapes(scan.points[index] - scan.eye, cosine, self.half).vectors
        return smooth if self.slopes is None else np.concatenate([self.slopes.at(v, self.poses[v], index), smooth])

    def scan_modes(self, v: int, index: Indices) -> tuple[Array, Array]:
        """Return rays (N, 3) to points of view v, scanner frame, and by how much each mode of its own smooth errors
        (N, M) moves them along."""
        assert self.scan_errors is not None
        scan = self.capture.scans[v]
        away = scan.points[index] - scan.eye
        return away / np.linalg.norm(away, axis=1)[:, None], self.scan_errors.along(away)


def twist_slopes(arms: Array, gradient: Array) -> Array:
    """Return (q, 6): Σ [arm × slope, slope], what a left twist of N points does to numbers with slopes (q, N, 3).

    Args:
        arms: (N, 3) from the point that the twist turns about to each point, the frame of the slopes.
    """
    return np.hstack([np.cross(arms, gradient).sum(axis=1), gradient.sum(axis=1)])


def point_sigmas(places: PlaceErrors, cloud: FusedCloud) -> Array:
    """Return (N,) by which each fused point may lie off along its normal, one sigma, length_unit."""
    scans = places.capture.scans
    cell = _WITHIN * float(np.median([scan.scanned_spacing for scan in scans]))
    out = np.empty(len(cloud.points))
    rows = max(_HELD // sum(source.views.shape[1] for source in places.sources), 1)
    for start in range(0, len(out), rows):
        block = slice(start, start + rows)
        out[block] = _sigmas(places, cloud.points[block], cloud.normals[block], cell)
    return out


def _sigmas(places: PlaceErrors, points: Array, normals: Array, cell: float) -> Array:
    seen, nearest = _views_of(places, points, cell)
    lever = frames.plane_rows(points - places.centre, normals)
    sets, member = np.unique(seen, axis=0, return_inverse=True)
    square = np.zeros(len(points))
    twists = [source.views.reshape(len(places.poses), 6, -1) for source in places.sources]
    for k, views in enumerate(sets):
        at = np.flatnonzero(member.ravel() == k)
        shares = views / max(views.sum(), 1)
        mean = np.concatenate([np.tensordot(shares, t, axes=1) for t in twists], axis=1)
        moved = lever[at] @ mean + _of_points(places, views, shares, nearest[at], normals[at])
        square[at] = np.einsum("nm,nm->n", moved, moved)
        square[at] += sum(share**2 * scan.noise**2 for share, scan in zip(shares, places.capture.scans, strict=True))
    return np.sqrt(square)


def _views_of(places: PlaceErrors, points: Array, cell: float) -> tuple[Mask, Indices]:
    """(N, V) which views see each point, at least the nearest one, and the nearest point of every view."""
    distance = np.empty((len(points), len(places.poses)))
    index = np.empty((len(points), len(places.poses)), np.int64)
    for v, (scan, T) in enumerate(zip(places.capture.scans, places.poses, strict=True)):
        d, i = scan.tree.query(np.ascontiguousarray(frames.transform(frames.inverse(T), points)), k=1)
        distance[:, v] = d.ravel()
        index[:, v] = i.ravel()
    return (distance < cell) | (distance == distance.min(axis=1, keepdims=True)), index


def _of_points(places: PlaceErrors, views: Mask, shares: Array, nearest: Indices, normals: Array) -> Array:
    """(n, modes) by which errors of the points themselves move fused points along their normals."""
    out = np.zeros((len(normals), sum(source.views.shape[1] for source in places.sources)))
    shapes = np.hstack([source.shapes for source in places.sources])
    ends = np.cumsum([source.views.shape[1] for source in places.sources])
    of_scan = {s.scan: slice(end - s.views.shape[1], end) for s, end in zip(places.sources, ends, strict=True)}
    for v in np.flatnonzero(views):
        seen = frames.rotate(frames.inverse(places.poses[v]), normals)
        out += shares[v] * np.einsum("ni,kni->nk", seen, places.point_modes(int(v), nearest[:, v])) @ shapes
        if places.scan_errors is not None:
            along_ray, modes = places.scan_modes(int(v), nearest[:, v])
            out[:, of_scan[int(v)]] += shares[v] * np.einsum("ni,ni->n", seen, along_ray)[:, None] * modes
    return out


def write_sigmas(path: Path, sigma: Array) -> None:
    """Write the points' sigma as a column of stitched.ply, whole or not at all."""
    columns = vertex_columns(path) | {"sigma": sigma.astype("<f4")}
    rows = np.empty(len(sigma), [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        rows[name] = column
    with whole_file(path) as file:
        write_ply(file, {"vertex": rows})
