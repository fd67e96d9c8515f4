"""`stitch effects`: the library with formulas; `stitch effects NAME`: one of them."""

from __future__ import annotations

from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stitch.cli.options import EffectsFile, Json
from stitch.cli.terminal import emit, results_stream

if TYPE_CHECKING:
    from rich.console import Console

    from stitch.effects.contract import Effect


# What `stitch effects` does: the library as a table, one effect in full, or both as JSON.


def run_effects(name: str | None, effects_file: Path | None, as_json: bool) -> None:
    """Show the library, or one effect of it.

    Raises:
        InputError: no such effect, or a file of effects that is none.
    """
    from rich.table import Table

    from stitch.effects.contract import EFFECTS, find_effect
    from stitch.effects.user_file import load
    from stitch.system.process import console
    from stitch.writing.json_file import to_json

    if effects_file:
        load(effects_file)
    terminal = console(results_stream())
    if as_json:
        emit(to_json([_document(e) for e in ([find_effect(name)] if name else EFFECTS.values())]))
        return
    if name:
        _show_effect(terminal, name)
        return
    table = Table()
    for heading in ("effect", "place", "what nature does", "parameters"):
        table.add_column(heading, overflow="fold", no_wrap=heading == "effect")
    for effect in EFFECTS.values():
        table.add_row(effect.name, effect.place, effect.formula, parameter_signature(effect))
    terminal.print(table)


def parameter_signature(effect: Effect) -> str:
    """The parameters with their units: c₁… (rad/(N m))."""
    return ", ".join(f"{key}{'' if s.kind == 'number' else '₁…'} ({s.unit})" for key, s in effect.specs.items())


def _document(effect: Effect) -> dict[str, Any]:
    parameters = [
        {
            "name": key,
            "kind": s.kind,
            "unit": s.unit,
            "plausible": s.typical,
            "limit": s.limit if isfinite(s.limit) else None,
        }
        | ({"unit_shift": s.unit_shift, "plausible_shift": s.typical_shift} if s.kind == "twist" else {})
        for key, s in effect.specs.items()
    ]
    return {
        "effect": effect.name,
        "place": effect.place,
        "tier": effect.tier,
        "formula": effect.formula,
        "parameters": parameters,
        "needs": list(effect.needs),
        "uses": list(effect.prefers),
    }


def _show_effect(terminal: Console, name: str) -> None:
    from stitch.effects.contract import PLACES, find_effect

    effect = find_effect(name)
    terminal.print(f"{effect.name} ({effect.tier}), at {effect.place}: {PLACES[effect.place]}", soft_wrap=True)
    terminal.print(f"  {effect.formula}")
    kinds = {
        "number": "",
        "offset": ", x, y, z, or zero",
        "joint": ", one a joint",
        "torque": ", one a gravity torque",
        "twist": ", a twist: rx … tz",
    }
    for key, spec in effect.specs.items():
        shift = f" and {spec.typical_shift:g} {spec.unit_shift}" if spec.kind == "twist" else ""
        sizes = f"plausible {spec.typical:g}{shift}, doubtful beyond {spec.limit:g}"
        terminal.print(f"  {key}: {spec.unit}{kinds[spec.kind]}; {sizes}", soft_wrap=True)
    if effect.needs:
        terminal.print(f"  needs {', '.join(effect.needs)}")
    if effect.prefers:
        terminal.print(f"  uses {', '.join(effect.prefers)} where the session has it")


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

    run_effects(name, effects_file, as_json)
