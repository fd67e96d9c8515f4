"""Views that do not belong, explained: exchanged rows, a neighbour's joints, a copy, a wrong digit, another part."""

from collections.abc import Sequence

from stitch.frames import Array
from stitch.integrity.amounts import displacement_text
from stitch.integrity.common_step import find_common_displacement
from stitch.integrity.linkage import names_of_views
from stitch.integrity.one_joint import find_wrong_joint
from stitch.integrity.other_rows import exchange_cycles, exchanged_pairs, find_fitting_rows
from stitch.integrity.placing import shows_no_surface, surface_of
from stitch.integrity.problems import SessionProblem
from stitch.integrity.scan_faults import ScanFault, find_copies, find_same_poses, scale_fault, scan_fault
from stitch.integrity.snooping import MisplacedView, Snooping
from stitch.integrity.view_names import list_views
from stitch.measurement.capture import Capture, part_size
from stitch.measurement.session import Session

_TORN = (
    "a part of this scan contradicts the other scans wherever it is put: the part or the scanner moved meanwhile, or "
    "two scans are in one file; scan again or leave the view out"
)
_EXCHANGED = (
    "the scan of {0} fits the pose of {1}, whose own scan belongs elsewhere and shows too little of the others to tell "
    "where: exchange the clouds of {0} and {1} in views.csv, or leave both out"
)
_COPY = "this scan is a copy of that of {}: put the right file in its row"


def explain_misplaced(session: Session, capture: Capture, T_mount: Array, found: Snooping) -> list[SessionProblem]:
    """One problem for everything that snooping found, with the rows and what to do.

    Args:
        session, capture: with the same views.
        T_mount: (4, 4) hand-eye under which `found` was made.
    """
    names = session.names
    poses = found.expected
    out, told = [], set[int]()
    for v, w in find_copies(capture):
        bad = _worse_of_copies(found, v, w)
        told.add(bad)
        good = v if bad == w else w
        out.append(SessionProblem("duplicate_scan", (names[v], names[w]), _COPY.format(names[good])))
    misplaced = [m for m in found.misplaced if m.view not in told]
    rows = find_fitting_rows(capture, found, misplaced)
    cycles = exchange_cycles(rows)
    for cycle in cycles:
        told |= set(cycle)
        out.append(
            SessionProblem("exchanged", tuple(names_of_views(cycle, names)), _exchange_problem(cycle, rows, names))
        )
    left = {v: row for v, row in rows.items() if v not in told}
    for v, row in exchanged_pairs(left, [m for m in misplaced if m.view not in told]):
        told |= {v, row}
        out.append(
            SessionProblem(
                "exchanged", tuple(names_of_views(sorted((v, row)), names)), _EXCHANGED.format(names[v], names[row])
            )
        )
    step = (
        find_common_displacement(capture, poses, [m for m in misplaced if m.view not in told])
        if not found.steps
        else None
    )
    if step is not None:
        told |= set(step[0])
        out.append(_reclamped_problem(step[0], step[1], names))
    same = find_same_poses(capture)
    for m in misplaced:
        if m.view not in told:
            out.append(_single_view_problem(session, capture, T_mount, found, m, same))
    for s in found.steps:
        side = range(s.start) if s.start <= found.largest_segment.start else range(s.start, len(names))
        out.append(_reclamped_problem(side, s.moved if s.distinguishable else "either", names))
    if len(found.disconnected) > 1:
        shown = " | ".join(list_views(names_of_views(group, names), names) for group in found.disconnected)
        views = tuple(n for group in found.disconnected[1:] for n in names_of_views(group, names))
        out.append(SessionProblem("disconnected", views, f"no surface links {shown}: add views between them"))
    return out


def _worse_of_copies(found: Snooping, v: int, w: int) -> int:
    """Of two views with the same scan, the one that does not belong."""
    return v if v in found.left_out and w not in found.left_out else w


def _exchange_problem(cycle: Sequence[int], rows: dict[int, int | None], names: Sequence[str]) -> str:
    if len(cycle) == 2:
        return f"exchange the clouds of {names[cycle[0]]} and {names[cycle[1]]} in views.csv"
    moves = ", ".join(f"the cloud of {names[v]} to row {names[int(rows[v] or 0)]}" for v in cycle)
    return f"the clouds of {len(cycle)} rows are mixed up: move {moves}"


def _single_view_problem(
    session: Session,
    capture: Capture,
    T_mount: Array,
    found: Snooping,
    m: MisplacedView,
    same: Sequence[tuple[int, int]],
) -> SessionProblem:
    names = session.names
    own = (names[m.view],)
    fault = _scan_problem(capture, found, m)
    if fault is not None:
        return SessionProblem(fault.kind, own, fault.fix)
    if m.kind == "torn":
        return SessionProblem("displaced", own, _TORN)
    if m.T is None:
        return SessionProblem(
            "foreign", own, "this scan fits nowhere on the part: it shows another part or too little; leave it out"
        )
    amount = displacement_text((m.rotation, m.distance), m.at_least, session.length_unit)
    off = f"off by {amount}" if amount else "off, by how much its surface does not tell"
    partner = next((v if w == m.view else w for v, w in same if m.view in (v, w)), None)
    if partner is not None:
        joint = session.views[m.view].joints is not None and abs(partner - m.view) == 1
        kind = "joint_row" if joint else "duplicate_pose"
        what = "joint angles" if joint else "pose"
        fix = f"{own[0]} has the {what} of {names[partner]}, and is {off}: put in its own"
        return SessionProblem(kind, (*own, names[partner]), fix)
    digit = find_wrong_joint(session, capture, T_mount, m)
    if digit is not None:
        joint_name, stated, fits, neighbour = digit
        kind = "joint_row" if neighbour else "displaced"
        reads = f"{joint_name} of {own[0]} reads {stated:.4f}, {fits:.4f} would fit (it is {off})"
        return SessionProblem(kind, own, f"{reads}: correct it or leave the view out")
    return SessionProblem("displaced", own, f"its pose is {off}: correct the row, scan again or leave the view out")


def _scan_problem(capture: Capture, found: Snooping, m: MisplacedView) -> ScanFault | None:
    """What is wrong with the cloud of a view, rather than with its pose."""
    scan, T_pose = capture.scans[m.view], found.expected[m.view]
    if shows_no_surface(scan):
        return None
    others = [v for v in found.linkage.core if v != m.view]
    surface = surface_of(capture.scans, found.unconstrained.poses, others, found.tolerance)
    look = scan_fault if m.T is None else scale_fault
    return look(scan, T_pose, surface, part_size([capture]), found.needed)


def _reclamped_problem(views: range, moved: str, names: Sequence[str]) -> SessionProblem:
    """Some views at one end of the list that stand off from the rest."""
    start = views.start or views.stop
    what = {"part": "the part was clamped anew", "scanner": "the scanner moved on its mount"}.get(
        moved, "the part or the scanner moved"
    )
    fix = f"{what} between {names[start - 1]} and {names[start]}: make two sessions of it"
    return SessionProblem("reclamped", tuple(names_of_views(views, names)), fix)
