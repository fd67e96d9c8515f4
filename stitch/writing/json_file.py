"""JSON without NaN, written whole or not at all."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from stitch.system.whole_file import whole


def write_json(document: Any, path: Path) -> None:
    """Write JSON whole or not at all; what is not known is null."""
    with whole(path) as file:
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
