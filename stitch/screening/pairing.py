"""Views that do not belong, explained: exchanged rows, a neighbour's joints, a copy, a wrong digit, another part."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.screening.hypotheses import problem
from stitch.screening.placement import (
    CLOSE_SHARE,
    FEW_SHARED,
    ReferenceSurface,
    place_scan,
    pose_distances,
    shows_no_surface,
    surface_of,
)
from stitch.screening.problems import SessionProblem, displacement_text, list_views
from stitch.screening.scan_faults import find_copies, find_same_poses, scale_fault, scan_fault
from stitch.screening.snooping import MisplacedView, Snooping
from stitch.session.capture import Capture, part_size
from stitch.session.robot import forward
from stitch.session.session import SessionData

# A scan belongs to another row's pose if it lies this much closer to that than to its own, and this close absolutely
# (`CLOSE_SHARE` of the part's size).
_CLOSER_SHARE = 0.2
# One joint explains a displacement if it leaves less than this share of it.
_MAX_REMAINING_SHARE = 0.1
# What sits elsewhere from some row on, by what moved.
_MOVED = {"part": "the part was clamped anew", "scanner": "the scanner moved on its mount"}


def explain_misplaced(session: SessionData, snooping: Snooping) -> list[SessionProblem]:
    """Return the problems that explain every view and step which snooping found, with the rows and what to do.

    What one mistake of several rows explains is not blamed on single views: copies first, then scans that fit each
    other's rows, then views by themselves; steps and groups without a common surface are named as such.

    Args:
        session: with the views that were tested.
    """
    names = session.names
    unexplained = {m.view: m for m in snooping.misplaced}
    out = list[SessionProblem]()

    def explain(mistake: str, views: Sequence[int], **words: Any) -> None:
        """Add a problem of some views, which then are no more to be explained."""
        out.append(problem(mistake, [names[v] for v in views], **words))
        for v in views:
            unexplained.pop(v, None)

    for v, w in find_copies(snooping.capture):
        bad, good = (v, w) if v in snooping.left_out and w not in snooping.left_out else (w, v)
        unexplained.pop(bad, None)
        out.append(problem("copied scan", (names[v], names[w]), of=names[good]))
    rows = find_fitting_rows(snooping, [*unexplained.values()])
    for cycle in exchange_cycles(rows):
        if len(cycle) == 2:
            explain("pair", cycle, pair=f"{names[cycle[0]]} and {names[cycle[1]]}")
        else:
            moves = ", ".join(f"the cloud of {names[v]} to row {names[int(rows[v] or 0)]}" for v in cycle)
            explain("cycle", cycle, count=len(cycle), moves=moves)
    rest = {v: row for v, row in rows.items() if v in unexplained}
    for v, row in exchanged_pairs(rest, [*unexplained.values()]):
        explain("pair with a silent scan", sorted((v, row)), view=names[v], silent=names[row])
    same = find_same_poses(snooping.capture)
    out += [_single_view_problem(session, snooping, m, same) for m in unexplained.values()]
    for step in snooping.steps:
        side = range(step.start) if step.start <= snooping.largest_segment.start else range(step.start, len(names))
        what = _MOVED[step.moved] if step.distinguishable else "the part or the scanner moved"
        explain("moved", side, what=what, before=names[step.start - 1], after=names[step.start])
    if snooping.alone:
        for v in snooping.alone:
            explain("alone", [v])
    elif len(snooping.disconnected) > 1:
        groups = " | ".join(list_views([names[v] for v in group], names) for group in snooping.disconnected)
        explain("groups", [v for group in snooping.disconnected[1:] for v in group], groups=groups)
    return out


def _single_view_problem(
    session: SessionData, snooping: Snooping, m: MisplacedView, same: Sequence[tuple[int, int]]
) -> SessionProblem:
    """Return what is wrong with one view: its cloud, a pose copied from another row, one joint, or else its pose.

    Args:
        m: how the view stands off; `T` is None where its surface fits nowhere.
        same: pairs of views that have the very same pose.
    """
    names = session.names
    name = names[m.view]
    capture = snooping.capture
    scan = capture.scans[m.view]
    others = [v for v in snooping.linkage.core if v != m.view]
    if others and m.kind != "several" and not shows_no_surface(scan):
        # Something may be wrong with the cloud rather than with its pose.
        surface = surface_of(capture.scans, snooping.unconstrained.poses, others, snooping.tolerance)
        look = scan_fault if m.T is None else scale_fault
        fault = look(scan, snooping.expected[m.view], surface, part_size([capture]), snooping.needed)
        if fault is not None:
            return problem(fault[0], [name], **fault[1])
    if m.kind == "torn":
        return problem("torn", [name])
    if m.kind == "several":
        return problem("several places", [name])
    if m.T is None:
        return problem("foreign", [name])
    amount = displacement_text((m.rotation, m.distance), m.at_least, session.length_unit)
    off = f"off by {amount}" if amount else "off by an amount that its surface does not show"
    partner = next((v if w == m.view else w for v, w in same if m.view in (v, w)), None)
    if not amount and partner is None:
        return problem("not held", [name])
    if partner is not None:
        by_joints = session.views[m.view].joints is not None and abs(partner - m.view) == 1
        mistake = "copied joints" if by_joints else "copied pose"
        return problem(mistake, (name, names[partner]), view=name, of=names[partner], off=off)
    joint = find_wrong_joint(session, snooping, m)
    if joint is None:
        return problem("displaced", [name], off=off)
    column, stated, fits, is_neighbours = joint
    mistake = "neighbour's joint" if is_neighbours else "wrong joint"
    return problem(mistake, [name], view=name, joint=column, stated=stated, fits=fits, off=off)


def find_wrong_joint(
    session: SessionData, snooping: Snooping, m: MisplacedView
) -> tuple[str, float, float, bool] | None:
    """Return the joint that alone explains a view's displacement; None where no joint does, or joints are not known.

    Returned are its column in views.csv, the angle stated and the angle that fits (deg), and whether the angle stated
    is that of the row before or after. It has to leave less than `_MAX_REMAINING_SHARE` of the displacement.
    """
    robot = session.robot
    joints = session.views[m.view].joints
    if robot is None or joints is None or m.T is None or session.axes:
        return None
    scan, T_fits = snooping.capture.scans[m.view], m.T

    def distance_at(q: Array) -> float:
        """Return the rms distance (length_unit) of the scan's points at joints q (n,), rad, from where they fit."""
        T = forward(robot, q)
        T = frames.inverse(T) if session.mount == "eye_to_hand" else T
        return float(pose_distances(scan, T_fits, (T @ snooping.T_mount)[None])[0])

    best: tuple[float, int, float] = (np.inf, 0, 0.0)
    for j in range(len(joints)):
        unit = np.eye(len(joints))[j]
        grid = np.linspace(-np.pi, np.pi, 181)
        nearest = grid[int(np.argmin([distance_at(joints + turn * unit) for turn in grid]))]
        for start in (nearest, 0.0):
            fit = minimize_scalar(lambda x, u=unit: distance_at(joints + x * u), bracket=(start - 0.02, start + 0.02))
            best = min(best, (float(fit.fun), j, float(fit.x)))
    remaining, j, turn = best
    if remaining > _MAX_REMAINING_SHARE * distance_at(joints):
        return None
    others = [session.views[row].joints for row in (m.view - 1, m.view + 1) if 0 <= row < len(session.views)]
    is_neighbours = any(q is not None and abs(q[j] - joints[j]) < 1e-9 for q in others)
    return f"j{j + 1}_deg", float(np.degrees(joints[j])), float(np.degrees(joints[j] + turn)), is_neighbours


def find_fitting_rows(snooping: Snooping, misplaced: Sequence[MisplacedView]) -> dict[int, int | None]:
    """Return, by misplaced view whose scan fits the part, the row to whose pose the scan belongs; None: no other row.

    First the row whose pose is near where the scan was placed. Where there is none, and several views are misplaced,
    scans may slide along the part: then the row at whose pose the scan fits.
    """
    capture = snooping.capture
    rows = {m.view: _nearest_row(capture, snooping.expected, m.view, m.T) for m in misplaced if m.T is not None}
    elsewhere = [view for view, row in rows.items() if row is None]
    core = [v for v in snooping.linkage.core if v not in snooping.not_belonging]
    if not elsewhere or not core or len(misplaced) < 2:
        return rows
    surface = surface_of(capture.scans, snooping.unconstrained.poses, core, snooping.tolerance)
    every = [m.view for m in misplaced]
    return rows | {v: _row_where_it_fits(snooping, surface, v, every) for v in elsewhere}


def _nearest_row(capture: Capture, poses: Array, view: int, T: Array) -> int | None:
    """Return the row whose pose is near T and much nearer to it than the scan's own row; None if there is none.

    Args:
        poses: (V, 4, 4) T_reference_scanner of the rows.
        T: (4, 4) T_reference_scanner where the scan fits.
    """
    off = pose_distances(capture.scans[view], T, poses)
    best = int(np.argmin(off))
    close = off[best] < max(CLOSE_SHARE * part_size([capture]), 1e-12) and off[best] < _CLOSER_SHARE * off[view]
    return best if close and best != view else None


def _row_where_it_fits(snooping: Snooping, surface: ReferenceSurface, view: int, rows: Sequence[int]) -> int | None:
    """Return the row of views.csv at whose pose a scan fits the surface, the one that needs the smallest motion.

    None if the scan fits at its own row, even where another row needs less motion, and None if it fits at no row.

    Args:
        surface: of the views that belong together.
        view: number of the scan, and of its own row.
        rows: numbers of the rows that are tried.
    """
    capture = snooping.capture
    near = CLOSE_SHARE * part_size([capture])
    motion_needed = dict[int, float]()
    for row in rows:
        T = snooping.expected[row]
        best = place_scan(capture.scans[view], surface, T[None], near)[0]
        moved = float(pose_distances(capture.scans[view], best.T, T[None])[0])
        if best.closure > snooping.needed and best.near > FEW_SHARED and moved < near:
            motion_needed[row] = moved
    if view in motion_needed:
        return None
    return min(motion_needed, key=lambda row: motion_needed[row], default=None)


def exchange_cycles(rows: dict[int, int | None]) -> list[tuple[int, ...]]:
    """Return cycles of views: the scan of each belongs to the row of the next, that of the last to the first row.

    Args:
        rows: by view, the row to whose pose its scan belongs; None: not known.
    """
    cycles = []
    seen = set[int]()
    for start in sorted(rows):
        path = [start]
        row = rows[start]
        while row is not None and row not in path and row not in seen:
            path.append(row)
            row = rows.get(row)
        if row == start and len(path) > 1:
            cycles.append(tuple(path))
            seen |= set(path)
    return cycles


def exchanged_pairs(rows: dict[int, int | None], misplaced: Sequence[MisplacedView]) -> list[tuple[int, int]]:
    """Return pairs (view, row): the view's scan alone fits the row's pose, and the row's own scan fits nowhere.

    Then the two are probably exchanged, and the second shows too little to prove it.

    Args:
        rows: of `find_fitting_rows`, without the views of cycles.
    """
    silent = {m.view for m in misplaced if rows.get(m.view) is None} & set(rows.values())
    claimed = {row: [v for v, other in rows.items() if other == row] for row in silent}
    return [(views[0], row) for row, views in claimed.items() if len(views) == 1 and views[0] not in rows.values()]
