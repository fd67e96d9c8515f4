"""Sparse regression over a dictionary: chosen in one half of the views, tested in the other.

In one half ingredients are added greedily (orthogonal matching pursuit), after the first as long as the next one
explains more than the best of all of them would by chance. The other half, which took no part in that, then says if the
same sum of ingredients is wanted there: a test beside everything else that poses may err by, and how much likelier its
numbers are with the sizes that the first half found. Halves change roles, and all ways are counted.

What follows time, or what moves with time, is asked for in the first and the second half of the session: errors that
wander look the same in views that are neighbours in time. What follows the arm is asked for in views taken alternately.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.diagnosis.thresholds import ODDS
from stitch.diagnosis.validation.halves import explained_beside
from stitch.frames import Array, Indices, Mask
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.surface_model import Surfaces
from stitch.statistics.least_squares import column_space
from stitch.statistics.tails import chi2_limit, chi2_tail
from stitch.statistics.variance_components import at_variances

_AT_MOST = 4  # addends
_CHANCE = 0.05  # that an addend which is none is added, all of them counted
_REJECTED = 0.01
_WAYS = 4  # two dictionaries, two directions
_BLOCKS = 16  # of neighbours in time, for views that share a wandering error which no prior knows
# A prior of this many sizes as they come out keeps what a half does not see finite.
_WIDE = 10.0
_FAINT = 1e-6


@dataclass(frozen=True)
class Chosen:
    """Ingredients by their number in the dictionary, and how they stood the test."""

    numbers: tuple[int, ...]
    p_value: float  # in the half that took no part in choosing, all ways counted
    log_bayes_factor: float  # of that half's numbers with the sizes of the other over none

    @property
    def holds(self) -> bool:
        """True if the half that took no part wants it."""
        return self.p_value < _REJECTED and self.log_bayes_factor > ODDS


def search(linear: LinearModel, responses: Array, slow: Mask) -> Chosen | None:
    """The sum of columns (·, M) that explains most and stands its test best; None where no half suggests any.

    Args:
        slow: (M,) what follows time or what moves with it: views near in time share it, and wandering errors too.
    """
    columns, found = linear.reduce(responses), list[Chosen]()
    for among, halves in ((~slow, _alternate(linear)), (slow, np.array_split(np.arange(_views(linear)), 2))):
        at = np.flatnonzero(among)
        for way in (halves, halves[::-1]):
            own = _one_way(linear, columns[:, at], bool(slow[at].any()), *way) if len(at) else None
            if own is not None:
                found.append(replace(own, numbers=tuple(int(at[k]) for k in own.numbers)))
    return min(found, key=lambda c: (not c.holds, c.p_value)) if found else None


def _views(linear: LinearModel) -> int:
    return linear.measurement.views.count


def _alternate(linear: LinearModel) -> list[Indices]:
    """Two halves over the same region of poses: view by view, or in blocks of time."""
    blocks = _views(linear) if isinstance(linear.observation, Surfaces) else min(_BLOCKS, _views(linear))
    block = np.arange(_views(linear)) * blocks // _views(linear)
    return [np.flatnonzero(block % 2 == k) for k in (0, 1)]


def _one_way(linear: LinearModel, columns: Array, slow: bool, chosen_in: Indices, tested_in: Indices) -> Chosen | None:
    plain = linear.scatter_only
    seen, z = _of_half(plain, columns, chosen_in, tested_in)
    numbers = _pursued(seen, z)
    if not numbers:
        return None
    own = columns[:, numbers]
    sizes = _WIDE * np.abs(np.linalg.lstsq(seen[:, numbers], z, rcond=None)[0]) + _FAINT
    base = linear
    if not slow:
        # Under the scatter that is left beside it: what it explains is no scatter. What wanders in time stays.
        beside = linear.conditioned_on(own, sizes)
        base = replace(linear, null=at_variances(linear.mixed, beside.null.variances))
    (A, y), (B, w) = _of_half(base, own, chosen_in, tested_in), _of_half(base, own, tested_in, chosen_in)
    told = np.linalg.pinv(B.T @ B, rcond=1e-12, hermitian=True)
    square = float((B.T @ w) @ told @ (B.T @ w))
    mean = np.asarray(np.linalg.lstsq(A, y, rcond=None)[0], float)
    factor = _predicted(A.T @ A + np.diag(sizes**-2.0), mean, B, w)
    return Chosen(tuple(numbers), min(1.0, _WAYS * chi2_tail(square, len(numbers))), factor)


def _of_half(base: LinearModel, columns: Array, keep: Indices, out: Indices) -> tuple[Array, Array]:
    """Whitened columns (n, k) and numbers (n,) of some views, without what the model explains there."""
    white, z = base.whiten(columns), base.white_z
    if isinstance(base.observation, Surfaces):
        U = explained_beside(base, base.observation, out)
    else:
        rows = base.mixed.z.shape[1]
        at = (keep[:, None] * rows + np.arange(rows)).ravel()
        U, white, z = column_space(base.white_design[at]), white[at], z[at]
    return white - U @ (U.T @ white), z - U @ (U.T @ z)


def _pursued(seen: Array, z: Array) -> list[int]:
    """Columns whose sum explains z, each after the first beyond what the best of all would by chance."""
    strength = np.linalg.norm(seen, axis=0)
    unit = seen / np.maximum(strength, 1e-300)
    # What lies almost wholly in what the model explains would be blown up.
    usable = strength > _FAINT * strength.max(initial=0.0)
    limit = chi2_limit(_CHANCE / max(int(usable.sum()), 1), 1)
    chosen, rest = list[int](), z
    while len(chosen) < _AT_MOST:
        left = np.linalg.norm(unit, axis=0)
        gains = np.where(usable & (left > 0.1), (unit.T @ rest / np.maximum(left, 1e-300)) ** 2, 0.0)
        best = int(gains.argmax())
        # The first one is for the other half to judge.
        if gains[best] < (limit if chosen else _FAINT):
            break
        chosen.append(best)
        along = unit[:, best] / left[best]
        unit = unit - np.outer(along, along @ unit)
        rest = rest - along * (along @ rest)
    return chosen


def _predicted(precision: Array, mean: Array, B: Array, w: Array) -> float:
    """Log likelihood ratio of w for coefficients believed to be N(mean, precision⁻¹), over none."""
    information, vector = B.T @ B, B.T @ w
    both = precision + information
    pull = vector + precision @ mean
    square = pull @ np.linalg.solve(both, pull) - mean @ precision @ mean
    return float(0.5 * square - 0.5 * (np.linalg.slogdet(both)[1] - np.linalg.slogdet(precision)[1]))


def fitted(linear: LinearModel, columns: Array, numbers: Sequence[int]) -> Array:
    """(k,) coefficients of some columns (·, M) from all views, under the scatter that they leave."""
    own = linear.reduce(columns[:, list(numbers)])
    sizes = np.full(len(numbers), 1.0)
    beside = linear.conditioned_on(own, sizes)
    base = replace(linear, null=at_variances(linear.mixed, beside.null.variances))
    return np.asarray(np.linalg.lstsq(base.residual(own), base.white_residual, rcond=None)[0])
