"""Checks of tables and numbers that the cells' TOML files share."""

import math
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from stitch.errors import InputError

# No length, angle or sigma of a cell lies outside; beyond, squares overflow or vanish.
SMALLEST, LARGEST = 1e-12, 1e9


def table(file: Path, document: dict[str, Any], name: str) -> dict[str, Any]:
    """A required table of a document.

    Raises:
        InputError: it is missing or not a table.
    """
    entry = document.get(name)
    if not isinstance(entry, dict):
        raise InputError(f"{file}: [{name}] is missing")
    return entry


def check_keys(file: Path, place: str, entries: Any, known: set[str]) -> None:
    """Refuse a key that nobody reads: most are misspelt.

    Raises:
        InputError: `entries` is not a table or holds an unknown key.
    """
    if not isinstance(entries, dict):
        raise InputError(f"{file}: {place} must be a table")
    for key in entries:
        if key not in known:
            close = get_close_matches(key, known, 1)
            mend = f"did you mean {close[0]!r}?" if close else f"known are {', '.join(sorted(known))}"
            raise InputError(f"{file}: unknown key {f'{place}.{key}' if place else key!r}; {mend}")


def choice(file: Path, place: str, value: Any, known: tuple[str, ...]) -> str:
    """One of some words.

    Raises:
        InputError: it is none.
    """
    if not isinstance(value, str) or value not in known:
        raise InputError(f"{file}: {place} is {value!r}; write one of {', '.join(known)}")
    return value


def finite(file: Path, place: str, value: Any, positive: bool = False) -> float:
    """A finite number, above zero if `positive`.

    Raises:
        InputError: it is none.
    """
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{file}: {place} is {value!r}; write a finite number")
    if abs(value) > LARGEST:
        raise InputError(f"{file}: {place} is {value!r}; nothing in a cell is that large")
    if positive and value < SMALLEST:
        raise InputError(f"{file}: {place} is {value!r}; it must be above zero")
    return float(value)
