"""`stitch effects`: the library with formulas; `stitch effects NAME`: one of them."""

from typing import Annotated

import typer

from stitch.cli.options import EffectsFile, Json


def effects(
    name: Annotated[str | None, typer.Argument(metavar="NAME", help="Show one effect.")] = None,
    effects_file: EffectsFile = None,
    as_json: Json = False,
) -> None:
    """List the physical effects with place, formula, parameters and plausible sizes.

    \b
    Examples:
      stitch effects
      stitch effects joint_compliance
      stitch effects --effects-file mine.py --json
    """
    # Loaded by who runs something: whoever asks for help has it at once.
    from stitch.cli.actions.listed_effects import run_effects

    run_effects(name, effects_file, as_json)
