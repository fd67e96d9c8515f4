"""Reference pages made from the code: commands with their options, the library of effects, the functions of Python."""

import re
from math import isfinite

import typer
from typer.cli import get_docs_for_click

import stitch
from stitch import MODULES
from stitch.cli.effects import parameter_signature
from stitch.cli.main import build
from stitch.effects import EFFECTS
from stitch.effects.contract import PLACES


def commands_page() -> str:
    """Every command with its arguments and options, as its help has them."""
    group = typer.main.get_command(build())
    context = typer.Context(group, info_name="stitch")
    parts = ["# Commands and options\n\nMade from the commands themselves: `stitch COMMAND --help` says the same.\n"]
    for name in sorted(group.commands):
        text = get_docs_for_click(obj=group.commands[name], ctx=context, indent=1, name=name, call_prefix="stitch")
        parts.append(_examples_as_block(text))
    return "\n".join(parts)


def effects_page() -> str:
    """The library of effects."""
    rows = [
        f"| `{e.name}` | {e.place} | {_cell(e.formula)} | {_cell(parameter_signature(e))} | {_sizes(e)} | "
        f"{', '.join(e.needs)} |"
        for e in EFFECTS.values()
    ]
    places = "\n".join(f"| `{name}` | {_cell(text)} |" for name, text in PLACES.items())
    return f"""# Effects

Made from the library: `stitch effects` lists the same. What the places mean and how to write your own:
[effects](effects.md).

| effect | place | what nature does | parameters | plausible; not believed beyond | needs |
|---|---|---|---|---|---|
{chr(10).join(rows)}

| place | the function receives → returns |
|---|---|
{places}
"""


def python_page() -> str:
    """What `import stitch` offers."""
    names = "\n\n".join(f"::: {module}.{name}" for name, module in MODULES.items())
    told = "Made from the docstrings of what `import stitch` offers; frames and units: [glossary](glossary.md)."
    return f"# Every name of Python\n\n{told} How they work together: [python](python.md).\n\n{names}\n"


def _sizes(effect: stitch.effects.contract.Effect) -> str:
    """Plausible sizes of its parameters, and beyond which they are not believed."""
    return "; ".join(
        f"{key} {spec.typical:g}{f'; {spec.limit:g}' if isfinite(spec.limit) else ''}"
        for key, spec in effect.specs.items()
    )


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _examples_as_block(text: str) -> str:
    """Indented examples of a help as a block of code."""
    return re.sub(
        r"(?m)^Examples:\n((?:  .*\n)+)",
        lambda m: "Examples:\n\n```sh\n" + re.sub(r"(?m)^  ", "", m[1]) + "```\n",
        text,
    )
