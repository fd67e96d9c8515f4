"""`stitch add RUN EFFECT…`, `stitch drop RUN EFFECT…`: change the model, refit, print the ledger."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from stitch.cli.diagnose import write_diagnosis
from stitch.cli.run import recorder_for
from stitch.errors import InputError
from stitch.model.terms import known, require
from stitch.pipeline import change
from stitch.runs.run import Run
from stitch.stepwise import suggest
from stitch.stored.load_state import State, load_state, state_of
from stitch.units import MICROMETRES, rounded
from stitch.writing import run_folder
from stitch.writing.json_file import to_json
from stitch.writing.result_document import result_document

# A held-out residual falls if it does by more than new matches alone change it.
_FALLS = 0.995
_CLEAR = 4.0
_EffectsFile = Annotated[
    Path | None, typer.Option("--effects-file", metavar="PY", help="Python file with effects of your own.")
]
_Recording = Annotated[bool, typer.Option("--recording/--no-recording", help="Write recording.rrd anew.")]
_Json = Annotated[bool, typer.Option("--json", help="Print result.json alone on standard output.")]


def add(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder; changed in place.")],
    effects: Annotated[list[str] | None, typer.Argument(metavar="EFFECT...", help="Effects to add.")] = None,
    suggested: Annotated[bool, typer.Option("--suggested", help="Diagnose and add until nothing is left.")] = False,
    at_most: Annotated[int, typer.Option("--at-most", help="Limit for --suggested.")] = 5,
    effects_file: _EffectsFile = None, recording: _Recording = True, as_json: _Json = False,
) -> None:  # fmt: skip
    """Add effects to the model of a run, fit hand-eye and all effects anew, and show what it brought."""
    if bool(effects) == suggested:
        raise InputError("name the effects to add, or let the diagnosis choose with --suggested (one of the two)")
    state = load_state(run, effects_file)
    if suggested:
        _suggested(run, state, at_most, recording, as_json)
        return
    used = [t.effect.name for t in state.terms]
    for name in effects or []:
        require(state.measurement, known(name))
        if name in used:
            raise InputError(f"{name} is in the model of {run} already")
    _change(run, state, [*used, *(effects or [])], recording, as_json)


def _suggested(run: Path, state: State, at_most: int, recording: bool, as_json: bool) -> None:
    """Diagnose and add; what was tried on the way leaves no recording, the end does."""
    result, lines, found = suggest(state, at_most)
    for line in lines:
        Console(stderr=True).print(line, soft_wrap=True, highlight=False)
    if result is not None:
        with run_folder.changed(run) as scratch:
            if recording:
                # The same fit once more from where it ended, for the recording; it takes the last step's place.
                before = replace(state_of(result), ledger=result.ledger[:-1])
                again = change(before, list(result.effects), recorder_for(scratch, recording))
                result = replace(again, poses_before=result.poses_before)
            run_folder.write_with_page(result, scratch)
        _show(result, as_json)
    elif as_json:
        print((run / "result.json").read_text(encoding="utf-8").rstrip())
    write_diagnosis(found, state if result is None else state_of(result), run)


def drop(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder; changed in place.")],
    effects: Annotated[list[str], typer.Argument(metavar="EFFECT...", help="Effects to take out.")],
    effects_file: _EffectsFile = None, recording: _Recording = True, as_json: _Json = False,
) -> None:  # fmt: skip
    """Take effects out of the model of a run and fit the rest anew."""
    state = load_state(run, effects_file)
    used = [t.effect.name for t in state.terms]
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
        print(to_json(result_document(result)))
    else:
        show_ledger(result)


def show_ledger(result: Run) -> None:
    """History of the model, fitted parameters, and whether the last effect earned its place."""
    console, to_um = Console(stderr=True), MICROMETRES[result.session.length_unit]
    table = Table(title=f"{result.session.name}: history of the model", title_justify="left")
    for heading in ("step", "effects", "residual (µm)", "held-out (µm)", "noise floor (µm)"):
        table.add_column(heading, justify="left" if heading == "effects" else "right")
    for i, s in enumerate(result.ledger):
        numbers = (f"{x * to_um:.1f}" for x in (s.residual_rms, s.heldout_rms, s.noise_floor))
        table.add_row(str(i), ", ".join(s.effects) or "hand-eye alone", *numbers)
    console.print(table)
    for term, sigmas in zip(result.terms, result.sigmas, strict=True):
        for p, value, sigma in zip(result.measurement.parameters(term.effect), term.values, sigmas, strict=True):
            told = f"± {sigma:.1g}" if np.isfinite(sigma) else "(explains most)"
            if np.isfinite(sigma) or p.grid:
                console.print(
                    f"  {term.effect.name}.{p.name} = {rounded(value, sigma)} {told} {p.unit}", highlight=False
                )
    for line in remarks(result):
        console.print(line, soft_wrap=True, highlight=False)


def remarks(result: Run) -> list[str]:
    """Did the effects earn their place? Are they of a believable size?"""
    out = []
    if len(result.ledger) > 1:
        before, after = result.ledger[-2], result.ledger[-1]
        grown = sorted(set(after.effects) - set(before.effects))
        if grown and not after.heldout_rms < _FALLS * before.heldout_rms:
            clear = max(_clearest(result, name) for name in grown)
            out.append(
                f"{', '.join(grown)}: {clear:.0f} sigmas from zero, but too small for a residual to show."
                if clear > _CLEAR
                else f"{', '.join(grown)} did not earn a place: the held-out residual did not fall."
            )
    for term in result.terms:
        parameters = result.measurement.parameters(term.effect)
        wild = [p.name for p, v in zip(parameters, term.values, strict=True) if not p.grid and abs(v) > p.limit]
        if wild:
            out.append(f"{term.effect.name}: {', '.join(wild)} is larger than anybody would believe.")
        if _clearest(result, term.effect.name) < 2:
            out.append(f"{term.effect.name}: no parameter differs from zero by two sigmas; it can be dropped.")
    return out


def _clearest(result: Run, name: str) -> float:
    """The largest |value|/sigma of an effect's parameters; 0 where the views see none."""
    k = list(result.effects).index(name)
    parameters = result.measurement.parameters(result.terms[k].effect)
    fitted = np.array([not p.grid for p in parameters]) & np.isfinite(result.sigmas[k])
    return float(np.max(np.abs(result.terms[k].values[fitted]) / result.sigmas[k][fitted], initial=0.0))
