"""What the scans show at one place before the scanner whatever the arm did: a wall, a table, a bracket, and no part.

Where scanner or part are carried around, what belongs to the part changes its place before the scanner with every
view. What does not belongs to the scanner, and every view puts it elsewhere in the stitched cloud. A panel that slides
along itself, or a disc that turns about its axis, looks as if it stood still too; but under the model others show it
where it is, and nobody looks through it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pykdtree.kdtree import KDTree

from stitch import frames
from stitch.frames import Array, Indices, Mask
from stitch.integrity.shown import points_in_place
from stitch.measurement.scan import Scan
from stitch.observations.surfaces.match import sample_points

# Points of a scan that are asked, other scans in which they are sought, and how many of these must move them, by what
# share of the part's size.
_BACKGROUND_PROBES, _BACKGROUND_VIEWS_COMPARED, _LEAST, _MOVED = 200, 12, 3, 0.1
# Share of the scans' points that is worth a word. Where one of these is looked through under the model it is not on the
# part, where another shows it there it is: so many must be looked through, and 20 to 1.
_BACKGROUND_MIN_SHARE, _THROUGH, _ODDS = 0.01, 5, 20.0
# Of the part's size between it and what stands still, so that a box can part them.
_GAP = 0.02
# Behind a point is farther than so many spacings.
_BEHIND = 4.0


@dataclass(frozen=True)
class StaticBackground:
    """What stands still before the scanner."""

    share: float  # of the points of all scans
    views: tuple[int, ...]  # that show it
    box: Array  # (2, 3) lowest and highest corner, scanner frame
    within: Array | None  # (2, 3) corners of a box with the part and without it, where one side of a box parts them

    def describe(self, length_unit: str) -> str:
        """In words, and what to do."""
        sides = (f"{axis} {low:.4g} to {high:.4g}" for axis, low, high in zip("xyz", *self.box, strict=True))
        mend = f"Cut {', '.join(sides)} {length_unit} out of the scans"
        if self.within is not None:
            low, high = (", ".join(f"{side:.4g}" for side in corner) for corner in self.within)
            mend = f"State within = [[{low}], [{high}]] under [scanner] in session.toml"
        return (
            f"{self.share:.0%} of what the scans show stands still before the scanner whatever the arm did: a wall, a "
            f"table or a bracket, which is in the stitched cloud at {len(self.views)} places. {mend}, and run again."
        )


def find_static_background(
    scans: Sequence[Scan], poses: Array, tolerance: float, size: float
) -> StaticBackground | None:
    """What stands still before the scanner, if that is worth a word.

    Args:
        poses: (V, 4, 4) T_reference_scanner under the model.
        tolerance: distance along the normal that is the same place, length_unit.
        size: of the part, length_unit.
    """
    probes = [sample_points(scan, _BACKGROUND_PROBES) for scan in scans]
    points = [scan.points[own] for scan, own in zip(scans, probes, strict=True)]
    others = [[scans[w] for w in _views_moving_points(own, poses, v, size)] for v, own in enumerate(points)]
    stays = [_static_points(scan, own, far, tolerance) for scan, own, far in zip(scans, probes, others, strict=True)]
    still = np.concatenate(stays)
    if still.mean() < _BACKGROUND_MIN_SHARE:
        return None
    looks = [KDTree(scan.rays(scan.points)) for scan in scans]
    judged = [_under_model(scans, looks, poses, (v, own), tolerance) for v, own in enumerate(probes)]
    on_part, through = (np.concatenate([found[i] for found in judged]) for i in range(2))
    if np.sum(still & through & ~on_part) < max(_THROUGH, _ODDS * np.sum(still & on_part)):
        return None
    every = np.concatenate(points)
    return StaticBackground(
        share=float(np.mean(still & ~on_part)),
        views=tuple(v for v, own in enumerate(stays) if own.any()),
        box=_bounding_box(every[still & ~on_part]),
        within=_box_beyond_part(every[on_part & ~still], every[still & ~on_part], _bounding_box(every), size),
    )


def _bounding_box(points: Array) -> Array:
    return np.array([points.min(axis=0), points.max(axis=0)])


def _box_beyond_part(part: Array, other: Array, every: Array, size: float) -> Array | None:
    """(2, 3) the box of everything, widened, less what lies beyond the side that parts best."""
    out = every + size * np.array([[-1.0], [1.0]])
    if not len(part):
        return None
    (low, high), (other_low, other_high) = _bounding_box(part), _bounding_box(other)
    gaps = np.array([low - other_high, other_low - high])
    side, axis = np.unravel_index(gaps.argmax(), gaps.shape)
    if gaps[side, axis] < _GAP * size:
        return None
    # Nearer to what stands still: between the probes the part may reach farther.
    near, far = (low[axis], other_high[axis]) if side == 0 else (high[axis], other_low[axis])
    out[side, axis] = 0.2 * near + 0.8 * far
    return np.asarray(out)


def _views_moving_points(points: Array, poses: Array, v: int, size: float) -> list[int]:
    """Views between which and view v the model moves its points before the scanner, evenly over the session."""
    if not len(points):
        return []
    there = frames.transform(frames.inverse(poses) @ poses[v], points[None])
    far = np.flatnonzero(np.median(np.linalg.norm(there - points, axis=2), axis=1) > _MOVED * size)
    return [int(w) for w in far[np.linspace(0, len(far) - 1, min(len(far), _BACKGROUND_VIEWS_COMPARED)).astype(int)]]


def _static_points(scan: Scan, own: Indices, others: Sequence[Scan], tolerance: float) -> Mask:
    """(n,) points that most of the others show at the same place before the scanner."""
    if len(others) < _LEAST:
        return np.zeros(len(own), bool)
    points, normals = scan.points[own], scan.normals[own]
    return np.asarray(np.mean([points_in_place(other, points, normals, tolerance) for other in others], axis=0) > 0.5)


def _under_model(
    scans: Sequence[Scan], looks: Sequence[KDTree], poses: Array, probes: tuple[int, Indices], tolerance: float
) -> tuple[Mask, Mask]:
    """(n,) (n,) points of a view that another shows where the model has them, and that another looks through there."""
    v, own = probes
    on_part, through = np.zeros(len(own), bool), np.zeros(len(own), bool)
    for w, scan in enumerate(scans):
        if w == v or not len(own):
            continue
        T_w_v = frames.inverse(poses[w]) @ poses[v]
        points = frames.transform(T_w_v, scans[v].points[own])
        normals = frames.rotate(T_w_v, scans[v].normals[own])
        on_part |= points_in_place(scan, points, normals, tolerance)
        away = np.linalg.norm(points - scan.eye, axis=1)
        beside, partner = looks[w].query(scan.rays(points), k=1)
        hit = beside * away < 2 * scan.spacing
        seen = np.linalg.norm(scan.points[partner.astype(int)] - scan.eye, axis=1)
        through |= hit & (seen > away + _BEHIND * scan.spacing)
    return on_part, through
