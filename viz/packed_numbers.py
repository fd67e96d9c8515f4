"""Arrays as text for a browser, small."""

import base64
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stitch.frames import Array

_UNKNOWN = -32768


def packed_values(values: Array) -> dict[str, Any]:
    """16 bits a value and the size of one count; what nobody knows is the smallest number."""
    known = np.isfinite(values)
    count = float(np.abs(values[known]).max(initial=0.0)) / 32000 or 1.0
    return {"count": count, "data": packed(np.where(known, np.nan_to_num(values) / count, _UNKNOWN).astype("<i2"))}


def packed_floats(numbers: Array) -> str:
    """32 bits a number."""
    return packed(numbers.astype("<f4"))


def packed(numbers: NDArray[Any]) -> str:
    """The bytes of an array, base64."""
    return base64.b64encode(np.ascontiguousarray(numbers).tobytes()).decode()
