"""What happened to a parameter: its alarms with kind, size and onset, as all sessions since tell them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.watch.catch_up import stored_alarms
from stitch.watch.follow import Alarm, Sessions
from stitch.watch.history import History
from stitch.watch.onset import Onset, find_onset
from stitch.watch.stored_sessions import sessions_from

# Sessions before and after an onset that tell what began there.
_AROUND = 300


@dataclass(frozen=True)
class Change:
    """One event of one parameter."""

    parameter: int
    since: int  # id of the first session that has moved
    raised: int  # id of the session with which it was seen
    kind: str  # step | drift
    channel: str | None  # beside which channel it moves; None: at once, or with time
    size: float  # of a step; of a drift per day, or per unit of the channel
    sigma: float
    p_value: float
    chart: str


def find_changes(history: History) -> list[Change]:
    """All events in the order in which they were raised; a drift that goes on is one."""
    alarms, out = stored_alarms(history), list[Change]()
    order = {run: k for k, (run,) in enumerate(history.sql("SELECT id FROM runs ORDER BY time, id"))}
    for parameter in sorted({a.parameter for a in alarms}):
        own = sorted((a for a in alarms if a.parameter == parameter), key=lambda a: order[a.raised])
        drifting = False
        for i in range(len(own)):
            found = _assess_change(history, own, i, order, drifting)
            if not (drifting and found.kind == "drift"):
                out.append(found)
            drifting = found.kind == "drift"
    return sorted(out, key=lambda c: (order[c.raised], c.parameter))


def _assess_change(history: History, own: Sequence[Alarm], i: int, order: dict[int, int], drifting: bool) -> Change:
    """Judged from the event before until the next was seen.

    Args:
        drifting: it moved steadily before; what comes on top is asked for.
    """
    alarm, at = own[i], order[own[i].onset]
    begin = max(order[own[i - 1].onset] if i else 0, at - _AROUND)
    end = min(order[own[i + 1].raised] if i + 1 < len(own) else len(order), max(at + _AROUND, order[alarm.raised] + 1))
    runs = list(order)[begin:end]
    found = _find_alarm_onset(sessions_from(history, runs), alarm.parameter, drifting)
    shape = "step" if found is None else found.shape
    return Change(
        parameter=alarm.parameter,
        since=alarm.onset if found is None else runs[found.session],
        raised=alarm.raised,
        kind="step" if shape == "step" else "drift",
        channel=None if shape in ("step", "drift") else shape,
        size=np.nan if found is None else found.size,
        sigma=np.nan if found is None else found.sigma,
        p_value=np.nan if found is None else found.p_value,
        chart=alarm.chart,
    )


def _find_alarm_onset(sessions: Sessions, parameter: int, drifting: bool) -> Onset | None:
    base = [sessions.covariates, sessions.days[:, None]] if drifting else [sessions.covariates]
    values = sessions.values[:, parameter]
    if np.isfinite(values).sum() < 3:
        return None
    return find_onset(
        values=values,
        sigmas=sessions.sigmas[:, parameter],
        days=sessions.days,
        covariates=np.hstack(base),
        channels=sessions.channels,
    )
