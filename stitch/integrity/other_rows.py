"""Scans that stand in the rows of others: which row's pose each of those that do not belong would fit."""

from collections.abc import Sequence

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.integrity.placed_groups import FEW_SHARED
from stitch.integrity.placing import ReferenceSurface, place_scan, surface_of
from stitch.integrity.snooping import MisplacedView, Snooping
from stitch.integrity.unlinked_views import CLOSE_SHARE
from stitch.measurement.capture import Capture, part_size

# A scan belongs to another row's pose if it lies this much closer to that than to its own, and this close absolutely
# (`CLOSE_SHARE` of the part's size).
_CLOSER_SHARE = 0.2


def find_fitting_rows(capture: Capture, found: Snooping, misplaced: Sequence[MisplacedView]) -> dict[int, int | None]:
    """Of every misplaced scan that fits the part the row to whose pose it belongs, None for no other row's."""
    some = [m for m in misplaced if m.T is not None]
    rows = {m.view: _nearest_row(capture, found.expected, m.view, m.T) for m in some if m.T is not None}
    open_ones = [view for view, row in rows.items() if row is None]
    if not open_ones or len(misplaced) < 2:
        return rows
    # Where scans slide along the part, each came to rest somewhere else than in the row where it would fit as well.
    core = [v for v in found.linkage.core if v not in found.not_belonging]
    surface = surface_of(capture.scans, found.unconstrained.poses, core, found.tolerance)
    every = [m.view for m in misplaced]
    return rows | {v: _row_where_it_fits(capture, found, surface, v, every) for v in open_ones}


def exchanged_pairs(rows: dict[int, int | None], misplaced: Sequence[MisplacedView]) -> list[tuple[int, int]]:
    """Pairs of views of which the first one's scan fits the second one's pose, and the second's shows too little.

    Args:
        rows: of `rows_of`, less those of closed rounds.
    """
    silent = {m.view for m in misplaced if rows.get(m.view) is None} & set(rows.values())
    claimed = {row: [v for v, other in rows.items() if other == row] for row in silent}
    return [(views[0], row) for row, views in claimed.items() if len(views) == 1 and views[0] not in rows.values()]


def exchange_cycles(rows: dict[int, int | None]) -> list[tuple[int, ...]]:
    """Closed rounds of scans that stand in each other's rows."""
    out, seen = [], set[int]()
    for start in sorted(rows):
        path, at = [start], rows[start]
        while at is not None and at not in path and at not in seen:
            path.append(at)
            at = rows.get(at)
        if at == start and len(path) > 1:
            out.append(tuple(path))
            seen |= set(path)
    return out


def _nearest_row(capture: Capture, poses: Array, view: int, T: Array) -> int | None:
    """The row to whose pose a scan that was placed belongs, if to another one."""
    off = _pose_distances(capture, view, T, poses)
    best = int(np.argmin(off))
    close = off[best] < max(CLOSE_SHARE * part_size([capture]), 1e-12) and off[best] < _CLOSER_SHARE * off[view]
    return best if close and best != view else None


def _row_where_it_fits(
    capture: Capture, found: Snooping, surface: ReferenceSurface, view: int, rows: Sequence[int]
) -> int | None:
    """Of some rows that in which a scan, moved least, fits the others, if not in its own."""
    near, moved = CLOSE_SHARE * part_size([capture]), dict[int, float]()
    for row in rows:
        T = found.expected[row]
        best = place_scan(capture.scans[view], surface, T[None], near)[0]
        away = float(_pose_distances(capture, view, best.T, T[None])[0])
        if best.closure > found.needed and best.near > FEW_SHARED and away < near:
            moved[row] = away
    best_row = min(moved, key=lambda row: moved[row], default=view)
    return best_row if view not in moved and best_row != view else None


def _pose_distances(capture: Capture, view: int, T: Array, poses: Array) -> Array:
    """(P,) rms distance between the points of a scan at one pose (4, 4) and at others (P, 4, 4)."""
    points = capture.scans[view].points[::50]
    there = frames.transform(T, points)
    return np.asarray(np.sqrt(((frames.transform(poses, points) - there) ** 2).sum(axis=2).mean(axis=1)))
