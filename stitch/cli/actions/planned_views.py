"""What `stitch plan` does: the cell of a session or a run, a plan of its views, as files and for people."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stitch.cli.terminal.plan_summary import show_plan
from stitch.cli.terminal.streams import emit
from stitch.effects.in_session import find_effect
from stitch.errors import InputError
from stitch.frames import Array
from stitch.measurement.session import Session
from stitch.planning.cells import PlannedCell, cell_of_run, cell_of_session
from stitch.planning.plan import PlanRequest, plan_further_views
from stitch.reading.session_folder import load_session
from stitch.stored.load_state import load_state
from stitch.writing.json_file import to_json
from stitch.writing.plan_document import plan_document, view_columns
from stitch.writing.session_files import whole_folder, write_table


@dataclass(frozen=True)
class StatedCell:
    """What options say of a cell that a session does not."""

    part: Path | None
    size: float | None  # mm
    field: float | None  # degrees
    start: str | None


@dataclass(frozen=True)
class PlanOptions:
    """What further views are asked for."""

    views: int | None
    split: tuple[str, str] | None
    halve: bool
    feature: str | None


def run_plan(
    folder: Path, options: PlanOptions, stated: StatedCell, output: Path | None, *, trust: bool, as_json: bool
) -> None:
    """Plan, write the views and show them.

    Raises:
        InputError, NoResultError: as `stitch plan` ends.
    """
    wanted = _plan_request(options)
    session, planned = _planned_cell(folder, stated, trust=trust)
    found = plan_further_views(session, planned, wanted)
    document = plan_document(found, planned.cell.model.T_mount)
    if output is not None:
        with whole_folder(output) as scratch:
            (scratch / "plan.json").write_text(to_json(document) + "\n", encoding="utf-8")
            if found.proposed:
                write_table(scratch / "views.csv", view_columns(found))
    if as_json:
        emit(to_json(document))
    else:
        show_plan(found, planned.cell, output)


def _plan_request(options: PlanOptions) -> PlanRequest:
    split = options.split
    for name in split or ():
        find_effect(name)
    if split is not None and split[0] == split[1]:
        raise InputError(f"--split {split[0]} {split[1]}: to fix: name two effects")
    feature = options.feature
    at = None if feature is None else _option_numbers("--for", feature, "a place as x,y,z, as 0,20,150", 3)
    halve = options.halve or split is None
    return PlanRequest(halve=halve, split=split, split_any=not options.halve, views=options.views, feature=at)


def _planned_cell(folder: Path, stated: StatedCell, *, trust: bool) -> tuple[Session, PlannedCell]:
    """A finished run says all of its cell; of a session the options may say the rest."""
    if (folder / "result.json").is_file():
        odd = next((f"--{name}" for name, value in vars(stated).items() if value is not None), None)
        if odd is not None:
            raise InputError(f"{odd}: {folder} is a run, which knows that; to fix: leave {odd} out")
        state = load_state(folder, trust=trust)
        return state.session, cell_of_run(state, folder)
    start = None
    if stated.start is not None:
        start = np.radians(_option_numbers("--start", stated.start, "joint angles (°), as 0,-90,90,0,45,0"))
    elif (folder / "session.toml").is_file() and not (folder / "views.csv").exists():
        raise InputError(
            f"{folder}: no views.csv; to fix: write planned joints or poses there, or give --start J1,J2,… in degrees, "
            "where the scanner sees the part"
        )
    session = load_session(folder, scans=False, start=start)
    return session, cell_of_session(session, stated.part, stated.size, stated.field)


def _option_numbers(option: str, text: str, what: str, count: int | None = None) -> Array:
    try:
        found = np.array([float(word) for word in text.split(",")])
    except ValueError:
        found = np.array([np.nan])
    if not np.isfinite(found).all() or count not in (None, len(found)):
        raise InputError(f"{option} {text!r}: to fix: give {what}")
    return found
