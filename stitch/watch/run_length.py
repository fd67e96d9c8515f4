"""How long a control chart stays silent where nothing happens: average run length, and the limit for a wanted one.

Markov chain of Brook & Evans (1972, Biometrika 59:539) for the CUSUM, of Lucas & Saccucci (1990, Technometrics 32:1)
for the EWMA; innovations standard normal.
"""

from collections.abc import Callable

import numpy as np
from scipy.special import ndtr

from stitch.frames import Array

_STATES = 121
_STEPS = 36


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


def cusum_limit(reference: float, run_length: float) -> float:
    """Limit of a CUSUM of which both sides together run so long on average."""
    return _bisect_limit(lambda limit: cusum_run_length(reference, limit) / 2, run_length, 30.0 / (1 + reference) + 10)


def ewma_limit(weight: float, run_length: float) -> float:
    """Limit of a two-sided EWMA that runs so long on average."""
    return _bisect_limit(lambda limit: ewma_run_length(weight, limit), run_length, 12 * np.sqrt(weight / (2 - weight)))


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
