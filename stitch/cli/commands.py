"""The commands of `stitch`: those of the core, and those of plug-ins, by the entry-point group `stitch.commands`.

A command is imported when it is asked for, and a list of all reads what they are for from their source: nobody waits
for the libraries of all. Modules of commands import libraries where they use them, so that --help stays fast.
"""

import ast
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from stitch.cli.terminal import stdout_for_results

GROUP = "stitch.commands"
_CORE_COMMANDS = {
    "run": "stitch.cli.run:run",
    "check": "stitch.cli.check:check",
    "compare": "stitch.cli.compare:compare_run",
    "diagnose": "stitch.cli.diagnose:diagnose_run",
    "add": "stitch.cli.change:add",
    "drop": "stitch.cli.change:drop",
    "note": "stitch.cli.note:note",
    "next": "stitch.cli.next_view:next_measurement",
    "effects": "stitch.cli.effects:effects",
    "report": "stitch.cli.report:report",
}
# In the order of use; the others follow by name.
_ORDER = (
    *("init", "detect", "run", "check", "compare", "diagnose", "add", "drop", "note", "next", "plan", "measure"),
    *("verify", "explain", "effects", "report", "watch", "batch", "import", "export", "calibrate"),
)


class Commands(Mapping[str, Any]):
    """Name to command, loaded at first use."""

    def __init__(self) -> None:
        """List the commands of the core and of installed packages, in `_ORDER`, then by name.

        A package that offers a command of the same name replaces it.
        """
        core = [EntryPoint(name, place, GROUP) for name, place in _CORE_COMMANDS.items()]
        entries = {entry.name: entry for entry in (*core, *entry_points(group=GROUP))}
        first = [name for name in _ORDER if name in entries]
        self._entries = {name: entries[name] for name in (*first, *sorted(entries.keys() - _ORDER))}
        self._load = cache(_load_command)

    def __getitem__(self, name: str) -> Any:
        return self._load(self._entries[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def unloaded(self) -> dict[str, TyperCommand]:
        """Return all commands by name with their help text alone, for the list of commands.

        The text is read from the source; a command is loaded only if it is not found there.
        """
        texts = {name: command_help(entry) for name, entry in self._entries.items()}
        return {name: TyperCommand(name, help=text) if text else self[name] for name, text in texts.items()}


def _load_command(entry: EntryPoint) -> Any:
    """Return the click command of an entry point, a function or a `typer.Typer`, which is a group of commands.

    Commands of the core print nothing but their result on standard output; those of packages do as they like.
    """
    loaded = entry.load()
    if isinstance(loaded, typer.Typer):
        group = loaded
    else:
        group = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
        is_core = entry.value in _CORE_COMMANDS.values()
        group.command(entry.name, cls=Command)(stdout_for_results(loaded) if is_core else loaded)
    command = typer.main.get_command(group)
    command.name = entry.name
    return command


class Command(TyperCommand):
    """A command with options whose value may be left out: those with a metavar in brackets, --mesh [watertight|light].

    Such an option without one of these values means `open`.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> Any:
        """Parse the command line, with =open appended to such an option where none of its values follows."""
        values = {
            name: metavar[1:-1].split("|")
            for option in self.params
            if (metavar := option.metavar or "").startswith("[") and option.param_type_name == "option"
            for name in option.opts
        }
        given = [
            f"{arg}=open" if arg in values and after not in values[arg] else arg for arg, after in pairwise([*args, ""])
        ]
        return super().parse_args(ctx, given)


class CommandGroup(TyperGroup):
    """`stitch` with its commands."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.commands: Any = Commands()

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the list of commands without loading them, which would take long."""
        loaded, self.commands = self.commands, self.commands.unloaded()
        try:
            super().format_help(ctx, formatter)
        finally:
            self.commands = loaded

    def shell_complete(self, ctx: Any, incomplete: str) -> Any:
        """Return completions of a command's name without loading the commands: the tab key has to answer at once."""
        loaded, self.commands = self.commands, {name: TyperCommand(name) for name in self.commands}
        try:
            return super().shell_complete(ctx, incomplete)
        finally:
            self.commands = loaded


def command_help(entry: EntryPoint) -> str | None:
    """Return the help text of a command from its source, without importing it; None where none is found.

    That is the docstring of the function, or the argument `help` of a `typer.Typer(...)` that is assigned.
    """
    try:
        source = _module_source(entry.module)
        if (start := source.find(f"\ndef {entry.attr}(")) >= 0:
            # Two blank lines end the function. To parse whole modules would take a quarter of the time of the list.
            source = source[start:].partition("\n\n\n")[0]
        nodes = ast.parse(source).body
    except (OSError, SyntaxError, ValueError):
        return None
    for node in nodes:
        match node:
            case ast.FunctionDef(name=name) if name == entry.attr:
                return ast.get_docstring(node)
            case ast.Assign(targets=[ast.Name(id=name)], value=ast.Call(keywords=keywords)) if name == entry.attr:
                given = next((key.value for key in keywords if key.arg == "help"), None)
                return given.value if isinstance(given, ast.Constant) and isinstance(given.value, str) else None
    return None


def _module_source(module: str) -> str:
    """Return the source of a module inside a package, found without importing either; "" where there is none."""
    top, *inner = module.split(".")
    spec = find_spec(top)
    for folder in (spec.submodule_search_locations or ()) if spec else ():
        file = Path(folder, *inner).with_suffix(".py")
        if file.is_file():
            return file.read_text(encoding="utf-8")
    return ""
