"""What `stitch add` and `stitch drop` do: another model for a run, everything fitted anew, the ledger for people."""

import shlex
from dataclasses import replace
from pathlib import Path

from stitch.cli.actions.diagnosed_run import write_diagnosis
from stitch.cli.terminal.ledger_summary import show_ledger
from stitch.cli.terminal.live_line import show_activity
from stitch.cli.terminal.recorders import recorder_for
from stitch.cli.terminal.streams import emit
from stitch.diagnosis.diagnosis import Diagnosis
from stitch.effects.in_session import find_effect, require_available
from stitch.errors import InputError
from stitch.revision import change
from stitch.runs.run import Run
from stitch.runs.state import RunState, state_of
from stitch.stepwise import suggest, suggest_group
from stitch.stored.load_state import load_state
from stitch.system.console import console
from stitch.writing import run_folder
from stitch.writing.json_file import to_json
from stitch.writing.plain_finding import suggested_command
from stitch.writing.result_document import result_document
from stitch.writing.run_contents import others_of_rig


def add_effects(
    run: Path, effects: list[str], effects_file: Path | None, *, trust: bool, recording: bool, as_json: bool
) -> None:
    """Add effects by their names.

    Raises:
        InputError, NoResultError: as `stitch add` ends.
    """
    with run_folder.lock_run_folder(run):
        state = load_state(run, effects_file, trust=trust)
        used = state.model.effects
        for name in effects:
            require_available(state.measurement, find_effect(name))
            if name in used:
                raise InputError(f"{name} is in the model of {run} already; to fix: leave it out")
        _refit_run(run, state, [*used, *effects], recording, as_json)


def add_diagnosed(
    run: Path,
    at_most: int | None,
    effects_file: Path | None = None,
    *,
    trust: bool = False,
    recording: bool = True,
    as_json: bool = False,
    says_next: bool = True,
) -> None:
    """Add what a diagnosis chooses: at most so many effects one by one, or None: the group that it cannot tell apart.

    Raises:
        InputError, NoResultError: as `stitch add` ends.
    """
    with run_folder.lock_run_folder(run):
        with show_activity("diagnosing"):
            state = load_state(run, effects_file, trust=trust)
            run_folder.preload_entry_points("stitch.reports")
            chosen = suggest_group(state) if at_most is None else suggest(state, at_most)
        found = _keep_diagnosed(run, state, chosen, recording, as_json)
    if says_next and not as_json:
        console().print(suggested_command(found, shlex.quote(str(run))), soft_wrap=True)


def _keep_diagnosed(
    run: Path, state: RunState, chosen: tuple[Run | None, list[str], Diagnosis], recording: bool, as_json: bool
) -> Diagnosis:
    """Write and show what a diagnosis chose; what was tried on the way leaves no recording, the end does."""
    result, lines, found = chosen
    for line in lines:
        console().print(line, soft_wrap=True)
    if result is not None:
        with show_activity("writing cloud and page"), run_folder.replace_run_files(run) as scratch:
            if recording:
                # The same fit once more from where it ended, for the recording; it takes the last step's place.
                before = replace(state_of(result), ledger=result.ledger[:-1])
                again = change(before, result.effects, recorder_for(scratch, recording))
                result = replace(again, notes=result.notes)
            run_folder.write_with_page(result, scratch)
        _show_changed(result, run, as_json)
    elif as_json:
        emit((run / "result.json").read_text(encoding="utf-8").rstrip())
    else:
        console().print("Nothing was added: the model is as it was.", soft_wrap=True)
    write_diagnosis(found, state if result is None else state_of(result), run)
    return found


def drop_effects(
    run: Path, effects: list[str], effects_file: Path | None, *, trust: bool, recording: bool, as_json: bool
) -> None:
    """Take effects out by their names.

    Raises:
        InputError, NoResultError: as `stitch drop` ends.
    """
    with run_folder.lock_run_folder(run):
        state = load_state(run, effects_file, trust=trust)
        used = state.model.effects
        for name in effects:
            if name not in used:
                raise InputError(f"{name} is not in the model of {run}; in it are {', '.join(used) or 'none'}")
        kept = [name for name in used if name not in effects]
        _refit_run(run, state, kept, recording, as_json)


def _refit_run(run: Path, state: RunState, effects: list[str], recording: bool, as_json: bool) -> None:
    """Give the run folder the model with these effects, and show it."""
    run_folder.preload_entry_points("stitch.reports")
    with show_activity("reading the run"), run_folder.replace_run_files(run) as scratch:
        result = change(state, effects, recorder_for(scratch, recording))
        run_folder.write_with_page(result, scratch)
    _show_changed(result, run, as_json)
    if not as_json:
        console().print(f"Next: stitch diagnose {shlex.quote(str(run))}", soft_wrap=True)


def _show_changed(result: Run, run: Path, as_json: bool) -> None:
    if as_json:
        emit(to_json(result_document(result)))
        return
    show_ledger(result)
    if others := others_of_rig(run):
        folder = shlex.quote(str(run.resolve().parent))
        effects = f" --effects {','.join(result.effects)}" if result.effects else ""
        console().print(
            f"Of its rig this run alone has changed: {', '.join(others)} and their common model.toml are as they were. "
            f"For one model of all: stitch run, with all sessions{effects} and -o {folder}",
            soft_wrap=True,
        )
