"""The history of a cell as a Q-DAS file (ASCII transfer format, DFQ): a characteristic a parameter, a row a session.

K-fields: K0100 number of characteristics, K1001 and K1002 the part, K2001 number and K2002 name of a characteristic,
K2101 nominal (the calibration in use), K2110 and K2111 limits, K2142 unit, K2022 digits. In a row of values,
characteristics are parted by the character SI, and within one value, attribute (0 valid, 256 not measured) and time by
DC4.
"""

from datetime import UTC, datetime

import numpy as np

from stitch.watch.cell_report import CellReport
from stitch.watch.history import History
from stitch.watch.stored_sessions import sessions_from

_VALUE, _FIELD = "\x0f", "\x14"
_VALID, _MISSING = 0, 256
# Lengths and angles in units that leave digits before the point.
_SCALES = {"rad": (1e3, "mrad"), "m": (1e3, "mm")}


def dfq_text(history: History, report: CellReport) -> str:
    """All sessions of a cell as the text of a DFQ file."""
    rows = history.sql("SELECT id, time FROM runs ORDER BY time, id")
    sessions = sessions_from(history, [run for run, _ in rows])
    used = history.stated("in_use")
    stated = dict(
        history.sql(
            "SELECT parameter - 1, value FROM estimates WHERE run = (SELECT id FROM runs WHERE run_hash = ?)", used
        )
    )
    scales = [_SCALES.get(p.unit, (1.0, p.unit)) for p in report.parameters]
    lines = [f"K0100 {len(scales)}", "K1001 1", f"K1002 {_dfq_text_safe(report.name)}"]
    for i, (p, (scale, unit)) in enumerate(zip(report.parameters, scales, strict=True)):
        lines += [f"K2001/{i + 1} {i + 1}", f"K2002/{i + 1} {_dfq_text_safe(p.name)}", f"K2142/{i + 1} {unit}"]
        if i in stated and np.isfinite(p.limit):
            middle = scale * stated[i]
            limits = (("K2101", middle), ("K2110", middle - scale * p.limit), ("K2111", middle + scale * p.limit))
            lines += [f"{key}/{i + 1} {x:.9g}" for key, x in limits]
    factors = np.array([scale for scale, _ in scales])
    for (_, time), values in zip(rows, sessions.values * factors, strict=True):
        when = datetime.fromtimestamp(time, UTC).strftime("%d.%m.%Y/%H:%M:%S")
        lines.append(_VALUE.join(_dfq_entry(x, when) for x in values))
    return "\r\n".join([*lines, ""])


def _dfq_entry(value: float, when: str) -> str:
    measured = bool(np.isfinite(value))
    return _FIELD.join([f"{value:.9g}" if measured else "0", str(_VALID if measured else _MISSING), when])


def _dfq_text_safe(text: str) -> str:
    """Without what parts fields and lines."""
    return "".join(c if c.isprintable() else " " for c in text)
