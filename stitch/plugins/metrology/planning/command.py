"""`stitch plan SESSION|RUN`: what planned views would tell, and which further ones to take."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stitch.cli.options import Json, Trust
from stitch.cli.progress import show_activity
from stitch.cli.terminal import emit, say, show_block, show_next, show_table, stdout_for_results
from stitch.errors import InputError

if TYPE_CHECKING:
    from stitch.numerics.frames import Array
    from stitch.plugins.metrology.planning.detection_chances import EffectOutlook, EffectPair, Outlook
    from stitch.plugins.metrology.planning.expected_model import CellModel, ExpectedHandEye, PlannedCell
    from stitch.plugins.metrology.planning.plan import Plan, PlanRequest
    from stitch.session.session import SessionData

# Pairs that are shown, and the share of wrong names from which they are told.
_PAIRS = 3
_MISTAKEN = 0.05

_Folder = Annotated[
    Path, typer.Argument(metavar="SESSION|RUN", help="Session with planned views, or folder that `stitch run` wrote.")
]
_Views = Annotated[int | None, typer.Option("--views", metavar="N", help="Further views at the most.")]
_Split = Annotated[
    tuple[str, str] | None, typer.Option("--split", metavar="EFFECT EFFECT", help="Views that tell these two apart.")
]
_Halve = Annotated[bool, typer.Option("--halve", help="Views that halve the hand-eye's uncertainty.")]
_Feature = Annotated[
    str | None,
    typer.Option(
        "--for",
        metavar="FEATURE",
        help="Views for U of this place: x,y,z in the stitched cloud's frame, or a feature measured in RUN.",
    ),
]
_Part = Annotated[
    Path | None, typer.Option("--part", metavar="MESH", help="The part: a mesh, or a cloud with normals.")
]
_Size = Annotated[
    float | None, typer.Option("--size", metavar="MM", help="Longest side of a part of which nothing else is known.")
]
_Field = Annotated[float | None, typer.Option("--field", metavar="DEG", help="Full angle of the scanner's field.")]
_Start = Annotated[
    str | None,
    typer.Option("--start", metavar="J1,J2,…", help="Joint angles (°) that see the part, where no view is planned."),
]
_Output = Annotated[
    Path | None, typer.Option("-o", "--output", metavar="FOLDER", help="New folder for views.csv and plan.json.")
]


_Drive = Annotated[
    str | None,
    typer.Option("--drive", metavar="COMMAND", help="Takes a view: gets its pose as JSON, writes the scan."),
]
_UntilU = Annotated[
    float | None, typer.Option("--until-U", metavar="LENGTH", help="With --drive: U at the part to reach, length_unit.")
]
_DriveSeconds = Annotated[float, typer.Option("--drive-seconds", help="After which COMMAND is ended.")]


@stdout_for_results
def plan_views(
    folder: _Folder,
    views: _Views = None,
    split: _Split = None,
    halve: _Halve = False,
    feature: _Feature = None,
    part: _Part = None,
    size: _Size = None,
    field: _Field = None,
    start: _Start = None,
    output: _Output = None,
    drive: _Drive = None,
    until_U: _UntilU = None,
    drive_seconds: _DriveSeconds = 120.0,
    trust: Trust = False,
    as_json: Json = False,
) -> None:
    """Say before measuring what views would tell, and which further ones bring most.

    \b
    Examples:
      stitch plan blade-18 --size 300
      stitch plan blade-18 --part blade.stl --split joint_compliance gear_eccentricity -o more
      stitch plan runs/blade-17 --halve
      stitch plan blade-18 --size 300 --start 0,-90,90,0,45,0 --drive ./cell.sh --until-U .05
    """
    from stitch.output.json_file import to_json
    from stitch.output.session_files import whole_folder, write_table
    from stitch.plugins.metrology.planning.plan import plan_further_views
    from stitch.plugins.metrology.planning.verb import plan_document, view_columns

    _require_plan_options(views, size, field, output)
    if drive is not None or until_U is not None:
        odd = [name for name, value in {"--split": split, "--for": feature, "-o": output}.items() if value]
        _drive_cell(folder, drive, until_U, drive_seconds, views, odd, (part, size, field, start), as_json)
        return
    wanted = _plan_request(views, split, halve, place_of(folder, feature))
    wanted = replace(wanted, poses=_deciding_poses(folder, split))
    stated = {"part": part, "size": size, "field": field, "start": start}
    with show_activity("planning: reading the cell"):
        session, planned = (
            _cell_of_run(folder, stated, trust)
            if (folder / "result.json").is_file()
            else _cell_of_session(folder, part, size, field, start)
        )
    with show_activity("planning: what views would tell, pose by pose"):
        plan = plan_further_views(session, planned, wanted)
    document = plan_document(plan, planned.cell.model.T_mount)
    if output is not None:
        with whole_folder(output) as scratch:
            (scratch / "plan.json").write_text(to_json(document) + "\n", encoding="utf-8")
            if plan.proposed:
                write_table(scratch / "views.csv", view_columns(plan))
    if as_json:
        emit(to_json(document))
    else:
        _show_plan(plan, planned.cell, output)


def _drive_cell(
    folder: Path,
    command: str | None,
    until_U: float | None,
    seconds: float,
    most: int | None,
    odd: list[str],
    stated: tuple[Path | None, float | None, float | None, str | None],
    as_json: bool,
) -> None:
    """Take views by a command until U is reached; print each, and what to do next."""
    import shlex

    from stitch.numerics.units import length_text
    from stitch.output.json_file import to_json
    from stitch.plugins.metrology.planning.drive import DrivenCell, drive
    from stitch.session.reading.session_folder import load_session

    if command is None or until_U is None or not until_U > 0 or not seconds > 0:
        raise InputError("--drive COMMAND and --until-U LENGTH go together, above zero; to fix: give both")
    if odd or not (folder / "session.toml").is_file():
        raise InputError(
            f"--drive: {odd[0] if odd else folder} is not for it; to fix: a session's folder, without {odd}"
        )
    part, size, field, start = stated
    joints = _start_joints(folder, start)
    unit = load_session(folder, scans=False, start=joints).length_unit
    taken: list[tuple[int, float | None]] = []

    def tell(views: int, U: float | None, without_view: str) -> None:
        taken.append((views, U))
        known = "not known yet" if U is None else length_text(U, unit, 2)
        if without_view or not as_json:
            say(without_view or f"{views} views: U at the part {known}", stream=sys.stderr if as_json else None)

    try:
        drive(DrivenCell(folder, part, size, field, joints, most or 40), until_U, command, seconds, tell)
    except (KeyboardInterrupt, Exception):
        say(f"{folder} holds what was scanned; the same call goes on from there", stream=sys.stderr)
        raise
    views, U = taken[-1] if taken else (0, None)
    reached = U is not None and until_U >= U
    if as_json:
        emit(to_json({"views": views, "U_at_part": U, "reached": reached, "steps": taken}))
        return
    say("U is reached." if reached else "No further view within reach brings more.", bold=True)
    show_next(f"Next: stitch run {shlex.quote(str(folder))}")


def _deciding_poses(folder: Path, split: tuple[str, str] | None) -> Array | None:
    """Return (K, n) rad of the views by which a run's own diagnosis decides between two effects; None without any."""
    import numpy as np

    from stitch.session.reading.text_files import read_json_object

    if split is None or not (folder / "diagnosis.json").is_file():
        return None
    proposed = read_json_object(folder / "diagnosis.json").get("next", [])
    own = [row["joints_deg"] for row in proposed if row.get("joints_deg") and set(row["separates"]) == set(split)]
    return np.radians(own) if own else None


def _require_plan_options(views: int | None, size: float | None, field: float | None, output: Path | None) -> None:
    if views is not None and not 0 < views <= 40:
        raise InputError(f"--views {views}: to fix: give a number from 1 to 40")
    if size is not None and not 0 < size < 1e6:
        raise InputError(f"--size {size:g}: to fix: give the part's longest side in mm, above zero")
    if field is not None and not 0 < field < 150:
        raise InputError(f"--field {field:g}: to fix: give the full angle in degrees, between 0 and 150")
    if output is not None and output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise InputError(f"{output}: exists already; to fix: name another, or move it away")


def place_of(folder: Path, feature: str | None) -> str | None:
    """Return the place of a feature that `stitch measure` found in a run, as x,y,z, with the normal along which its
    first number counts if it has one; numbers as they are."""
    from stitch.session.reading.text_files import read_json_object

    numbers = read_json_object(folder / "features.json").get("numbers", [])
    places = {n["feature"]: [*n["at"], *(n.get("normal") or [])] for n in numbers if n.get("at")}
    return feature if feature not in places else ",".join(map(str, places[feature]))


def _plan_request(views: int | None, split: tuple[str, str] | None, halve: bool, feature: str | None) -> PlanRequest:
    from stitch.plugins.metrology.planning.plan import plan_request

    if split is not None and split[0] == split[1]:
        raise InputError(f"--split {split[0]} {split[1]}: to fix: name two effects")
    at = None if feature is None else _option_numbers("--for", feature, "a place as x,y,z, as 0,20,150", (3, 6))
    if at is not None and not any(at[3:]) and len(at) > 3:
        raise InputError(f"--for {feature!r}: the normal has no direction; to fix: give x,y,z,nx,ny,nz, or x,y,z alone")
    return plan_request(views, split, halve, at)


def _cell_of_run(folder: Path, stated: Mapping[str, object], trust: bool) -> tuple[SessionData, PlannedCell]:
    """Return the cell of a finished run, which says all of it."""
    from stitch.output.stored_run import load_run
    from stitch.plugins.metrology.planning.expected_model import cell_of_run

    odd = next((f"--{name}" for name, value in stated.items() if value is not None), None)
    if odd is not None:
        raise InputError(f"{odd}: {folder} is a run, which knows that; to fix: leave {odd} out")
    state = load_run(folder, trust=trust)
    return state.session, cell_of_run(state, folder)


def _cell_of_session(
    folder: Path, part: Path | None, size: float | None, field: float | None, start: str | None
) -> tuple[SessionData, PlannedCell]:
    """Return the cell of a session, of which options may say what the session does not."""
    from stitch.plugins.metrology.planning.expected_model import cell_of_session
    from stitch.session.axis_poses import require_placed
    from stitch.session.reading.session_folder import load_session

    session = load_session(folder, scans=False, start=_start_joints(folder, start))
    require_placed(session)
    return session, cell_of_session(session, part, size, field)


def _start_joints(folder: Path, start: str | None) -> Array | None:
    """Return the joint angles (n,) that --start states, rad; None where views are planned already.

    Raises:
        InputError: no numbers, or a session without either.
    """
    import numpy as np

    if start is not None:
        return np.radians(_option_numbers("--start", start, "joint angles (°), as 0,-90,90,0,45,0"))
    if (folder / "session.toml").is_file() and not (folder / "views.csv").exists():
        raise InputError(
            f"{folder}: no views.csv; to fix: write planned joints or poses there, or give --start J1,J2,… in degrees, "
            "where the scanner sees the part"
        )
    return None


def _option_numbers(option: str, text: str, what: str, counts: tuple[int, ...] = ()) -> Array:
    import numpy as np

    try:
        numbers = np.array([float(word) for word in text.split(",")])
    except ValueError:
        numbers = np.array([np.nan])
    if not np.isfinite(numbers).all() or (counts and len(numbers) not in counts):
        raise InputError(f"{option} {text!r}: to fix: give {what}")
    return numbers


def _show_plan(plan: Plan, cell: CellModel, output: Path | None) -> None:
    if plan.assumed:
        say(f"Nobody stated, so assumed: {'; '.join(plan.assumed)}.")
    if plan.now is None:
        say(f"Fewer than three views give no hand-eye{'; views are proposed' * bool(plan.proposed)}.", bold=True)
    else:
        _show_outlook(plan, plan.now, cell)
    _show_proposed(plan)
    if plan.after is not None:
        if plan.now is None:
            _show_outlook(plan, plan.after, cell)
        else:
            _show_after(plan, plan.now, plan.after)
    if output is not None:
        say(f"  {output / 'views.csv' if plan.proposed else output / 'plan.json'}")


def _show_outlook(plan: Plan, o: Outlook, cell: CellModel) -> None:
    """Print U of the hand-eye, chances of every effect, and pairs that stay alike."""
    import numpy as np

    from stitch.model.model import expanded_uncertainty
    from stitch.numerics.units import METRES, length_text, uncertainty_text

    unit, frame = plan.session.length_unit, "base" if plan.session.mount == "eye_to_hand" else "flange"
    U = expanded_uncertainty(cell.model.T_mount, o.hand_eye.covariance) * np.repeat([1e3, METRES[unit] * 1e3], 3)
    position, turn = (
        ", ".join(f"{axis} {uncertainty_text(size)}" for axis, size in zip("xyz", sizes, strict=True))
        for sizes in (U[3:], U[:3])
    )
    say(f"What {o.views} views would tell: U (k = 2) of T_{frame}_scanner, in the frame of the {frame}", bold=True)
    show_block(
        [
            ("position", f"{position} mm"),
            ("rotation vector", f"{turn} mrad"),
            ("at the part", f"{length_text(o.hand_eye.U, unit, 2)}, mostly {_source_shares(o.hand_eye)}"),
            ("", f"{length_text(o.ordinary.U, unit, 2)} with an arm that is a little wrong in every joint and link"),
        ]
    )
    chances = [(e, e.chance) for e in o.effects if e.chance is not None]
    show_table(
        "Of an effect of usual size",
        ("effect", "detected from", "detected", "named", "misnamed"),
        [(e.name, _detectable_text(e), f"{c.detected:.0%}", f"{c.named:.0%}", f"{c.misnamed:.0%}") for e, c in chances],
    )
    for _, c in chances:
        if c.misnamed >= _MISTAKEN:
            say(f"{c.effect} would be taken for {c.taken_for} most often.")
    if unseen := [e.name for e in o.effects if not e.observable]:
        say(f"These views cannot show: {', '.join(unseen)}.")
    needs = sorted({need for lacking in o.untestable.values() for need in lacking})
    without = [
        f"{', '.join(name for name, lacking in o.untestable.items() if need in lacking)} ({need})" for need in needs
    ]
    if without:
        say(f"Not asked, with what that would need: {'; '.join(without)}.")
    # Pairs that are not told apart at usual size, or the hardest one.
    for pair in [pair for pair in o.pairs if pair.size > 1][:_PAIRS] or list(o.pairs[:1]):
        effect, rival = (pair.a, pair.b) if pair.size_a > pair.size_b else (pair.b, pair.a)
        say(f"{effect} is told from {rival} {_multiple_text(pair.size)}.")


def _source_shares(hand_eye: ExpectedHandEye) -> str:
    shares = sorted(hand_eye.shares.items(), key=lambda item: -item[1])[:2]
    return " and ".join(f"{name} ({share:.0%})" for name, share in shares)


def _detectable_text(e: EffectOutlook) -> str:
    """Return the parameter that shows best, at its smallest detectable size."""
    from stitch.numerics.units import format_amount

    if not e.detectable:
        return "–"
    name = min(e.detectable, key=lambda name: e.detectable[name] / e.usual[name])
    amount = format_amount(e.detectable[name], e.detectable[name] / 10, e.units[name])
    return f"{name} {amount._replace(sigma='–')}"


def _show_proposed(plan: Plan) -> None:
    import numpy as np

    from stitch.numerics.units import length_text

    if not plan.proposed:
        say(f"Nothing is proposed: {_no_views_reason(plan)}.")
        return
    show_table(
        "Further views" + ("" if plan.split is None else f" (to tell {' from '.join(plan.split)})"),
        ("view", "joints °", "travel °", "U at the part" if plan.place_now is None else "U of the place", "told apart"),
        [
            (
                view.name,
                " ".join(f"{x:.0f}" for x in np.degrees(view.joints)),
                f"{np.degrees(view.travel):.0f}",
                length_text(view.U, plan.session.length_unit, 2, zeros=True),
                f"{view.separated_share:.0%}" if np.isfinite(view.separated_share) else "–",
            )
            for view in plan.proposed
        ],
    )


def _no_views_reason(plan: Plan) -> str:
    if plan.session.robot is None or plan.session.joints is None:
        return "that needs [robot] in session.toml, and joint angles of all views"
    pair = None if plan.split is None or plan.now is None else _find_pair(plan.now, plan.split)
    if pair is not None and pair.size <= 1:
        return f"at usual size these views tell {pair.a} from {pair.b} as they are"
    return "no pose within reach brings more"


def _show_after(plan: Plan, now: Outlook, after: Outlook) -> None:
    from stitch.numerics.units import length_text

    before, then = (length_text(o.hand_eye.U, plan.session.length_unit, 2) for o in (now, after))
    say(
        f"With them U of the hand-eye at the part goes from {before} to {then}; what is left is mostly "
        f"{_source_shares(after.hand_eye)}."
    )
    if plan.place_now is not None:
        before, then = (length_text(U, plan.session.length_unit, 2) for U in (plan.place_now, plan.proposed[-1].U))
        say(f"U of the place of the feature goes from {before} to {then}.")
    if plan.split is not None:
        pairs = [_find_pair(o, plan.split) for o in (now, after)]
        if pairs[0] is not None and pairs[1] is not None:
            names = " and ".join(plan.split)
            say(f"{names} are told apart {_multiple_text(pairs[1].size)}; now {_multiple_text(pairs[0].size)}.")


def _multiple_text(size: float) -> str:
    import numpy as np

    return f"from {size:.2g} times its usual size" if np.isfinite(size) else "at no size"


def _find_pair(o: Outlook, names: tuple[str, str]) -> EffectPair | None:
    return next((p for p in o.pairs if {p.a, p.b} == set(names)), None)
