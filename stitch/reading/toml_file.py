"""A TOML file as a document."""

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
