"""`stitch add RUN EFFECT…`, `stitch drop RUN EFFECT…`: change the model, refit, print the ledger."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stitch.cli.options import EffectsFile, Json, Trust
from stitch.cli.terminal import emit, recorder_for, show_activity
from stitch.errors import InputError

if TYPE_CHECKING:
    from stitch.diagnosis.diagnosis import Diagnosis
    from stitch.model.model import Term
    from stitch.runs.run import Run


# The history of a model as a table, its parameters, and whether the last effect earned its place.


def show_ledger(result: Run) -> None:
    """History of the model, fitted parameters, and whether the last effect earned its place."""
    from rich.table import Table

    from stitch.comparison.disagreement_field import model_history
    from stitch.comparison.run_verdict import run_verdict
    from stitch.model.model import hand_eye_lines
    from stitch.system.process import console
    from stitch.units import length_text

    terminal, unit = console(), result.session.length_unit
    table = Table(title=f"{result.session.name}: history of the model", title_justify="left")
    for heading in ("step", "effects", "residual", "held-out", "noise floor"):
        table.add_column(heading, justify="left" if heading == "effects" else "right")
    for i, s in enumerate(result.ledger):
        numbers = (length_text(x, unit, 4, zeros=True) for x in (s.residual_rms, s.heldout_rms, s.noise_floor))
        table.add_row(str(i), ", ".join(s.effects) or "hand-eye alone", *numbers)
    terminal.print(table)
    terminal.print(run_verdict(result, model_history(result)), soft_wrap=True, style="bold")
    for p, name in ((p, term.name) for term in result.terms for p in term.parameters):
        if p.fitted or p.grid:
            how = "" if p.fitted else " (of those tried, this explains most)"
            terminal.print(f"  {name}.{p.name} = {p.formatted}{how}")
    for line in remarks(result):
        terminal.print(line, soft_wrap=True)
    hand_eye = hand_eye_lines(result.T_mount, result.mount_covariance, result.session.mount, unit)
    for line in (*result.notes[len(result.left_out) :], *hand_eye):
        terminal.print(line, soft_wrap=True)


def remarks(result: Run) -> list[str]:
    """Did the effects earn their place? Are they of a believable size?"""
    from stitch.diagnosis.thresholds import FAINT_SIGMAS, HELDOUT_FALL, HELDOUT_RISE

    out, earned = [], set[str]()
    if len(result.ledger) > 1:
        before, after = result.ledger[-2], result.ledger[-1]
        grown = sorted(set(after.effects) - set(before.effects))
        if after.heldout_rms < HELDOUT_FALL * before.heldout_rms:
            earned = set(grown)
        elif grown:
            clear = max(_clearest(term) for term in result.terms if term.name in grown)
            rose = after.heldout_rms > HELDOUT_RISE * before.heldout_rms
            out.append(_unseen_in_residuals(", ".join(grown), clear, "rose" if rose else "did not fall"))
    for term in result.terms:
        wild = [p.name for p in term.parameters if not p.grid and abs(p.value) > p.limit]
        if wild:
            out.append(f"{term.name}: {', '.join(wild)} is larger than anybody would believe.")
        if _clearest(term) < FAINT_SIGMAS:
            out.append(
                f"{term.name}: views left out are predicted better with it, though no parameter differs from zero by "
                "two sigmas, which count all that an arm may do beside it."
                if term.name in earned
                else f"{term.name}: no parameter differs from zero by two sigmas; it can be dropped."
            )
    return out


def _unseen_in_residuals(names: str, clear: float, residual: str) -> str:
    """Of effects with which the held-out residual is no smaller, the clearest number so many sigmas from zero."""
    from stitch.diagnosis.thresholds import CLEAR_SIGMAS, FAINT_SIGMAS

    if clear > CLEAR_SIGMAS:
        return f"{names}: {clear:.0f} sigmas from zero, but too small for a residual to show."
    if clear < FAINT_SIGMAS:
        return f"{names} did not earn a place: the held-out residual {residual}."
    return (
        f"{names}: the held-out residual {residual}, and the clearest number is {clear:.1f} sigmas from zero; a "
        "diagnosis of the model without it asks the poses of views left out whether it is there."
    )


def _clearest(term: Term) -> float:
    """The largest |value|/sigma of an effect's parameters; 0 where the views see none."""
    return max((abs(p.value) / p.sigma for p in term.parameters if p.fitted and not p.grid), default=0.0)


# What `stitch add` and `stitch drop` do: another model for a run, everything fitted anew, the ledger for people.


def add_effects(
    run: Path, effects: list[str], effects_file: Path | None, *, trust: bool, recording: bool, as_json: bool
) -> None:
    """Add effects by their names.

    Raises:
        InputError, NoResultError: as `stitch add` ends.
    """
    from stitch.effects.contract import find_effect, require_available
    from stitch.stored.stored_run import load_run
    from stitch.writing import run_folder

    with run_folder.lock_run_folder(run):
        state = load_run(run, effects_file, trust=trust)
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
    from stitch.pipeline import suggest, suggest_group
    from stitch.stored.stored_run import load_run
    from stitch.system.process import console
    from stitch.writing import run_folder
    from stitch.writing.diagnosis_document import suggested_command

    with run_folder.lock_run_folder(run):
        with show_activity("diagnosing"):
            state = load_run(run, effects_file, trust=trust)
            run_folder.preload_entry_points("stitch.reports")
            chosen = suggest_group(state) if at_most is None else suggest(state, at_most)
        found = _keep_diagnosed(run, state, chosen, recording, as_json)
    if says_next and not as_json:
        console().print(suggested_command(found, shlex.quote(str(run))), soft_wrap=True)


def _keep_diagnosed(
    run: Path, state: Run, chosen: tuple[Run | None, list[str], Diagnosis], recording: bool, as_json: bool
) -> Diagnosis:
    """Write and show what a diagnosis chose; what was tried on the way leaves no recording, the end does."""
    from stitch.cli.diagnose import write_diagnosis
    from stitch.pipeline import change
    from stitch.system.process import console
    from stitch.writing import run_folder

    result, lines, found = chosen
    for line in lines:
        console().print(line, soft_wrap=True)
    if result is not None:
        with show_activity("writing cloud and page"), run_folder.replace_run_files(run) as scratch:
            if recording:
                # The same fit once more from where it ended, for the recording; it takes the last step's place.
                before = replace(result, ledger=result.ledger[:-1])
                again = change(before, result.effects, recorder_for(scratch, recording))
                result = again.with_fit(notes=result.notes)
            run_folder.write_with_page(result, scratch)
        _show_changed(result, run, as_json)
    elif as_json:
        emit((run / "result.json").read_text(encoding="utf-8").rstrip())
    else:
        console().print("Nothing was added: the model is as it was.", soft_wrap=True)
    write_diagnosis(found, result or state, run)
    return found


def drop_effects(
    run: Path, effects: list[str], effects_file: Path | None, *, trust: bool, recording: bool, as_json: bool
) -> None:
    """Take effects out by their names.

    Raises:
        InputError, NoResultError: as `stitch drop` ends.
    """
    from stitch.stored.stored_run import load_run
    from stitch.writing import run_folder

    with run_folder.lock_run_folder(run):
        state = load_run(run, effects_file, trust=trust)
        used = state.model.effects
        for name in effects:
            if name not in used:
                raise InputError(f"{name} is not in the model of {run}; in it are {', '.join(used) or 'none'}")
        kept = [name for name in used if name not in effects]
        _refit_run(run, state, kept, recording, as_json)


def _refit_run(run: Path, state: Run, effects: list[str], recording: bool, as_json: bool) -> None:
    """Give the run folder the model with these effects, and show it."""
    from stitch.pipeline import change
    from stitch.system.process import console
    from stitch.writing import run_folder

    run_folder.preload_entry_points("stitch.reports")
    with show_activity("reading the run"), run_folder.replace_run_files(run) as scratch:
        result = change(state, effects, recorder_for(scratch, recording))
        run_folder.write_with_page(result, scratch)
    _show_changed(result, run, as_json)
    if not as_json:
        console().print(f"Next: stitch diagnose {shlex.quote(str(run))}", soft_wrap=True)


def _show_changed(result: Run, run: Path, as_json: bool) -> None:
    from stitch.system.process import console
    from stitch.writing.json_file import others_of_rig, to_json
    from stitch.writing.result_document import result_document

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


AT_MOST = 5  # effects that --suggested adds one by one
_Recording = Annotated[bool, typer.Option("--recording/--no-recording", help="Write recording.rrd anew.")]


def add(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder; changed in place.")],
    effects: Annotated[list[str] | None, typer.Argument(metavar="EFFECT...", help="Effects to add.")] = None,
    suggested: Annotated[bool, typer.Option("--suggested", help="Diagnose and add until nothing is left.")] = False,
    group: Annotated[bool, typer.Option("--group", help="Diagnose; add effects that it cannot tell apart.")] = False,
    at_most: Annotated[int, typer.Option("--at-most", help="Limit for --suggested.")] = AT_MOST,
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
        add_effects(run, effects, effects_file, trust=trust, recording=recording, as_json=as_json)
    else:
        limit = at_most if suggested else None
        add_diagnosed(run, limit, effects_file, trust=trust, recording=recording, as_json=as_json)


def drop(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder; changed in place.")],
    effects: Annotated[list[str], typer.Argument(metavar="EFFECT...", help="Effects to take out.")],
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

    drop_effects(run, effects, effects_file, trust=trust, recording=recording, as_json=as_json)
