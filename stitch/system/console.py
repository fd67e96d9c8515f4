"""A terminal for people: names and paths are printed as they are, brackets and colons in them are no markup."""

from typing import IO

from rich.console import Console


def console(file: IO[str] | None = None) -> Console:
    """Standard error, or another stream, without markup, emoji codes and highlighting."""
    return Console(file=file, stderr=file is None, markup=False, emoji=False, highlight=False)
