"""Control charts on innovations in sigmas: two CUSUMs and an EWMA a parameter, each to both sides.

The CUSUM of reference value 2 waits for a step (two sessions of 3.6 sigmas), that of 0.25 and the EWMA of weight 0.05
for what moves slowly (Page 1954, Biometrika 41:100; Roberts 1959, Technometrics 1:239; the three together as in Lucas
& Saccucci 1990, Technometrics 32:1). Innovations count as four sigmas at most: one wild session is no alarm, two may
be.

Limits follow from how long a chart stays silent where nothing happens: average run lengths by the Markov chain of Brook
& Evans (1972, Biometrika 59:539) for the CUSUM, of Lucas & Saccucci for the EWMA, innovations standard normal.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.special import ndtr

from stitch.numerics.frames import Array, Mask
from stitch.plugins.watch.state_bank import WILD

# States of a Markov chain, and halvings of a bisection.
_STATES = 121
_STEPS = 36
CUSUM_REFERENCES = (0.25, 2.0)
EWMA_WEIGHT = 0.05
CHART_NAMES = ("CUSUM 0.25", "CUSUM 2", "EWMA 0.05")


@dataclass(frozen=True)
class Charts:
    """Of P parameters."""

    cusums: Array  # (P, 2, 2) by reference value, upwards and downwards
    ewma: Array  # (P,)


def empty_charts(parameters: int) -> Charts:
    """Charts that begin."""
    return Charts(np.zeros((parameters, len(CUSUM_REFERENCES), 2)), np.zeros(parameters))


def updated_charts(charts: Charts, innovations: Array) -> Charts:
    """One session more; innovations (P,), NaN where there is none."""
    is_shown = np.isfinite(innovations)
    u = np.clip(np.where(is_shown, innovations, 0.0), -WILD, WILD)
    signed = u[:, None, None] * np.array([1.0, -1.0])
    cusums = np.maximum(charts.cusums + signed - np.array(CUSUM_REFERENCES)[:, None], 0.0)
    ewma = (1 - EWMA_WEIGHT) * charts.ewma + EWMA_WEIGHT * u
    return Charts(np.where(is_shown[:, None, None], cusums, charts.cusums), np.where(is_shown, ewma, charts.ewma))


def restarted(charts: Charts, moved: Mask) -> Charts:
    """The charts with those of some parameters (P,) at zero."""
    return replace(
        charts, cusums=np.where(moved[:, None, None], 0.0, charts.cusums), ewma=np.where(moved, 0.0, charts.ewma)
    )


def limit_shares(charts: Charts, limit: tuple[float, ...]) -> Array:
    """(P, 3) each chart as a share of its limit; an alarm from 1 on."""
    return np.column_stack([*(charts.cusums.max(axis=2) / np.array(limit[:-1])).T, np.abs(charts.ewma) / limit[-1]])


@cache
def chart_limits(sessions: float, parameters: int) -> tuple[float, ...]:
    """Limit of each chart of `CHART_NAMES` so that the whole cell alarms falsely once in so many sessions.

    The rate is split evenly over charts and parameters: were they independent, rates would add up; as the charts of one
    parameter go together, the cell's rate is smaller.
    """
    run_length = sessions * parameters * len(CHART_NAMES)
    return (*(cusum_limit(k, run_length) for k in CUSUM_REFERENCES), ewma_limit(EWMA_WEIGHT, run_length))


def cusum_limit(reference: float, run_length: float) -> float:
    """Limit of a CUSUM of which both sides together run so long on average."""
    return _bisect_limit(lambda limit: cusum_run_length(reference, limit) / 2, run_length, 30.0 / (1 + reference) + 10)


def ewma_limit(weight: float, run_length: float) -> float:
    """Limit of a two-sided EWMA that runs so long on average."""
    return _bisect_limit(lambda limit: ewma_run_length(weight, limit), run_length, 12 * np.sqrt(weight / (2 - weight)))


def cusum_run_length(reference: float, limit: float, shift: float = 0.0) -> float:
    """Average run length of a one-sided CUSUM that begins at zero; innovations of mean `shift`."""
    width = 2 * limit / (2 * _STATES - 1)
    centre = width * np.arange(_STATES)
    edge = (centre + width / 2)[None, :] - centre[:, None] + reference - shift
    upper = ndtr(edge)
    # The first state takes all that would fall below zero.
    chain = np.column_stack([upper[:, 0], np.diff(upper, axis=1)])
    return _mean_exit_time(chain, 0)


def ewma_run_length(weight: float, limit: float, shift: float = 0.0) -> float:
    """Average run length of a two-sided EWMA that begins at zero; `limit` in the units of the EWMA itself."""
    width = 2 * limit / _STATES
    centre = -limit + width * (np.arange(_STATES) + 0.5)
    edges = np.append(centre - width / 2, limit)
    reached = ndtr((edges[None, :] - (1 - weight) * centre[:, None]) / weight - shift)
    return _mean_exit_time(np.diff(reached, axis=1), _STATES // 2)


def _mean_exit_time(chain: Array, start: int) -> float:
    """Mean number of steps until the chain is left."""
    return float(np.linalg.solve(np.eye(len(chain)) - chain, np.ones(len(chain)))[start])


def _bisect_limit(run_length_at: Callable[[float], float], target: float, highest: float) -> float:
    """By bisection: run lengths grow with the limit. A chain that is hardly ever left cannot be solved: too high."""
    low, high = 0.0, highest
    for _ in range(_STEPS):
        middle = (low + high) / 2
        length = run_length_at(middle)
        low, high = (middle, high) if 0 < length < target else (low, middle)
    return high
