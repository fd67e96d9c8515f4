"""Measured values as a Q-DAS file (ASCII transfer format, DFQ).

K-fields: K0100 number of characteristics, K1001 and K1002 the part, K2001 number and K2002 name of a characteristic,
K2101 nominal, K2110 and K2111 limits, K2142 unit. In a row of values, characteristics are parted by the character SI,
and within one value, attribute (0 valid, 256 not measured) and time by DC4.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

_VALUE, _FIELD = "\x0f", "\x14"
_VALID, _MISSING = 0, 256
# Lengths and angles in units that leave digits before the point.
_SCALES = {"rad": (1e3, "mrad"), "m": (1e3, "mm")}


@dataclass(frozen=True)
class Characteristic:
    """What is measured; numbers in its unit, NaN where nobody stated one."""

    name: str
    unit: str
    nominal: float = np.nan
    lower: float = np.nan
    upper: float = np.nan


def dfq_text(
    part: str, characteristics: Sequence[Characteristic], rows: Iterable[tuple[float, Sequence[float]]]
) -> str:
    """Return the text of a DFQ file.

    Args:
        rows: per part the time, seconds since 1970, and a value for every characteristic.
    """
    scales = [_SCALES.get(c.unit, (1.0, c.unit)) for c in characteristics]
    lines = [f"K0100 {len(scales)}", "K1001 1", f"K1002 {_safe(part)}"]
    for i, (c, (scale, unit)) in enumerate(zip(characteristics, scales, strict=True), 1):
        lines += [f"K2001/{i} {i}", f"K2002/{i} {_safe(c.name)}", f"K2142/{i} {unit}"]
        limits = (("K2101", c.nominal), ("K2110", c.lower), ("K2111", c.upper))
        lines += [f"{key}/{i} {scale * x:.9g}" for key, x in limits if np.isfinite(x)]
    for time, values in rows:
        when = datetime.fromtimestamp(time, UTC).strftime("%d.%m.%Y/%H:%M:%S")
        lines.append(_VALUE.join(_entry(scale * x, when) for x, (scale, _) in zip(values, scales, strict=True)))
    return "\r\n".join([*lines, ""])


def _entry(value: float, when: str) -> str:
    measured = bool(np.isfinite(value))
    return _FIELD.join([f"{value:.9g}" if measured else "0", str(_VALID if measured else _MISSING), when])


def _safe(text: str) -> str:
    """Without what parts fields and lines."""
    return "".join(c if c.isprintable() else " " for c in text)
