"""Packages that only some files need; they come with extras of the package."""

import importlib
from pathlib import Path
from typing import Any

from stitch.errors import InputError


def import_extra(name: str, where: Path | str, extra: str) -> Any:
    """A package by its name of import.

    Args:
        where: the file, or the flag, that needs it.
        extra: with which it is installed.

    Raises:
        InputError: it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError:
        raise InputError(f"{where}: needs the package {name}; to fix: pip install 'stitch[{extra}]'") from None
