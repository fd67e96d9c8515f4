"""`stitch effects`: the library with formulas; `stitch effects NAME`: one of them."""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stitch.cli.options import EffectsFile, Json, complete_effect
from stitch.cli.terminal import emit, say, show_columns

if TYPE_CHECKING:
    from stitch.effects.contract import Effect


def effects(
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="Show one effect.", autocompletion=complete_effect)
    ] = None,
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
    from stitch.effects.contract import EFFECTS, find_effect
    from stitch.effects.user_file import load
    from stitch.output.json_file import to_json

    if effects_file:
        load(effects_file)
    listed = [find_effect(name)] if name else list(EFFECTS.values())
    columns = (
        ("effect", lambda e: e.name),
        ("place", lambda e: e.place),
        ("what nature does", lambda e: e.formula),
        ("parameters", parameter_signature),
    )
    if as_json:
        emit(to_json([_document(effect) for effect in listed]))
    elif name:
        _show_effect(listed[0])
    else:
        words = [heading for heading, _ in columns]
        show_columns("Physical effects", columns, listed, words)


def parameter_signature(effect: Effect) -> str:
    """Return the parameters with their units: c₁… (rad/(N m))."""
    return ", ".join(f"{key}{'' if s.kind == 'number' else '₁…'} ({s.unit})" for key, s in effect.specs.items())


def _document(effect: Effect) -> dict[str, Any]:
    """Return an effect as JSON: place, formula, parameters with units and plausible sizes, and the data it needs.

    A twist has rotations and translations: its `unit` and `plausible` are those of the former, `…_shift` the latter's.
    """
    return {
        "effect": effect.name,
        "place": effect.place,
        "tier": effect.tier,
        "formula": effect.formula,
        "parameters": [
            {
                "name": key,
                "kind": spec.kind,
                "unit": spec.unit,
                "plausible": spec.typical,
                "limit": spec.limit if isfinite(spec.limit) else None,
            }
            | ({"unit_shift": spec.unit_shift, "plausible_shift": spec.typical_shift} if spec.kind == "twist" else {})
            for key, spec in effect.specs.items()
        ],
        "needs": list(effect.needs),
        "uses": list(effect.prefers),
    }


def _show_effect(effect: Effect) -> None:
    """Print an effect: place and formula, a line per parameter with its plausible size, and the data it needs."""
    from stitch.effects.contract import PLACES

    # How many numbers a parameter stands for, by its kind.
    kinds = {
        "number": "",
        "vector": ", x, y, z",
        "offset": ", {}, or zero",
        "joint": ", one a joint",
        "torque": ", one a gravity torque",
        "moment": ", one a moment at the base",
        "twist": ", a twist: rx … tz",
        "rotary": ", one or more a rotary axis",
        "linear": ", one or more a linear axis",
        "scanner": ", three a scanner but the first",
    }
    lines = [f"{effect.name} ({effect.tier}), at {effect.place}: {PLACES[effect.place]}", f"  {effect.formula}"]
    for key, spec in effect.specs.items():
        shift = f" and {spec.typical_shift:g} {spec.unit_shift}" if spec.kind == "twist" else ""
        sizes = f"plausible {spec.typical:g}{shift}, doubtful beyond {spec.limit:g}"
        lines.append(f"  {key}: {spec.unit}{kinds[spec.kind].format(', '.join(spec.axes))}; {sizes}")
    if effect.needs:
        lines.append(f"  needs {', '.join(effect.needs)}")
    if effect.prefers:
        lines.append(f"  uses {', '.join(effect.prefers)} where the session has it")
    for line in lines:
        say(line)
