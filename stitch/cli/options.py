"""Options that several commands share."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from stitch.errors import InputError

EffectsFile = Annotated[
    Path | None, typer.Option("--effects-file", metavar="PY", help="Python file with effects of your own; it is run.")
]
Trust = Annotated[bool, typer.Option("--trust", help="Run the Python file of effects that the model names.")]
Force = Annotated[bool, typer.Option("--force", help="Replace the run of another session.")]
Tolerance = Annotated[
    float | None, typer.Option("--tolerance", help="Within which the views have to agree on the part, length_unit.")
]
Memory = Annotated[
    str | None, typer.Option("--memory", metavar="SIZE", help="Stay below so much, such as 2GB; default: no limit.")
]
RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="Folder that `stitch run` wrote.")]
Json = Annotated[bool, typer.Option("--json", help="Print the JSON result alone on standard output.")]


def complete_effect(incomplete: str) -> list[str]:
    """Return completions for the tab key of a shell: the text with its last, unfinished name of an effect completed."""
    from stitch.effects.contract import EFFECTS

    before, comma, begun = incomplete.rpartition(",")
    return [f"{before}{comma}{name}" for name in EFFECTS if name.startswith(begun)]


def completes(*names: str) -> Callable[[str], list[str]]:
    """Return what ends a word that begins as one of these names do, for the tab key of a shell."""
    return lambda incomplete: [name for name in names if name.startswith(incomplete)]


def split_names(text: str | None) -> tuple[str, ...]:
    """Return what a list with commas names, empty places too."""
    return tuple(name.strip() for name in text.split(",")) if text else ()


def require_new(file: Path | None) -> None:
    """Refuse a file that exists, also as a link that leads nowhere, or whose folder does not exist; None passes.

    Raises:
        InputError: says which of the two.
    """
    if file is not None and (file.exists() or file.is_symlink()):
        raise InputError(f"{file}: exists already; to fix: name another file, or remove it")
    if file is not None and not file.parent.is_dir():
        raise InputError(f"{file}: there is no folder {file.parent}; to fix: make it, or name another")


def require_tolerance(tolerance: float | None) -> None:
    """Refuse a tolerance, in length_unit, that is not positive and finite; None, not stated, passes.

    Raises:
        InputError: it is such a number.
    """
    if tolerance is not None and not 0 < tolerance < float("inf"):
        raise InputError(f"--tolerance {tolerance:g}: to fix: give a length above zero, in the session's length_unit")


def bytes_of(size: str | None, option: str = "--memory") -> float | None:
    """Return a size such as 2GB in bytes, with decimal units (1 KB = 1000 bytes); None for None.

    Args:
        option: name of the option, for the message.

    Raises:
        InputError: not a size.
    """
    if size is None:
        return None
    parts = re.fullmatch(r"([0-9.]+) *([KMGT])i?B?", size.strip(), re.IGNORECASE)
    try:
        count = float(parts[1]) * 1e3 ** (1 + "KMGT".index(parts[2].upper())) if parts else float(size)
    except ValueError:
        count = float("nan")
    if not 0 < count < float("inf"):
        raise InputError(f"{option} {size}: to fix: give a size such as 2GB or 800MB")
    return count
