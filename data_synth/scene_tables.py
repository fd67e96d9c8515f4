"""Values of a scene file, checked against the defaults of the dataclass that they fill."""

from dataclasses import fields
from typing import Any

import numpy as np


def read_dataclass(kind: type[Any], where: str, table: dict[str, Any]) -> Any:
    """A dataclass from a table; lists become tuples, unknown keys and values of another kind are refused.

    Raises ValueError that names the key and, for a wrong value, what one looks like.
    """
    known = {f.name: f.default for f in fields(kind)}
    for key, value in table.items():
        name = f"{where}.{key}" if where else key
        if key not in known:
            raise ValueError(f"unknown key {name}; known are {', '.join(sorted(known))}")
        if not _like(value, known[key]):
            raise ValueError(f"{name} is {value!r}; write something like {known[key]!r}")
    return kind(**{key: tuple(value) if isinstance(value, list) else value for key, value in table.items()})


def _like(value: Any, default: Any) -> bool:
    """True if the value may stand where the default does."""
    if isinstance(default, tuple):
        any_length = isinstance(default[0], int)
        fits = isinstance(value, (list, tuple)) and (any_length or len(value) == len(default))
        return fits and all(_like(x, default[0]) for x in value)
    if isinstance(default, (bool, str)):
        return isinstance(value, type(default))
    if isinstance(default, int):
        return isinstance(value, int) and not isinstance(value, bool) and value >= 0
    if isinstance(default, float):
        return isinstance(value, (int, float)) and not isinstance(value, bool) and bool(np.isfinite(value))
    return True


def take_vector(table: dict[str, Any], key: str) -> list[float]:
    """Three numbers of [scanner], taken out of the table.

    Raises ValueError for anything else.
    """
    value = table.pop(key, None)
    if not isinstance(value, list) or len(value) != 3 or not all(_like(x, 0.0) for x in value):
        raise ValueError(f"scanner.{key} is {value!r}; write three numbers")
    return value
