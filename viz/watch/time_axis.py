"""Round numbers for axes: of values, and of times."""

from datetime import UTC, datetime

import numpy as np

_ROUND = (1.0, 2.0, 2.5, 5.0, 10.0)
# Seconds between marks of time, and how they are written.
_TIMES = (
    (3600.0, "%H:%M"),
    (3 * 3600.0, "%H:%M"),
    (6 * 3600.0, "%d %b %H:%M"),
    (86400.0, "%d %b"),
    (2 * 86400.0, "%d %b"),
    (7 * 86400.0, "%d %b"),
    (14 * 86400.0, "%d %b"),
    (28 * 86400.0, "%d %b"),
    (91 * 86400.0, "%b %Y"),
    (365 * 86400.0, "%Y"),
)


def value_marks(low: float, high: float, most: int = 4) -> list[tuple[float, str]]:
    """Round values between two, with their texts."""
    rough = (high - low) / most
    if not np.isfinite(rough) or rough <= 0:
        return [(low, f"{low:.4g}")]
    power = 10.0 ** np.floor(np.log10(rough))
    step = next(power * r for r in _ROUND if power * r >= rough)
    marks = step * np.arange(np.ceil(low / step), np.floor(high / step) + 1)
    digits = max(0, int(-np.floor(np.log10(step) + 1e-9)) + (step / power == 2.5))
    big = max(abs(low), abs(high)) >= 1e5 or step < 1e-4
    return [(float(x), f"{x:.4g}" if big else f"{x + 0.0:.{digits}f}") for x in marks]


def time_marks(first: float, last: float, most: int = 5) -> list[tuple[float, str]]:
    """Round times (s since 1970, UTC) between two, with their texts."""
    step, form = next(((s, f) for s, f in _TIMES if (last - first) / s <= most), _TIMES[-1])
    marks = step * np.arange(np.ceil(first / step), np.floor(last / step) + 1)
    return [(float(t), datetime.fromtimestamp(t, UTC).strftime(form)) for t in marks]
