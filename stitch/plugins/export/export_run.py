"""`stitch export RUN`: what a run found in the words of other programs."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stitch.cli.options import EffectsFile, Json, RunFolder, Trust, completes, require_new
from stitch.cli.progress import show_activity
from stitch.cli.terminal import emit, results_stream, say, show_table, stdout_for_results
from stitch.errors import InputError, did_you_mean
from stitch.plugins.export.formats import ARM, CLOUD, HAND_EYE, LIMIT_MM

if TYPE_CHECKING:
    from collections.abc import Sequence

    from stitch.numerics.frames import Array
    from stitch.plugins.intake.controllers.program import Program
    from stitch.plugins.metrology.calibrate.arm_model import ArmModel

_J3_CONVENTIONS = ("own", "j2+j3")
_LISTED_TARGETS = 40
# Below this (mm) nothing remains: no arm knows a nanometre.
_NEGLIGIBLE_MOVE = 1e-6

_KINDS = f"hand-eye: {', '.join(HAND_EYE)}; arm: {', '.join(ARM)}; cloud: {', '.join(CLOUD)}"
_FORMATS = (*HAND_EYE, *ARM, *CLOUD)
_To = Annotated[
    str | None,
    typer.Option("--to", metavar="FORMAT", help=f"{_KINDS}.", autocompletion=completes(*_FORMATS)),
]
_Program = Annotated[
    Path | None, typer.Option("--program", metavar="FILE", help="Move the targets of a KUKA, FANUC, ABB or UR program.")
]
_Output = Annotated[
    Path | None, typer.Option("-o", "--output", metavar="FILE", help="File to write; texts: standard output.")
]
_Parent = Annotated[
    str | None, typer.Option("--parent", help="Name of the frame that carries the scanner: flange, base_link …")
]
_Child = Annotated[str | None, typer.Option("--child", help="Name of the scanner's frame; default scanner.")]
_Scanner = Annotated[str | None, typer.Option("--scanner", metavar="NAME", help="Of several scanners: whose hand-eye.")]
_WithEffects = Annotated[
    bool, typer.Option("--with-effects", help="The hand-eye for a program that corrects the model's effects itself.")
]
_Frame = Annotated[
    str | None, typer.Option("--frame", help="Of a program's poses in the base, numbers as the controller shows.")
]
_Tool = Annotated[
    str | None, typer.Option("--tool", help="Of a program's poses in the flange, numbers as the controller shows.")
]
_Limit = Annotated[float, typer.Option("--limit", metavar="MM", help="Largest move of a target that is believed.")]
_Near = Annotated[str | None, typer.Option("--near", help="Joint angles in degrees about which the program works.")]
_J3 = Annotated[
    str | None, typer.Option("--j3", help="Of a FANUC program: own, or j2+j3 where the session's joint 3 is that.")
]

_On = Annotated[
    list[Path] | None,
    typer.Option("--on", metavar="SESSION", help="Of an arm: another session of it, which it must not make worse."),
]
_Datum = Annotated[
    bool, typer.Option("--datum", help="A cloud in the frame of the datum that stitch measure counted from.")
]
_Part = Annotated[int, typer.Option("--part", metavar="N", help="Of a fit with several parts: the one to follow.")]


@stdout_for_results
def export_run(
    run: RunFolder,
    to: _To = None,
    program: _Program = None,
    output: _Output = None,
    parent: _Parent = None,
    child: _Child = None,
    scanner: _Scanner = None,
    with_effects: _WithEffects = False,
    frame: _Frame = None,
    tool: _Tool = None,
    limit: _Limit = LIMIT_MM,
    near: _Near = None,
    j3: _J3 = None,
    part: _Part = 1,
    on: _On = None,
    datum: _Datum = False,
    effects_file: EffectsFile = None,
    trust: Trust = False,
    as_json: Json = False,
) -> None:
    """Write what a run found for other programs, or a compensated copy of a robot program.

    RUN may be what `stitch fit -o` wrote: then a program follows the part to where it was found.

    \b
    Examples:
      stitch export runs/blade-17 --to ros
      stitch export runs/blade-17 --to kuka -o scanner.txt
      stitch export runs/blade-17 --to glb -o blade.glb
      stitch export runs/blade-17 --program scan.src -o compensated.src --frame 0,0,0,0,0,0 --tool 0,0,150,0,0,0
      stitch export found-body --program place.src -o corrected.src --frame 0,0,0,0,0,0
    """
    from stitch.plugins.export.hand_eye_formats import HAND_EYE_FORMATS, hand_eye_of_run, ros_launch
    from stitch.plugins.metrology.calibrate.arm_model import ARM_FORMATS, arm_of_run

    _require_export_options(to, program, output, datum)
    if program is not None and (run / "fit.json").is_file():
        _export_moved_program(program, run / "fit.json", output, frame, part=part, as_json=as_json)
    elif program is not None:
        with show_activity("export: reading the run"):
            arm = arm_of_run(run, effects_file, trust)
        _prove(run, on, effects_file, trust)
        _export_program(program, arm, output, frame, tool, limit=limit, near=near, j3=j3, as_json=as_json)
    elif to in ARM_FORMATS:
        text = ARM_FORMATS[to](arm_of_run(run, effects_file, trust))
        _prove(run, on, effects_file, trust)
        _export_text(text, to, output, as_json)
    elif to in HAND_EYE_FORMATS:
        with show_activity("export: reading the run"):
            eye = hand_eye_of_run(run, parent, child, with_effects, scanner)
        # ROS 1 knows launch files in XML only.
        old = to == "ros" and output is not None and output.suffix in (".launch", ".xml")
        _export_text(ros_launch(eye) if old else HAND_EYE_FORMATS[to](eye), to, output, as_json)
        if eye.of_effects:
            say(eye.of_effects, stream=sys.stderr)
    else:
        _export_cloud(run, str(to), output, datum)
        if as_json:
            _emit_files(str(to), output)


def _require_export_options(to: str | None, program: Path | None, output: Path | None, datum: bool) -> None:
    if (to is None) == (program is None):
        raise InputError("export what? to fix: name one of --to FORMAT and --program FILE")
    require_new(output)
    if program is None and to not in _FORMATS:
        raise InputError(f"--to {to}: no such format{did_you_mean(str(to), _FORMATS)}; to fix: one of {_KINDS}")
    if datum and to not in CLOUD:
        raise InputError(f"--datum: is of a cloud; to fix: name one of --to {', '.join(CLOUD)}")


def _prove(run: Path, on: list[Path] | None, effects_file: Path | None, trust: bool) -> None:
    """Say what the arm of a run leaves on other sessions.

    Raises:
        InputError: more than the nominal arm, on one of them.
    """
    from stitch.model.model_toml import arm_model
    from stitch.output.stored_run import trusted_model
    from stitch.plugins.metrology.calibrate.other_sessions import UNASKED, require_held
    from stitch.session.reading.session_folder import load_session

    arm = arm_model(trusted_model(run, effects_file, trust)[0])
    if arm is None:
        return
    if not on:
        say(UNASKED, stream=sys.stderr)
        return
    with show_activity("export: running the other sessions"):
        proofs = require_held(arm, [load_session(folder) for folder in on])
    for proof in proofs:
        say(proof.sentence, stream=sys.stderr)


def _export_text(text: str, to: str, output: Path | None, as_json: bool) -> None:
    from stitch.system.files import whole_file

    if output is not None:
        with whole_file(output) as file:
            file.write_text(text, encoding="utf-8")
        say(f"{to} to {output}")
    if as_json:
        _emit_files(to, output, text)
    elif output is None:
        results_stream().write(text)


def _emit_files(to: str, output: Path | None, text: str | None = None) -> None:
    """Print what was written as JSON: the format, the text of a format of text, and the file."""
    from stitch.output.json_file import to_json

    emit(to_json({"to": to, "text": text, "files": [] if output is None else [str(output)]}))


def _export_cloud(run: Path, to: str, output: Path | None, datum: bool) -> None:
    from stitch.numerics.units import MICROMETRES
    from stitch.plugins.export.cloud_formats import CLOUD_FORMATS, coloured_cloud, in_datum, stored_datum
    from stitch.system.files import whole_file

    if output is None or output.suffix.lower() != f".{to}":
        raise InputError(f"--to {to}: no output file; to fix: name the file with -o NAME.{to}")
    write, lost = CLOUD_FORMATS[to]
    with show_activity("export: reading and writing the cloud"), whole_file(output) as file:
        cloud = coloured_cloud(run)
        cloud = in_datum(cloud, stored_datum(run)) if datum else cloud
        write(cloud, file)
    span = cloud.span * MICROMETRES[cloud.length_unit]
    colours = f"coloured by residual, from dark at 0 to yellow at {span:.3g} µm; grey: one view alone"
    say(f"{output}: {colours}{f'; {to} does not hold {lost}' if lost else ''}")


def _export_program(
    file: Path,
    arm: ArmModel,
    output: Path | None,
    frame: str | None,
    tool: str | None,
    *,
    limit: float,
    near: str | None,
    j3: str | None,
    as_json: bool,
) -> None:
    """Write a compensated copy of a robot program, and print the table of its moves."""
    from stitch.numerics.units import length_text
    from stitch.plugins.export.robot_program import compensated_program
    from stitch.plugins.intake.controllers.program import read_program

    if not 0 < limit < float("inf"):
        raise InputError(f"--limit {limit:g}: to fix: give a length above zero, in mm")
    program = read_program(file, frame, tool)
    copy = compensated_program(program, arm, limit, _nearby_joints(near, arm), _is_j3_coupled(program, j3))
    places = _write_program(program, copy.texts, output)
    rows = copy.rows()
    if as_json:
        of_arm = {
            "session": copy.arm.session,
            "effects": [term.name for term in copy.arm.terms],
            "not_compensated": list(copy.beyond),
            "limit_mm": limit,
        }
        _emit_program(program, of_arm, rows, copy.notes, places)
        return
    far = max(rows, key=lambda row: row["moved_mm"])
    left = max(row["left_mm"] for row in rows)
    remains = f"up to {length_text(left, 'mm')} remain" if left > _NEGLIGIBLE_MOVE else "nothing remains"
    say(
        f"{far['target']} moves farthest, by {length_text(far['moved_mm'], 'mm')}, to undo "
        f"{', '.join(term.name for term in copy.arm.terms)}. Under the model {remains}.",
        bold=True,
    )
    _show_moves(program, rows, copy.notes, places)


def _export_moved_program(
    file: Path, fit: Path, output: Path | None, frame: str | None, *, part: int, as_json: bool
) -> None:
    """Write a copy of a program that follows a part to where `stitch fit` found it; print the table of its moves."""
    from stitch.plugins.export.robot_program import moved_program, part_motion, unread_motions
    from stitch.plugins.intake.controllers.program import read_program

    T_base = part_motion(fit, part)
    program = read_program(file, frame, any_tool=True)
    texts, rows = moved_program(program, T_base)
    places = _write_program(program, texts, output)
    notes = unread_motions(program)
    if as_json:
        _emit_program(program, {}, rows, notes, places)
        return
    say(f"Moved with the part to where it was found: {len(rows)} of the program's targets.", bold=True)
    _show_moves(program, rows, notes, places)


def _write_program(program: Program, texts: dict[Path, str], output: Path | None) -> list[Path]:
    """Write a program's texts to where the copy goes, all or none."""
    from stitch.plugins.intake.controllers.taught_points import program_bytes
    from stitch.system.files import whole_file

    if output is None:
        raise InputError(f"{program.file}: no output file; to fix: name the copy with -o FILE")
    # A KUKA's data list goes beside the copy, under the same name.
    if output.suffix.lower() != program.file.suffix.lower():
        raise InputError(f"{output}: to fix: end the copy's name in {program.file.suffix}, as the program's does")
    places = {program.file: output}
    places |= {file: output.with_suffix(file.suffix) for file in program.texts if file != program.file}
    for place in places.values():
        require_new(place)
    with ExitStack() as stack:
        for source, text in texts.items():
            stack.enter_context(whole_file(places[source])).write_bytes(program_bytes(text))
    return list(places.values())


def _nearby_joints(near: str | None, arm: ArmModel) -> Array | None:
    import numpy as np

    from stitch.session.reading.csv_files import is_number

    if near is None:
        return None
    cells = near.split(",")
    angles: Array = np.array([float(cell) if is_number(cell) else np.nan for cell in cells])
    if len(angles) != arm.robot.n_joints or not np.isfinite(angles).all():
        raise InputError(f"--near {near}: to fix: write {arm.robot.n_joints} angles in degrees with commas")
    return np.radians(angles)


def _is_j3_coupled(program: Program, j3: str | None) -> bool:
    """A FANUC counts J3 from the horizontal: whether the session's arm does too, its joint angles cannot tell."""
    if j3 not in (None, *_J3_CONVENTIONS):
        raise InputError(f"--j3 {j3}: to fix: own, or j2+j3")
    has_joints = any(point.joints is not None for point in program.points)
    if program.controller == "fanuc" and has_joints and j3 is None:
        raise InputError(
            f"{program.file}: has joint targets, and a FANUC's J3 turns with J2; to fix: --j3 j2+j3 where the "
            "session's third joint is J2 + J3, --j3 own where its views.csv has J3 as the controller shows it"
        )
    return program.controller == "fanuc" and j3 == "j2+j3"


def _emit_program(
    program: Program, of_arm: dict[str, Any], rows: list[dict[str, Any]], notes: Sequence[str], places: list[Path]
) -> None:
    """Print a copy of a program as JSON."""
    from stitch.output.json_file import to_json

    head = {"format": "stitch-program/1", "program": str(program.file), "controller": program.controller}
    emit(to_json(head | of_arm | {"targets": rows, "notes": list(notes), "files": list(map(str, places))}))


def _show_moves(program: Program, rows: list[dict[str, Any]], notes: Sequence[str], places: list[Path]) -> None:
    """Print the table of the moves of a copy's targets."""
    from stitch.numerics.units import angle_text, length_text

    has_U = "U_mm" in rows[0]
    shown = []
    for row in rows[:_LISTED_TARGETS]:
        U = (length_text(row["U_mm"], "mm", zeros=True),) if has_U else ()
        moved = length_text(row["moved_mm"], "mm", 4, zeros=True)
        shown.append((row["target"], str(row["line"]), moved, *U, angle_text(row["moved_mrad"] / 1e3)))
    headings = ("target", "line", "moved", *("U (k = 2)",) * has_U, "turned")
    show_table(f"{program.file.name}: targets moved", headings, shown)
    if len(rows) > _LISTED_TARGETS:
        say(f"{len(rows) - _LISTED_TARGETS} more; --json has all.")
    for note in notes:
        say(f"{note[0].upper()}{note[1:]}.")
    for place in places:
        say(f"  {place}")
