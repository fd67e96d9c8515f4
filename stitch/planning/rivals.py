"""From which size on planned views would tell one effect from another, pair by pair.

Two effects are told apart by what of one's pattern the other cannot imitate, λ in units of the scatter; it grows with
the square of the size. The other may take all its parameters, each up to about ten times its plausible size.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.diagnosis.candidates import Candidate
from stitch.diagnosis.score import form_weights
from stitch.diagnosis.thresholds import SEPARATION_LAMBDA
from stitch.frames import Array
from stitch.observations.linear_model import LinearModel

# Precision of ten plausible sizes.
RIDGE = 0.01


@dataclass(frozen=True)
class EffectPair:
    """Two effects, and the multiple of its usual size from which each is told from the other."""

    a: str
    b: str
    size_a: float  # of a, told from b; infinite where no size is
    size_b: float

    @property
    def size(self) -> float:
        """The larger of the two."""
        return max(self.size_a, self.size_b)


def effect_pairs(linear: LinearModel, candidates: Sequence[Candidate]) -> list[EffectPair]:
    """All pairs of some candidates, hardest first."""
    out = []
    for i, a in enumerate(candidates):
        for b in candidates[i + 1 :]:
            base = linear.without([a.name, b.name])
            out.append(EffectPair(a.name, b.name, identifiable_size(base, a, b), identifiable_size(base, b, a)))
    return sorted(out, key=lambda pair: -pair.size)


def identifiable_size(base: LinearModel, own: Candidate, rival: Candidate) -> float:
    """Multiple of the usual size from which `own` is told from `rival`: median over the forms it may have.

    Args:
        base: neither of the two is among its pose errors.
    """
    whole = [form for form in rival.forms if form.keep.sum() == rival.forms[0].keep.sum()]
    imitations = [base.residual(form.columns) * form.sizes for form in whole]
    sizes = []
    for form in own.forms:
        pattern = base.residual(form.columns) * form.sizes
        apart = min(separation(pattern, X) for X in imitations)
        sizes.append(float(np.sqrt(SEPARATION_LAMBDA / apart)) if apart > 0 else float("inf"))
    return _median(np.array(sizes), form_weights(own))


def separation(pattern: Array, rival: Array) -> float:
    """λ: squared length of what columns (n, p) of a pattern keep when a rival's (n, q) imitate it."""
    left = pattern - rival @ np.linalg.solve(rival.T @ rival + RIDGE * np.eye(rival.shape[1]), rival.T @ pattern)
    return float(np.sum(pattern * left))


def _median(values: Array, weights: Array) -> float:
    order = np.argsort(values)
    share = np.cumsum(weights[order]) / weights.sum()
    return float(values[order][np.searchsorted(share, 0.5)])
