"""What `stitch export --program` does: a compensated copy of a robot program, and the table of its moves."""

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from stitch.cli.options import require_new
from stitch.cli.terminal.streams import emit
from stitch.controllers.program import Program, read_program
from stitch.controllers.taught import program_bytes
from stitch.errors import InputError
from stitch.export.arm_model import ArmModel
from stitch.export.compensated_program import CompensatedProgram, compensated_program
from stitch.frames import Array
from stitch.reading.csv_number import is_number
from stitch.system.console import console
from stitch.system.whole_file import whole_file
from stitch.units import angle_text, length_text
from stitch.writing.json_file import to_json

_J3_CONVENTIONS = ("own", "j2+j3")
_LISTED_TARGETS = 40
# Below this (mm) nothing remains: no arm knows a nanometre.
_NEGLIGIBLE_MOVE = 1e-6


def export_program(
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
    """Write the copy and show its moves.

    Raises:
        InputError: no place for it, a limit or joint angles that are none, and what `compensated_program` refuses.
    """
    if output is None:
        raise InputError(f"{file}: where to? to fix: name the copy with -o FILE")
    if not 0 < limit < float("inf"):
        raise InputError(f"--limit {limit:g}: to fix: give a length above zero, in mm")
    program = read_program(file, frame, tool)
    copy = compensated_program(program, arm, limit, _nearby_joints(near, arm), _is_j3_coupled(program, j3))
    places = _output_files(program, output)
    _write_program(copy, places)
    if as_json:
        emit(to_json(_program_document(copy, list(places.values()), limit)))
    else:
        _show_moves(copy, list(places.values()))


def _nearby_joints(near: str | None, arm: ArmModel) -> Array | None:
    if near is None:
        return None
    cells = near.split(",")
    told: Array = np.array([float(cell) if is_number(cell) else np.nan for cell in cells])
    if len(told) != arm.robot.n_joints or not np.isfinite(told).all():
        raise InputError(f"--near {near}: to fix: write {arm.robot.n_joints} angles in degrees with commas")
    return np.asarray(np.radians(told))


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


def _output_files(program: Program, output: Path) -> dict[Path, Path]:
    """Where each file of the program goes: a KUKA's data list beside the copy, under the same name."""
    if output.suffix.lower() != program.file.suffix.lower():
        raise InputError(f"{output}: to fix: end the copy's name in {program.file.suffix}, as the program's does")
    places = {program.file: output}
    places |= {file: output.with_suffix(file.suffix) for file in program.texts if file != program.file}
    for place in places.values():
        require_new(place)
    return places


def _write_program(copy: CompensatedProgram, places: dict[Path, Path]) -> None:
    with ExitStack() as stack:
        for file, text in copy.texts.items():
            stack.enter_context(whole_file(places[file])).write_bytes(program_bytes(text))


def _program_document(copy: CompensatedProgram, places: list[Path], limit: float) -> dict[str, Any]:
    return {
        "format": "stitch-program/1",
        "program": str(copy.program.file),
        "controller": copy.program.controller,
        "session": copy.arm.session,
        "effects": [term.name for term in copy.arm.terms],
        "not_compensated": list(copy.beyond),
        "limit_mm": limit,
        "targets": copy.rows(),
        "notes": list(copy.notes),
        "files": [str(place) for place in places],
    }


def _show_moves(copy: CompensatedProgram, places: list[Path]) -> None:
    terminal, rows = console(), copy.rows()
    table = Table(title=f"{copy.program.file.name}: targets moved", title_justify="left")
    for heading in ("target", "line", "moved", "U (k = 2)", "turned"):
        table.add_column(heading, justify="left" if heading == "target" else "right")
    for row in rows[:_LISTED_TARGETS]:
        moved, U = length_text(row["moved_mm"], "mm", 4, zeros=True), length_text(row["U_mm"], "mm", zeros=True)
        table.add_row(row["target"], str(row["line"]), moved, U, angle_text(row["moved_mrad"] / 1e3))
    terminal.print(table)
    if len(rows) > _LISTED_TARGETS:
        terminal.print(f"{len(rows) - _LISTED_TARGETS} more; --json has all.", soft_wrap=True)
    far, left = max(rows, key=lambda row: row["moved_mm"]), max(row["left_mm"] for row in rows)
    effects, unit = ", ".join(term.name for term in copy.arm.terms), "mm"
    terminal.print(
        f"Undone: {effects}. {far['target']} moves farthest, by {length_text(far['moved_mm'], unit)}; under the "
        f"model {f'up to {length_text(left, unit)} remain' if left > _NEGLIGIBLE_MOVE else 'nothing remains'}.",
        soft_wrap=True,
    )
    for note in copy.notes:
        terminal.print(f"{note[0].upper()}{note[1:]}.", soft_wrap=True)
    for place in places:
        terminal.print(f"  {place}", soft_wrap=True)
