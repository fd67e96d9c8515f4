"""A TOML file as a document, and values of its tables."""

import tomllib
from pathlib import Path
from typing import Any

from stitch.errors import InputError


def read_toml(file: Path, hint: str) -> dict[str, Any]:
    """The document of a file.

    Args:
        hint: what to do where there is no such file.

    Raises:
        InputError: the file is missing or not TOML.
    """
    try:
        return tomllib.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{file}: not found; {hint}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{file}: not valid TOML: {error}") from None


def choice(file: Path, table: dict[str, Any], key: str, allowed: tuple[str, ...]) -> str:
    """The word at `key`, one of those allowed.

    Raises:
        InputError: another one, or none.
    """
    value = table.get(key)
    if value not in allowed:
        raise InputError(f"{file}: {key} is {value!r}; use {' or '.join(repr(a) for a in allowed)}")
    return str(value)


def text(file: Path, table: dict[str, Any], name: str, key: str) -> str | None:
    """The text at `key` of the table that is called `name`, or None where it is absent.

    Raises:
        InputError: something else than text.
    """
    value = table.get(key)
    if value is not None and not isinstance(value, str):
        raise InputError(f"{file}: {f'{name}.' * bool(name)}{key} is {value!r}; write a name in quotes")
    return value
