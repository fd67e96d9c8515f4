"""JSON without NaN, written whole or not at all."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from stitch.system.whole_file import whole_file


def write_json(document: Any, path: Path) -> None:
    """Write JSON whole or not at all; what is not known is null."""
    with whole_file(path) as file:
        file.write_text(to_json(document) + "\n", encoding="utf-8")


def to_json(document: Any) -> str:
    """JSON text; JSON has no NaN and no infinity: what is not known is null."""
    return json.dumps(_without_nan(document), indent=1, allow_nan=False)


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_nan(item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def rows_of_fields(items: Iterable[Any], fields: str) -> list[dict[str, Any]]:
    """One row an item with some of its fields, arrays and tuples as lists."""
    return [{name: _plain(getattr(item, name)) for name in fields.split()} for item in items]


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    return list(value) if isinstance(value, tuple) else value
