"""`stitch effects`: the library with formulas; `stitch effects NAME`: one of them."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from stitch.effects.contract import EFFECTS, PLACES, Effect
from stitch.effects.terms import known
from stitch.effects.user_file import load


def effects(
    name: Annotated[str | None, typer.Argument(metavar="NAME", help="Show one effect.")] = None,
    effects_file: Annotated[
        Path | None, typer.Option("--effects-file", metavar="PY", help="Python file with effects of your own.")
    ] = None,
) -> None:
    """List the physical effects with place, formula, parameters and plausible sizes."""
    if effects_file:
        load(effects_file)
    console = Console()
    if name:
        _one(console, name)
        return
    table = Table()
    for heading in ("effect", "place", "what nature does", "parameters"):
        table.add_column(heading, overflow="fold")
    for effect in EFFECTS.values():
        table.add_row(effect.name, effect.place, effect.formula, signature(effect))
    console.print(table)


def signature(effect: Effect) -> str:
    """The parameters with their units: c₁… (rad/(N m))."""
    return ", ".join(f"{key}{'' if s.kind == 'number' else '₁…'} ({s.unit})" for key, s in effect.specs.items())


def _one(console: Console, name: str) -> None:
    effect = known(name)
    console.print(
        f"{effect.name} ({effect.tier}), at {effect.place}: {PLACES[effect.place]}", soft_wrap=True, highlight=False
    )
    console.print(f"  {effect.formula}", highlight=False)
    kinds = {
        "number": "",
        "offset": ", x, y, z, or zero",
        "joint": ", one a joint",
        "torque": ", one a gravity torque",
        "twist": ", a twist: rx … tz",
    }
    for key, spec in effect.specs.items():
        shift = f" and {spec.typical_shift:g} {spec.unit_shift}" if spec.kind == "twist" else ""
        sizes = f"plausible {spec.typical:g}{shift}, not believed beyond {spec.limit:g}"
        console.print(f"  {key}: {spec.unit}{kinds[spec.kind]}; {sizes}", soft_wrap=True, highlight=False)
    if effect.needs:
        console.print(f"  needs {', '.join(effect.needs)}", highlight=False)
    if effect.prefers:
        console.print(f"  uses {', '.join(effect.prefers)} where the session has it", highlight=False)
