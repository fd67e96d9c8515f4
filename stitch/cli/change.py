"""`stitch add RUN EFFECT…`, `stitch drop RUN EFFECT…`: change the model, refit, show what it brought."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from shutil import copyfile
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stitch.cli.options import EffectsFile, Json, Trust, complete_effect
from stitch.cli.progress import Progress, opened_run, show_activity
from stitch.cli.terminal import emit, in_full, say, show_next
from stitch.errors import InputError
from stitch.system.process import end_at_once

if TYPE_CHECKING:
    from stitch.recorder import RunMemory
    from stitch.run_data import RunData

_AT_MOST = 5  # effects that --suggested adds one by one
_RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="Run folder; changed in place.")]
_Recording = Annotated[bool, typer.Option("--recording/--no-recording", help="Write recording.rrd anew.")]


def add(
    run: _RunFolder,
    effects: Annotated[
        list[str] | None, typer.Argument(metavar="EFFECT...", help="Effects to add.", autocompletion=complete_effect)
    ] = None,
    suggested: Annotated[bool, typer.Option("--suggested", help="Diagnose and add until nothing is left.")] = False,
    group: Annotated[bool, typer.Option("--group", help="Diagnose; add effects that it cannot tell apart.")] = False,
    at_most: Annotated[int, typer.Option("--at-most", help="Limit for --suggested.")] = _AT_MOST,
    effects_file: EffectsFile = None,
    trust: Trust = False,
    recording: _Recording = True,
    as_json: Json = False,
) -> None:
    """Add effects to the model of a run, fit hand-eye and all effects anew, and show what it brought.

    \b
    Examples:
      stitch add runs/blade-17 backlash
      stitch add runs/blade-17 --suggested
      stitch add runs/blade-17 --group
    """
    if bool(effects) + suggested + group != 1:
        raise InputError("add what? to fix: name the effects, or let --suggested or --group choose; one of the three")
    if effects:
        from stitch.api.stepwise import effects_with

        with opened_run(run, effects_file, trust, "reading the run") as state:
            _refit_run(run, state, effects_with(state, effects, run), recording, as_json)
    else:
        limit = at_most if suggested else None
        _add_diagnosed(run, limit, effects_file, trust=trust, recording=recording, as_json=as_json)
    end_at_once()


def drop(
    run: _RunFolder,
    effects: Annotated[
        list[str], typer.Argument(metavar="EFFECT...", help="Effects to take out.", autocompletion=complete_effect)
    ],
    effects_file: EffectsFile = None,
    trust: Trust = False,
    recording: _Recording = True,
    as_json: Json = False,
) -> None:
    """Take effects out of the model of a run and fit the rest anew.

    \b
    Examples:
      stitch drop runs/blade-17 backlash
    """
    from stitch.api.stepwise import effects_without

    with opened_run(run, effects_file, trust, "reading the run") as state:
        _refit_run(run, state, effects_without(state, effects, run), recording, as_json)
    end_at_once()


def _refit_run(run: Path, state: RunData, effects: list[str], recording: bool, as_json: bool) -> None:
    """Replace the fit in a run folder by one with these effects, and print it.

    A fit with the same effects that the run had before is restored instead of being computed again.

    Args:
        run: run folder.
        state: the run that was read from it.
        effects: names of all effects of the new model.
        recording: write recording.rrd anew.
    """
    from stitch.api.pipeline import change
    from stitch.api.stepwise import with_prediction
    from stitch.output import run_folder
    from stitch.output.stored_run import load_run, standing_diagnosis
    from stitch.recorder import RunMemory

    if run_folder.restore_fit(run, effects, recording):
        with show_activity("reading the fit that was kept"):
            result = load_run(run, None if state.effects_file is None else Path(state.effects_file))
    else:
        run_folder.preload_entry_points("stitch.reports")
        standing = standing_diagnosis(run, state)
        with show_activity("reading the run"), run_folder.replace_run_files(run) as scratch:
            memory = RunMemory()
            result = change(state, effects, memory)
            result = with_prediction(result, _predicted_heldout(standing, state, effects))
            if note := _alternatives_note(standing, state, effects):
                result = result.with_fit(notes=(note, *result.notes))
            _write_changed(result, run, scratch, memory, recording)
    _show_changed(result, run, as_json)
    if not as_json:
        show_next(f"Next: stitch diagnose {shlex.quote(str(run))}")


def _write_changed(result: RunData, run: Path, scratch: Path, memory: RunMemory, recording: bool) -> None:
    """Show the progress of a change of the run in folder `run`, and write the changed run into a scratch folder.

    Args:
        memory: what recorders were told of it.
        recording: write recording.rrd too, which continues that of the folder.
    """
    from stitch.output.run_folder import write_with_page

    memory.replay_run(Progress(), result)
    if recording and (run / "recording.rrd").is_file():
        copyfile(run / "recording.rrd", scratch / "recording.rrd")
    write_with_page(result, scratch, record=partial(memory.replay_run, run=result) if recording else None)


def _predicted_heldout(standing: dict[str, Any], state: RunData, effects: Sequence[str]) -> float:
    """Return the error on views left out (length_unit) that a diagnosis predicts with one more effect.

    NaN where several effects are added or some dropped, or where the diagnosis did not predict it.

    Args:
        standing: diagnosis.json of the run; {} without one.
        state: the run before the change.
        effects: names of all effects of the new model.
    """
    added = set(effects) - set(state.effects)
    rows = [row for row in standing.get("candidates", []) if {row["effect"]} == added]
    known = [row["heldout_rms_if_added"] for row in rows if row["heldout_rms_if_added"] is not None]
    return known[0] if known and set(state.effects) < set(effects) else float("nan")


def _alternatives_note(standing: dict[str, Any], state: RunData, effects: Sequence[str]) -> str:
    """Return a sentence on the alternatives to the added effects that a diagnosis could not rule out; "" without any.

    Args:
        standing: diagnosis.json of the run; {} without one.
        state: the run before the change.
        effects: names of all effects of the new model.
    """
    undecided = standing.get("effects", []) if standing.get("verdict") == "cannot_tell" else []
    added = [name for name in undecided if name in effects and name not in state.effects]
    laws = [row["words"] for row in standing.get("laws", [])]
    others = [name for name in undecided if name not in effects] + laws
    if not added or not others:
        return ""
    fit = "fits" if len(others) == 1 else "fit"
    return f"{' and '.join(added)} was added, or {' or '.join(others)}, which {fit} these views as well."


def _add_diagnosed(
    run: Path, at_most: int | None, effects_file: Path | None, *, trust: bool, recording: bool, as_json: bool
) -> None:
    """Add the effects that a diagnosis chooses to a run, print what happened, and write run and diagnosis.

    Args:
        run: run folder.
        at_most: number of effects that may be added one by one; None: add a group that it cannot tell apart at once.
        recording: write recording.rrd anew.
    """
    from stitch.api.stepwise import suggest, suggest_group
    from stitch.cli.diagnose import write_diagnosis
    from stitch.output import run_folder
    from stitch.output.diagnosis_document import named_before
    from stitch.output.plain_finding import next_step_line, plain_finding
    from stitch.output.stored_run import standing_diagnosis
    from stitch.recorder import RunMemory

    memory = RunMemory()
    with opened_run(run, effects_file, trust, "diagnosing") as state:
        with show_activity("diagnosing"):
            # A diagnosis that is still valid and names nothing saves another one.
            standing = {} if at_most is None else standing_diagnosis(run, state)
            if standing.get("verdict", "missing_effect") != "missing_effect" and "next_command" in standing:
                _show_nothing_missing(standing, run, as_json)
                return
            run_folder.preload_entry_points("stitch.reports", *(["stitch.recorders"] if recording else []))
            if at_most is None:
                result, lines, diagnosis = suggest_group(state, memory)
            else:
                result, lines, diagnosis = suggest(state, at_most, named_before(standing, state.tried), memory)
        for line in lines if in_full() else ():
            say(line)
        if result is None:
            _show_unchanged(run, as_json)
        else:
            # People see the report before the files are written; a program takes JSON for the end, so it comes last.
            if not as_json:
                _show_changed(result, run, as_json)
            with show_activity("writing cloud and page"), run_folder.replace_run_files(run) as scratch:
                _write_changed(result, run, scratch, memory, recording)
            if as_json:
                _show_changed(result, run, as_json)
        write_diagnosis(diagnosis, result or state, run)
    if not in_full():
        say(plain_finding(diagnosis, state.session.length_unit))
    if not as_json:
        show_next(next_step_line(diagnosis, shlex.quote(str(run))))


def _show_nothing_missing(standing: dict[str, Any], run: Path, as_json: bool) -> None:
    """Print a stored diagnosis that names nothing to be added, and the next command."""
    from stitch.output.diagnosis_document import finding_lines

    for line in finding_lines(standing)[: None if in_full() else 1]:
        say(line)
    _show_unchanged(run, as_json)
    if not as_json:
        show_next(standing["next_command"].replace("RUN", shlex.quote(str(run))))


def _show_unchanged(run: Path, as_json: bool) -> None:
    """Print that nothing was added, or result.json of the run folder as it is."""
    if as_json:
        emit((run / "result.json").read_text(encoding="utf-8").rstrip())
    else:
        say("Nothing was added: the model is as it was.")


def _show_changed(result: RunData, run: Path, as_json: bool) -> None:
    """Print the report of a changed run, or its result as JSON.

    Runs of several sessions share a model.toml; a line says that the others in that folder still have the old model.
    """
    from stitch.cli.run import show_report
    from stitch.output.json_file import runs_of_rig, to_json
    from stitch.output.result_document import result_document

    if as_json:
        emit(to_json(result_document(result)))
        return
    show_report(result)
    for line in remarks(result) if in_full() else ():
        say(line)
    folder = run.resolve()
    if others := [name for name in runs_of_rig(folder.parent) if name != folder.name]:
        effects = f" --effects {','.join(result.effects)}" if result.effects else ""
        say(
            f"Of its rig this run alone has changed: {', '.join(others)} and their common model.toml are as they were. "
            f"For one model of all: stitch run, with all sessions{effects} and -o {shlex.quote(str(folder.parent))}"
        )


def remarks(result: RunData) -> list[str]:
    """Return sentences on effects that do not help, have an implausible size, or do not differ from zero.

    An effect helps if the error on views left out fell in the last step of the ledger, in which it was added.
    """
    from stitch.diagnosis.ranking import beyond_belief_text
    from stitch.diagnosis.thresholds import FAINT_SIGMAS, HELDOUT_FALL, HELDOUT_RISE

    lines: list[str] = []
    helpful: list[str] = []
    if len(result.ledger) > 1:
        before, after = result.ledger[-2:]
        added = sorted(set(after.effects) - set(before.effects))
        if after.heldout_rms < HELDOUT_FALL * before.heldout_rms:
            helpful = added
        elif added:
            clear = max(term.sigmas_from_zero for term in result.terms if term.name in added)
            rose = after.heldout_rms > HELDOUT_RISE * before.heldout_rms
            lines.append(_unseen_in_residuals(", ".join(added), clear, "rose" if rose else "did not fall"))
    for term in (term for term in result.terms if not term.is_geometry):
        wild = [p.name for p in term.parameters if p.fitted and not p.held and p.beyond_belief(p.value, p.sigma)]
        if wild:
            lines.append(f"{term.name}: {beyond_belief_text(wild)}.")
        if term.sigmas_from_zero < FAINT_SIGMAS:
            lines.append(
                f"{term.name}: views left out are predicted better with it, though none of its parameters differs from "
                "zero by two sigmas, their number counted."
                if term.name in helpful
                else f"{term.name}: of its parameters none is two sigmas from zero, their number counted: drop it."
            )
    return lines


def _unseen_in_residuals(names: str, clear: float, residual: str) -> str:
    """Return a sentence on added effects with which the residual on views left out is no smaller.

    Args:
        names: of the effects, as text.
        clear: largest distance of their parameters from zero, in sigmas.
        residual: "rose" or "did not fall".
    """
    from stitch.diagnosis.thresholds import CLEAR_SIGMAS, FAINT_SIGMAS

    if clear > CLEAR_SIGMAS:
        return f"{names}: {clear:.0f} sigmas from zero, but too small for a residual to show."
    if clear < FAINT_SIGMAS:
        return f"{names} did not earn a place: the held-out residual {residual}."
    return (
        f"{names}: the held-out residual {residual}, and the clearest number is {clear:.1f} sigmas from zero. To learn "
        "whether it is there, drop it and diagnose: that asks the poses of views left out."
    )
