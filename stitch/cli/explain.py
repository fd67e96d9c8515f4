"""`stitch explain RUN`: a formula for what no effect of the library explains, as a file of effects."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stitch.cli.options import EffectsFile, Json, RunFolder, Trust
from stitch.cli.terminal import emit
from stitch.errors import InputError, NoResultError

if TYPE_CHECKING:
    from stitch.explanation.explain import Explanation


# What `stitch explain` does: a formula of what is left in a run, as a file and for people.


def run_explain(run: Path, output: Path | None, effects_file: Path | None, *, trust: bool, as_json: bool) -> None:
    """Look for a formula, write it and show it.

    Raises:
        InputError, NoResultError: as `stitch explain` ends.
    """
    from stitch.diagnosis.diagnose import linear_model_of
    from stitch.explanation.explain import EFFECT_NAME, explain
    from stitch.stored.stored_run import load_run
    from stitch.system.files import whole_file
    from stitch.writing.json_file import to_json

    state = load_run(run, effects_file, trust=trust)
    if EFFECT_NAME in state.model.effects:
        raise InputError(
            f"{run}: has an effect {EFFECT_NAME!r} in its model; to fix: give it another name in its file, and add that"
        )
    found = explain(linear_model_of(state), f"Found by `stitch explain` in {state.session.name}.")
    heldout = state.heldout_or_fit_rms * found.heldout_share**0.5 if found.found else None
    if output is not None and found.found:
        with whole_file(output) as file:
            file.write_text(found.source, encoding="utf-8")
    if as_json:
        emit(to_json(_document(found, heldout)))
    else:
        _show_explanation(found, heldout, state.session.length_unit, run, output)
    if not found.found and output is not None:
        raise NoResultError(
            f"{run}: no formula holds, nothing was written to {output}; what may matter beside can stand in columns of "
            "views.csv, and more views tell more"
        )


def _document(explanation: Explanation, heldout: float | None) -> dict[str, object]:
    return {
        "found": explanation.found,
        "formula": explanation.formula,
        "place": explanation.place,
        "heldout_rms": heldout,
        "p_value": explanation.p_value if explanation.found else None,
        "tested_formula": explanation.tested,  # of which p_value is
        "sentence": explanation.why,
    }


def _show_explanation(
    explanation: Explanation, heldout: float | None, unit: str, run: Path, output: Path | None
) -> None:
    from stitch.explanation.explain import EFFECT_NAME
    from stitch.system.process import console
    from stitch.units import length_text

    terminal = console()
    terminal.print(explanation.why, soft_wrap=True)
    if heldout is None:
        return
    terminal.print(f"Added, it should leave {length_text(heldout, unit)} on views left out.", soft_wrap=True)
    if output is None:
        terminal.print(f"Next: stitch explain {run} -o mine.py", soft_wrap=True)
    else:
        terminal.print(
            f"Next: read {output}, then stitch add {run} {EFFECT_NAME} --effects-file {output}", soft_wrap=True
        )
        if explanation.place == "robot":
            # Of a measured arm a formula that left 7 to 16 % less in its own series left 10 to 27 % more in another.
            terminal.print(
                "Only this session was asked; whether it is the arm's or belongs to this day tells, once it is added: "
                f"stitch run OTHER_SESSION --arm {run} --effects-file {output}",
                soft_wrap=True,
            )


def explain_run(
    run: RunFolder,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="FILE", help="Python file for the formula, to edit and add."),
    ] = None,
    effects_file: EffectsFile = None,
    trust: Trust = False,
    as_json: Json = False,
) -> None:
    """Look for a formula of what is left: chosen in some of the views, tested in the others.

    \b
    Examples:
      stitch explain runs/blade-17
      stitch explain runs/blade-17 -o mine.py
    """
    if output is not None and output.suffix != ".py":
        raise InputError(f"{output}: effects stand in a Python file; to fix: name it {output.with_suffix('.py').name}")
    if output is not None and output.exists():
        raise InputError(f"{output}: there is such a file; to fix: name another, or move it away")
    if output is not None and not output.parent.is_dir():
        raise InputError(f"{output}: there is no folder {output.parent}; to fix: make it, or name another")

    run_explain(run, output, effects_file, trust=trust, as_json=as_json)
