"""`stitch explain RUN`: a formula for what no effect of the library explains, as a file of effects."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stitch.cli.options import EffectsFile, Json, RunFolder, Trust, require_new
from stitch.cli.progress import show_activity
from stitch.cli.terminal import emit, say, show_next, stdout_for_results
from stitch.errors import InputError, NoResultError

if TYPE_CHECKING:
    from stitch.plugins.explain.explain import Explanation


@stdout_for_results
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
    from stitch.diagnosis.diagnose import linear_model_of
    from stitch.output.json_file import to_json
    from stitch.output.stored_run import load_run, standing_diagnosis
    from stitch.plugins.explain.explain import EFFECT_NAME, explain
    from stitch.system.files import whole_file

    if output is not None and output.suffix != ".py":
        raise InputError(f"{output}: effects stand in a Python file; to fix: name it {output.with_suffix('.py').name}")
    require_new(output)
    with show_activity("explaining: reading the scans"):
        state = load_run(run, effects_file, trust=trust)
    if EFFECT_NAME in state.model.effects:
        raise InputError(
            f"{run}: has an effect {EFFECT_NAME!r} in its model; to fix: give it another name in its file, and add that"
        )
    standing = standing_diagnosis(run, state)
    if not as_json and standing.get("verdict") in ("missing_effect", "cannot_tell"):
        named = " or ".join(standing["effects"])
        say(f"{named} of the library is still open, and a formula would take its part: add or decide that first.")
    with show_activity("explaining: what every view tells of its pose"):
        linear = linear_model_of(state)
    with show_activity("explaining: trying formulas"):
        found = explain(linear, f"Found by `stitch explain` in {state.session.name}.")
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
            f"{run}: no formula holds, nothing was written to {output}; to fix: add what else may matter as columns of "
            "views.csv, or more views"
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
    from stitch.numerics.units import length_text
    from stitch.plugins.explain.explain import EFFECT_NAME

    say(explanation.why, bold=True)
    if heldout is None:
        return
    say(f"Added, it should leave {length_text(heldout, unit)} on views left out.")
    folder = shlex.quote(str(run))
    if output is None:
        show_next(f"Next: stitch explain {folder} -o mine.py")
        return
    file = shlex.quote(str(output))
    if explanation.place == "robot":
        # Of a measured arm a formula that left 7 to 16 % less in its own series left 10 to 27 % more in another.
        say(
            "Only this session was asked. Once the formula is added, another session tells whether it is the arm's or "
            f"of this day alone: stitch run OTHER_SESSION --arm {folder} --effects-file {file}"
        )
    show_next(f"Next: read {file}, then stitch add {folder} {EFFECT_NAME} --effects-file {file}")
