"""A cell's job file: its format, and checks of tables, words, numbers and file names."""

import math
import reprlib
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from stitch.errors import InputError
from stitch.frames import Array
from stitch.reading.toml_file import read_toml

# No length, angle or sigma of a cell lies outside; beyond, squares overflow or vanish.
LOWEST_VALUE, HIGHEST_VALUE = 1e-12, 1e9


def read_job_file(file: Path, expected_format: str, known: set[str], example: str) -> dict[str, Any]:
    """The document of a job file.

    Args:
        expected_format: the format it must state, such as "stitch-drill/1".
        known: the keys of its top level.
        example: where a job of that format lies.

    Raises:
        InputError: it is missing, not TOML, of another format, or holds an unknown key.
    """
    document = read_toml(file, f"see {example} for how it looks")
    if document.get("format") != expected_format:
        raise InputError(f'{file}: format is {document.get("format")!r}; expected "{expected_format}"')
    check_keys(file, "", document, known)
    return document


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
            hint = f"did you mean {close[0]!r}?" if close else f"known are {', '.join(sorted(known))}"
            raise InputError(f"{file}: unknown key {f'{place}.{key}' if place else key!r}; {hint}")


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
    if abs(value) > HIGHEST_VALUE:
        raise InputError(f"{file}: {place} is {value!r}; nothing in a cell is that large")
    if positive and value < LOWEST_VALUE:
        raise InputError(f"{file}: {place} is {value!r}; it must be above zero")
    return float(value)


def vectors(file: Path, place: str, value: Any, shape: tuple[int, ...], form: str) -> Array:
    """Finite numbers of a shape, such as (3,) for [x, y, z].

    Args:
        form: how to write them, for the message.

    Raises:
        InputError: another shape, or something that is no finite number.
    """
    for number in _flat(file, place, value, shape, form):
        finite(file, place, number)
    return np.array(value, float)


def _flat(file: Path, place: str, value: Any, shape: tuple[int, ...], form: str) -> list[Any]:
    """The entries of nested lists of a shape, row by row."""
    if not shape:
        return [value]
    if not isinstance(value, list) or len(value) != shape[0]:
        raise InputError(f"{file}: {place} is {reprlib.repr(value)}; write {form}")
    return [entry for part in value for entry in _flat(file, place, part, shape[1:], form)]


def resolve_file(file: Path, place: str, value: Any) -> Path:
    """A file that a job names relative to itself.

    Raises:
        InputError: no name in quotes.
    """
    if not isinstance(value, str):
        raise InputError(f"{file}: {place} is {value!r}; name a file in quotes")
    return file.parent / value
