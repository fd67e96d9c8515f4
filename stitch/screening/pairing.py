"""Views that do not belong, explained: exchanged rows, a neighbour's joints, a copy, a wrong digit, another part."""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.optimize import minimize_scalar

from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.screening.placement import (
    CLOSE_SHARE,
    FEW_SHARED,
    ReferenceSurface,
    place_scan,
    shows_no_surface,
    surface_of,
)
from stitch.screening.problems import SessionProblem, displacement_text, list_views, names_of_views
from stitch.screening.scan_faults import find_copies, find_same_poses, scale_fault, scan_fault
from stitch.screening.snooping import MisplacedView, Snooping, end_runs
from stitch.session.capture import Capture, part_size
from stitch.session.robot import forward
from stitch.session.session import SessionData

# So many views make a step, and this share of those on its side; displacements agree within this share of their size.
_FEWEST, _SHARE, _AGREES = 3, 0.7, 0.2


def find_common_displacement(
    capture: Capture, poses: Array, misplaced: Sequence[MisplacedView]
) -> tuple[range, str] | None:
    """Find the views at one end of the list that stand off alike, with what moved: part or scanner; None if none do.

    The part was clamped anew, or the scanner moved on its mount.

    Args:
        poses: (V, 4, 4) T_reference_scanner of the model.
    """
    placed = {m.view: m.T for m in misplaced if m.T is not None}
    runs = end_runs({m.view for m in misplaced}, len(poses))
    for views in (run for run in runs if len(run) >= _FEWEST):
        for what in ("part", "scanner"):
            some = {v: placed[v] for v in views if v in placed}
            if _count_sharing_displacement(capture, poses, some, what) >= _SHARE * len(views):
                return views, what
    return None


def _count_sharing_displacement(capture: Capture, poses: Array, placed: Mapping[int, Array], what: str) -> int:
    """Count the views that share one displacement, at most: a left twist of the part or a right one of the scanner."""
    best = 0
    for v, T in placed.items():
        back = frames.inverse(poses[v])
        sharing = 0
        for w, there in placed.items():
            expected = T @ back @ poses[w] if what == "part" else poses[w] @ back @ T
            points = capture.scans[w].points[::50]
            stated, fitted, shared = (frames.transform(pose, points) for pose in (poses[w], there, expected))
            sharing += bool(np.linalg.norm(shared - fitted) < _AGREES * np.linalg.norm(fitted - stated))
        best = max(best, sharing)
    return best if best >= _FEWEST else 0


# One joint explains a displacement if it leaves less than this share of it.
_MAX_REMAINING_SHARE = 0.1


def find_wrong_joint(
    session: SessionData, capture: Capture, T_mount: Array, m: MisplacedView
) -> tuple[str, float, float, bool] | None:
    """Find the joint that alone explains a displacement: name, degrees stated and that fit, whether a neighbour's."""
    robot, joints = session.robot, session.views[m.view].joints
    if robot is None or joints is None or m.T is None:
        return None
    points = capture.scans[m.view].points[::50]
    there = frames.transform(m.T, points)

    def off(q: Array) -> float:
        T = forward(robot, q)
        T = frames.inverse(T) if session.mount == "eye_to_hand" else T
        return float(np.sqrt(((frames.transform(T @ T_mount, points) - there) ** 2).sum(axis=1).mean()))

    start = off(joints)
    best: tuple[float, int, float] = (np.inf, 0, 0.0)
    for j in range(len(joints)):
        unit = np.eye(len(joints))[j]
        grid = np.linspace(-np.pi, np.pi, 181)
        near = grid[int(np.argmin([off(joints + a * unit) for a in grid]))]
        for a in (near, 0.0):
            fit = minimize_scalar(lambda x, u=unit: off(joints + x * u), bracket=(a - 0.02, a + 0.02))
            best = min(best, (float(fit.fun), j, float(fit.x)))
    left, j, turn = best
    if left > _MAX_REMAINING_SHARE * start:
        return None
    fits = joints[j] + turn
    others = [session.views[r].joints for r in (m.view - 1, m.view + 1) if 0 <= r < len(session.views)]
    neighbour = any(q is not None and abs(q[j] - joints[j]) < 1e-9 for q in others)
    return f"j{j + 1}_deg", float(np.degrees(joints[j])), float(np.degrees(fits)), neighbour


# A scan belongs to another row's pose if it lies this much closer to that than to its own, and this close absolutely
# (`CLOSE_SHARE` of the part's size).
_CLOSER_SHARE = 0.2


def find_fitting_rows(capture: Capture, found: Snooping, misplaced: Sequence[MisplacedView]) -> dict[int, int | None]:
    """Return for every misplaced scan that fits the part the row to whose pose it belongs; None for no other row."""
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
    """Find pairs of views of which one's scan fits the other's pose, whose own scan shows too little.

    Args:
        rows: of `find_fitting_rows`, less those of closed rounds.
    """
    silent = {m.view for m in misplaced if rows.get(m.view) is None} & set(rows.values())
    claimed = {row: [v for v, other in rows.items() if other == row] for row in silent}
    return [(views[0], row) for row, views in claimed.items() if len(views) == 1 and views[0] not in rows.values()]


def exchange_cycles(rows: dict[int, int | None]) -> list[tuple[int, ...]]:
    """Find closed rounds of scans that stand in each other's rows."""
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
    """Return the row to whose pose a scan that was placed belongs, if to another one."""
    off = _pose_distances(capture, view, T, poses)
    best = int(np.argmin(off))
    close = off[best] < max(CLOSE_SHARE * part_size([capture]), 1e-12) and off[best] < _CLOSER_SHARE * off[view]
    return best if close and best != view else None


def _row_where_it_fits(
    capture: Capture, found: Snooping, surface: ReferenceSurface, view: int, rows: Sequence[int]
) -> int | None:
    """Return the row in which a scan, moved least, fits the others; None for its own."""
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


_TORN = (
    "a part of this scan contradicts the other scans wherever it is put: something moved during the scan, or two scans "
    "are in one file; to fix: scan again"
)
_EXCHANGED = (
    "the scan of {0} fits the pose of {1}, whose own scan shows too little of the others to be placed; to fix: "
    "exchange the clouds of {0} and {1} in views.csv, or leave both out"
)
_SEVERAL = (
    "this scan overlaps too little with the others at its pose, and fits the part at several other places alike; to "
    "fix: add views that overlap with it, or leave it out"
)
_COPY = "this scan is a copy of that of {}; to fix: put the right file in its row"


def explain_misplaced(session: SessionData, capture: Capture, T_mount: Array, found: Snooping) -> list[SessionProblem]:
    """Return one problem for everything that snooping found, with the rows and what to do.

    Args:
        session, capture: with the same views.
        T_mount: (4, 4) hand-eye under which `found` was made.
    """
    names, out, open_ones = session.names, list[SessionProblem](), {m.view: m for m in found.misplaced}

    def explain(kind: str, views: Sequence[int], fix: str) -> None:
        out.append(SessionProblem(kind, names_of_views(views, names), fix))
        for v in views:
            open_ones.pop(v, None)

    for v, w in find_copies(capture):
        bad, good = (v, w) if v in found.left_out and w not in found.left_out else (w, v)
        open_ones.pop(bad, None)
        out.append(SessionProblem("duplicate_scan", (names[v], names[w]), _COPY.format(names[good])))
    rows = find_fitting_rows(capture, found, [*open_ones.values()])
    for cycle in exchange_cycles(rows):
        explain("exchanged", cycle, _exchange_fix(cycle, rows, names))
    left = {v: row for v, row in rows.items() if v in open_ones}
    for v, row in exchanged_pairs(left, [*open_ones.values()]):
        explain("exchanged", sorted((v, row)), _EXCHANGED.format(names[v], names[row]))
    step = None if found.steps else find_common_displacement(capture, found.expected, [*open_ones.values()])
    if step is not None:
        explain("reclamped", *_reclamped(step[0], step[1], names))
    same = find_same_poses(capture)
    out += [_single_view_problem(session, capture, T_mount, found, m, same) for m in open_ones.values()]
    for s in found.steps:
        side = range(s.start) if s.start <= found.largest_segment.start else range(s.start, len(names))
        explain("reclamped", *_reclamped(side, s.moved if s.distinguishable else "either", names))
    if len(found.disconnected) > 1:
        shown = " | ".join(list_views(names_of_views(group, names), names) for group in found.disconnected)
        views = [v for group in found.disconnected[1:] for v in group]
        explain("disconnected", views, f"no surface links {shown}; to fix: add views between them")
    return out


def _exchange_fix(cycle: Sequence[int], rows: dict[int, int | None], names: Sequence[str]) -> str:
    if len(cycle) == 2:
        pair = f"{names[cycle[0]]} and {names[cycle[1]]}"
        return f"the scans of {pair} fit each other's poses; to fix: exchange the clouds of {pair} in views.csv"
    moves = ", ".join(f"the cloud of {names[v]} to row {names[int(rows[v] or 0)]}" for v in cycle)
    return f"the clouds of {len(cycle)} rows are mixed up; to fix: move {moves}"


def _reclamped(views: range, moved: str, names: Sequence[str]) -> tuple[range, str]:
    """Return views at one end of the list that stand off from the rest, and what to do."""
    start = views.start or views.stop
    what = {"part": "the part was clamped anew", "scanner": "the scanner moved on its mount"}.get(
        moved, "the part or the scanner moved"
    )
    return views, f"{what} between {names[start - 1]} and {names[start]}; to fix: make two sessions of it"


def _single_view_problem(
    session: SessionData,
    capture: Capture,
    T_mount: Array,
    found: Snooping,
    m: MisplacedView,
    same: Sequence[tuple[int, int]],
) -> SessionProblem:
    names, scan = session.names, capture.scans[m.view]
    own = (names[m.view],)
    if m.kind != "several" and not shows_no_surface(scan):
        # Something may be wrong with the cloud rather than with its pose.
        others = [v for v in found.linkage.core if v != m.view]
        surface = surface_of(capture.scans, found.unconstrained.poses, others, found.tolerance)
        look = scan_fault if m.T is None else scale_fault
        fault = look(scan, found.expected[m.view], surface, part_size([capture]), found.needed)
        if fault is not None:
            return SessionProblem(fault.kind, own, fault.fix)
    if m.kind == "torn":
        return SessionProblem("displaced", own, _TORN)
    if m.kind == "several":
        return SessionProblem("foreign", own, _SEVERAL)
    if m.T is None:
        return SessionProblem(
            "foreign",
            own,
            "this scan fits nowhere on the part: it shows another part or too little; to fix: leave it out",
        )
    amount = displacement_text((m.rotation, m.distance), m.at_least, session.length_unit)
    off = f"off by {amount}" if amount else "off by an amount that its surface does not show"
    partner = next((v if w == m.view else w for v, w in same if m.view in (v, w)), None)
    if partner is not None:
        joint = session.views[m.view].joints is not None and abs(partner - m.view) == 1
        kind = "joint_row" if joint else "duplicate_pose"
        what = "joint angles" if joint else "pose"
        fix = f"{own[0]} has the {what} of {names[partner]}, and is {off}; to fix: put in its own"
        return SessionProblem(kind, (*own, names[partner]), fix)
    digit = find_wrong_joint(session, capture, T_mount, m)
    if digit is not None:
        joint_name, stated, fits, neighbour = digit
        kind = "joint_row" if neighbour else "displaced"
        reads = f"{joint_name} of {own[0]} reads {stated:.4f}, {fits:.4f} would fit (it is {off})"
        return SessionProblem(kind, own, f"{reads}; to fix: correct it")
    return SessionProblem("displaced", own, f"its pose is {off}; to fix: correct the row, or scan again")
