"""Control charts on innovations in sigmas: two CUSUMs and an EWMA a parameter, each to both sides.

The CUSUM of reference value 2 waits for a step (two sessions of 3.6 sigmas), that of 0.25 and the EWMA of weight 0.05
for what moves slowly (Page 1954, Biometrika 41:100; Roberts 1959, Technometrics 1:239; the three together as in Lucas &
Saccucci 1990, Technometrics 32:1). Innovations count as four sigmas at most: one wild session is no alarm, two may be.
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from stitch.frames import Array, Mask
from stitch.watch.run_length import cusum_limit, ewma_limit
from stitch.watch.state_bank import WILD

CUSUM_REFERENCES = (0.25, 2.0)
EWMA_WEIGHT = 0.05
CHART_NAMES = ("CUSUM 0.25", "CUSUM 2", "EWMA 0.05")
# Beside the charts: odds of a slope since the first session, for what moves from the beginning on, when no chart has
# seen the parameter still. With this probability a cell ever alarms falsely by them.
ODDS = "odds of a slope"
_EVER = 0.0025


@dataclass(frozen=True)
class Charts:
    """Of P parameters."""

    cusums: Array  # (P, 2, 2) by reference value, upwards and downwards
    ewma: Array  # (P,)

    def arrays(self) -> dict[str, Array]:
        """All of it by name, to be stored."""
        return {"cusums": self.cusums, "ewma": self.ewma}


def empty_charts(parameters: int) -> Charts:
    """Charts that begin."""
    return Charts(np.zeros((parameters, len(CUSUM_REFERENCES), 2)), np.zeros(parameters))


def extended_charts(charts: Charts, more: int) -> Charts:
    """The charts of further parameters beside them."""
    new = empty_charts(more)
    return Charts(np.concatenate([charts.cusums, new.cusums]), np.concatenate([charts.ewma, new.ewma]))


def updated_charts(charts: Charts, innovations: Array) -> Charts:
    """One session more; innovations (P,), NaN where there is none."""
    seen = np.isfinite(innovations)
    u = np.clip(np.where(seen, innovations, 0.0), -WILD, WILD)
    signed = u[:, None, None] * np.array([1.0, -1.0])
    cusums = np.maximum(charts.cusums + signed - np.array(CUSUM_REFERENCES)[:, None], 0.0)
    ewma = (1 - EWMA_WEIGHT) * charts.ewma + EWMA_WEIGHT * u
    return Charts(np.where(seen[:, None, None], cusums, charts.cusums), np.where(seen, ewma, charts.ewma))


def restarted(charts: Charts, moved: Mask) -> Charts:
    """The charts with those of some parameters (P,) at zero."""
    return replace(
        charts, cusums=np.where(moved[:, None, None], 0.0, charts.cusums), ewma=np.where(moved, 0.0, charts.ewma)
    )


@cache
def chart_limits(sessions: float, parameters: int) -> tuple[float, ...]:
    """Limit of each chart of `NAMES` so that the whole cell alarms falsely once in so many sessions.

    The rate is split evenly over charts and parameters: were they independent, rates would add up; as the charts of one
    parameter go together, the cell's rate is smaller.
    """
    own = sessions * parameters * len(CHART_NAMES)
    return (*(cusum_limit(k, own) for k in CUSUM_REFERENCES), ewma_limit(EWMA_WEIGHT, own))


def odds_limit(parameters: int) -> float:
    """Log odds of a slope from which on a parameter alarms."""
    return float(np.log(max(parameters, 1) / _EVER))


def limit_shares(charts: Charts, limit: tuple[float, ...]) -> Array:
    """(P, 3) each chart as a share of its limit; an alarm from 1 on."""
    return np.column_stack([*(charts.cusums.max(axis=2) / np.array(limit[:-1])).T, np.abs(charts.ewma) / limit[-1]])
