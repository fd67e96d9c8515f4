"""`stitch explain RUN`: a formula for what no effect of the library explains, as a file of effects."""

from pathlib import Path
from typing import Annotated

import typer

from stitch.cli.options import EffectsFile, Json, RunFolder, Trust
from stitch.errors import InputError


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
    # Loaded by who runs something: whoever asks for help has it at once.
    from stitch.cli.actions.explained_run import run_explain

    run_explain(run, output, effects_file, trust=trust, as_json=as_json)
