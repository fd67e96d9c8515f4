"""Views that do not belong, explained: exchanged rows, a neighbour's joints, a copy, a wrong digit, another part."""

from collections.abc import Sequence

from stitch.frames import Array
from stitch.integrity.amounts import off_by
from stitch.integrity.common_step import common_step
from stitch.integrity.linkage import only
from stitch.integrity.one_joint import one_joint
from stitch.integrity.other_rows import changed_places, closed_rounds, rows_of
from stitch.integrity.placing import shows_no_surface, surface_of
from stitch.integrity.problems import Problem
from stitch.integrity.scan_faults import ScanFault, copies, same_poses, scale_fault, scan_fault
from stitch.integrity.snooping import Misplaced, Snooping
from stitch.integrity.view_names import listed
from stitch.measurement.capture import Capture, part_size
from stitch.measurement.session import Session

_TORN = (
    "a part of this scan contradicts the other scans wherever it is put: the part or the scanner moved meanwhile, or "
    "two scans are in one file; scan again or leave the view out"
)
_CHANGED = (
    "the scan of {0} fits the pose of {1}, whose own scan belongs elsewhere and shows too little of the others to tell "
    "where: exchange the clouds of {0} and {1} in views.csv, or leave both out"
)
_COPY = "this scan is a copy of that of {}: put the right file in its row"


def explain(session: Session, capture: Capture, T_mount: Array, found: Snooping) -> list[Problem]:
    """One problem for everything that snooping found, with the rows and what to do.

    Args:
        session, capture: with the same views.
        T_mount: (4, 4) hand-eye under which `found` was made.
    """
    names = session.names
    poses = found.expected
    out, told = [], set[int]()
    for v, w in copies(capture):
        bad = _worse(found, v, w)
        told.add(bad)
        good = v if bad == w else w
        out.append(Problem("duplicate_scan", (names[v], names[w]), _COPY.format(names[good])))
    misplaced = [m for m in found.misplaced if m.view not in told]
    rows = rows_of(capture, found, misplaced)
    cycles = closed_rounds(rows)
    for cycle in cycles:
        told |= set(cycle)
        out.append(Problem("exchanged", tuple(only(cycle, names)), _exchange(cycle, rows, names)))
    left = {v: row for v, row in rows.items() if v not in told}
    for v, row in changed_places(left, [m for m in misplaced if m.view not in told]):
        told |= {v, row}
        out.append(Problem("exchanged", tuple(only(sorted((v, row)), names)), _CHANGED.format(names[v], names[row])))
    step = common_step(capture, poses, [m for m in misplaced if m.view not in told]) if not found.steps else None
    if step is not None:
        told |= set(step[0])
        out.append(_reclamped(step[0], step[1], names))
    same = same_poses(capture)
    for m in misplaced:
        if m.view not in told:
            out.append(_single(session, capture, T_mount, found, m, same))
    for s in found.steps:
        side = range(s.start) if s.start <= found.between.start else range(s.start, len(names))
        out.append(_reclamped(side, s.moved if s.told else "either", names))
    if len(found.disconnected) > 1:
        shown = " | ".join(listed(only(group, names), names) for group in found.disconnected)
        views = tuple(n for group in found.disconnected[1:] for n in only(group, names))
        out.append(Problem("disconnected", views, f"no surface links {shown}: add views between them"))
    return out


def _worse(found: Snooping, v: int, w: int) -> int:
    """Of two views with the same scan, the one that does not belong."""
    return v if v in found.left_out and w not in found.left_out else w


def _exchange(cycle: Sequence[int], rows: dict[int, int | None], names: Sequence[str]) -> str:
    if len(cycle) == 2:
        return f"exchange the clouds of {names[cycle[0]]} and {names[cycle[1]]} in views.csv"
    moves = ", ".join(f"the cloud of {names[v]} to row {names[int(rows[v] or 0)]}" for v in cycle)
    return f"the clouds of {len(cycle)} rows are mixed up: move {moves}"


def _single(
    session: Session, capture: Capture, T_mount: Array, found: Snooping, m: Misplaced, same: Sequence[tuple[int, int]]
) -> Problem:
    names = session.names
    own = (names[m.view],)
    fault = _fault(capture, found, m)
    if fault is not None:
        return Problem(fault.kind, own, fault.fix)
    if m.kind == "torn":
        return Problem("displaced", own, _TORN)
    if m.T is None:
        return Problem(
            "foreign", own, "this scan fits nowhere on the part: it shows another part or too little; leave it out"
        )
    amount = off_by((m.rotation, m.distance), m.at_least, session.length_unit)
    off = f"off by {amount}" if amount else "off, by how much its surface does not tell"
    partner = next((v if w == m.view else w for v, w in same if m.view in (v, w)), None)
    if partner is not None:
        joint = session.views[m.view].joints is not None and abs(partner - m.view) == 1
        kind = "joint_row" if joint else "duplicate_pose"
        what = "joint angles" if joint else "pose"
        fix = f"{own[0]} has the {what} of {names[partner]}, and is {off}: put in its own"
        return Problem(kind, (*own, names[partner]), fix)
    digit = one_joint(session, capture, T_mount, m)
    if digit is not None:
        joint_name, stated, fits, neighbour = digit
        kind = "joint_row" if neighbour else "displaced"
        reads = f"{joint_name} of {own[0]} reads {stated:.4f}, {fits:.4f} would fit (it is {off})"
        return Problem(kind, own, f"{reads}: correct it or leave the view out")
    return Problem("displaced", own, f"its pose is {off}: correct the row, scan again or leave the view out")


def _fault(capture: Capture, found: Snooping, m: Misplaced) -> ScanFault | None:
    """What is wrong with the cloud of a view, rather than with its pose."""
    scan, T_pose = capture.scans[m.view], found.expected[m.view]
    if shows_no_surface(scan):
        return None
    others = [v for v in found.linkage.core if v != m.view]
    surface = surface_of(capture.scans, found.freed.poses, others, found.tolerance)
    look = scan_fault if m.T is None else scale_fault
    return look(scan, T_pose, surface, part_size([capture]), found.needed)


def _reclamped(views: range, moved: str, names: Sequence[str]) -> Problem:
    """Some views at one end of the list that stand off from the rest."""
    start = views.start or views.stop
    what = {"part": "the part was clamped anew", "scanner": "the scanner moved on its mount"}.get(
        moved, "the part or the scanner moved"
    )
    fix = f"{what} between {names[start - 1]} and {names[start]}: make two sessions of it"
    return Problem("reclamped", tuple(only(views, names)), fix)
