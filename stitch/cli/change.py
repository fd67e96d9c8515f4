"""`stitch add RUN EFFECT…`, `stitch drop RUN EFFECT…`: change the model, refit, print the ledger."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from stitch.cli.diagnose import write_diagnosis
from stitch.cli.options import EffectsFile, Json, Trust
from stitch.cli.recorders import recorder_for
from stitch.cli.streams import emit
from stitch.comparison.model_history import model_history
from stitch.comparison.run_verdict import run_verdict
from stitch.diagnosis.diagnosis import Diagnosis
from stitch.diagnosis.thresholds import CLEAR, FAINT, FALL
from stitch.effects.in_session import known, require
from stitch.errors import InputError
from stitch.model.term import Term
from stitch.pipeline import change
from stitch.runs.run import Run
from stitch.runs.state import State, state_of
from stitch.stepwise import suggest, suggest_group
from stitch.stored.load_state import load_state
from stitch.system.console import console
from stitch.units import length_text, rounded
from stitch.writing import run_folder
from stitch.writing.json_file import to_json
from stitch.writing.result_document import result_document

_Recording = Annotated[bool, typer.Option("--recording/--no-recording", help="Write recording.rrd anew.")]


def add(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder; changed in place.")],
    effects: Annotated[list[str] | None, typer.Argument(metavar="EFFECT...", help="Effects to add.")] = None,
    suggested: Annotated[bool, typer.Option("--suggested", help="Diagnose and add until nothing is left.")] = False,
    group: Annotated[bool, typer.Option("--group", help="Diagnose; add effects that it cannot tell apart.")] = False,
    at_most: Annotated[int, typer.Option("--at-most", help="Limit for --suggested.")] = 5,
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
    with run_folder.held(run):
        state = load_state(run, effects_file, trust=trust)
        if suggested or group:
            chosen = suggest(state, at_most) if suggested else suggest_group(state)
            _suggested(run, state, chosen, recording, as_json)
            return
        used = state.model.effects
        for name in effects or []:
            require(state.measurement, known(name))
            if name in used:
                raise InputError(f"{name} is in the model of {run} already; to fix: leave it out")
        _change(run, state, [*used, *(effects or [])], recording, as_json)


def _suggested(
    run: Path, state: State, chosen: tuple[Run | None, list[str], Diagnosis], recording: bool, as_json: bool
) -> None:
    """Write and show what a diagnosis chose; what was tried on the way leaves no recording, the end does."""
    result, lines, found = chosen
    for line in lines:
        console().print(line, soft_wrap=True)
    if result is not None:
        with run_folder.changed(run) as scratch:
            if recording:
                # The same fit once more from where it ended, for the recording; it takes the last step's place.
                before = replace(state_of(result), ledger=result.ledger[:-1])
                again = change(before, result.effects, recorder_for(scratch, recording))
                result = replace(again, notes=result.notes)
            run_folder.write_with_page(result, scratch)
        _show(result, as_json)
    elif as_json:
        emit((run / "result.json").read_text(encoding="utf-8").rstrip())
    else:
        console().print("Nothing was added: the model is as it was.", soft_wrap=True)
    write_diagnosis(found, state if result is None else state_of(result), run)


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
    with run_folder.held(run):
        state = load_state(run, effects_file, trust=trust)
        used = state.model.effects
        for name in effects:
            if name not in used:
                raise InputError(f"{name} is not in the model of {run}; in it are {', '.join(used) or 'none'}")
        kept = [name for name in used if name not in effects]
        _change(run, state, kept, recording, as_json)


def _change(run: Path, state: State, effects: list[str], recording: bool, as_json: bool) -> None:
    """Give the run folder the model with these effects, and show it."""
    with run_folder.changed(run) as scratch:
        result = change(state, effects, recorder_for(scratch, recording))
        run_folder.write_with_page(result, scratch)
    _show(result, as_json)


def _show(result: Run, as_json: bool) -> None:
    if as_json:
        emit(to_json(result_document(result)))
    else:
        show_ledger(result)


def show_ledger(result: Run) -> None:
    """History of the model, fitted parameters, and whether the last effect earned its place."""
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
            known_to = f"± {p.sigma:.1g}" if p.fitted else "(explains most)"
            terminal.print(f"  {name}.{p.name} = {rounded(p.value, p.sigma)} {known_to} {p.unit}")
    for line in remarks(result):
        terminal.print(line, soft_wrap=True)


def remarks(result: Run) -> list[str]:
    """Did the effects earn their place? Are they of a believable size?"""
    out = []
    if len(result.ledger) > 1:
        before, after = result.ledger[-2], result.ledger[-1]
        grown = sorted(set(after.effects) - set(before.effects))
        if grown and not after.heldout_rms < FALL * before.heldout_rms:
            clear = max(_clearest(term) for term in result.terms if term.name in grown)
            out.append(
                f"{', '.join(grown)}: {clear:.0f} sigmas from zero, but too small for a residual to show."
                if clear > CLEAR
                else f"{', '.join(grown)} did not earn a place: the held-out residual did not fall."
            )
    for term in result.terms:
        wild = [p.name for p in term.parameters if not p.grid and abs(p.value) > p.limit]
        if wild:
            out.append(f"{term.name}: {', '.join(wild)} is larger than anybody would believe.")
        if _clearest(term) < FAINT:
            out.append(f"{term.name}: no parameter differs from zero by two sigmas; it can be dropped.")
    return out


def _clearest(term: Term) -> float:
    """The largest |value|/sigma of an effect's parameters; 0 where the views see none."""
    return max((abs(p.value) / p.sigma for p in term.parameters if p.fitted and not p.grid), default=0.0)
