"""A TOML file as a document, and values of its tables."""

import tomllib
from pathlib import Path
from typing import Any

from stitch.errors import InputError
from stitch.reading.text_file import read_text, shortened

# A description written by hand; the model of a run with thousands of targets is smaller too.
_LARGEST_MB = 20


def read_toml(file: Path, hint: str) -> dict[str, Any]:
    """The document of a file.

    Args:
        hint: what to do where there is no such file.

    Raises:
        InputError: the file is missing, no file, or not TOML.
    """
    told = read_text(file, hint, _LARGEST_MB)
    try:
        return tomllib.loads(told)
    except ValueError as error:  # wrong TOML, and integers of thousands of digits
        raise InputError(f"{file}: not valid TOML: {error}; to fix: correct it there") from None
    except RecursionError:
        raise InputError(f"{file}: not valid TOML: nested too deeply; to fix: write plain tables and lists") from None


def table_choice(file: Path, table: dict[str, Any], key: str, allowed: tuple[str, ...]) -> str:
    """The word at `key`, one of those allowed.

    Raises:
        InputError: another one, or none.
    """
    value = table.get(key)
    if not isinstance(value, str) or value not in allowed:
        raise InputError(f"{file}: {key} is {shortened(value)}; use {' or '.join(repr(a) for a in allowed)}")
    return str(value)


def optional_text(file: Path, table: dict[str, Any], name: str, key: str) -> str | None:
    """The text at `key` of the table that is called `name`, or None where it is absent.

    Raises:
        InputError: something else than text.
    """
    value = table.get(key)
    if value is not None and not isinstance(value, str):
        raise InputError(f"{file}: {f'{name}.' * bool(name)}{key} is {shortened(value)}; write a name in quotes")
    return value
