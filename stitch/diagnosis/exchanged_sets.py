"""Sets of effects in place of others that hold the same parameters, found among the sums of all candidates at once.

An effect that was found first explains a part of what others do, and beside it these are not wanted: one by one nothing
leads away from it. At fixed variances the evidence of any set is a determinant of sums that are made once, so that sets
without it can be tried by the hundred.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np

from stitch.diagnosis import thresholds as limits
from stitch.diagnosis.candidates import Candidate, Form
from stitch.diagnosis.ranking import Ranked, conditioned_on_effects
from stitch.diagnosis.validation import group_share
from stitch.numerics.frames import Array, Indices
from stitch.numerics.parameter_selection import (
    PLAUSIBLE,
    eliminate_backward,
    log_evidence_at_scales,
    log_mixture,
    select_forward,
)
from stitch.numerics.reml import at_variances, fit_variances
from stitch.observations.linear_model import LinearModel

# Effects that are taken out at once.
_TAKEN_OUT = 2


@dataclass(frozen=True)
class _JointEvidence:
    """What the views tell of all candidates at once, beside hand-eye and effects in use, at fixed variances."""

    information: Array  # (P, P) per plausible sizes
    vector: Array  # (P,)
    columns: Sequence[Indices]  # of each candidate among the P

    def log_posterior(self, chosen: Sequence[int]) -> float:
        """Log of the evidence of some candidates together times their prior, not yet normalised."""
        index = np.concatenate([np.zeros(0, np.int64), *(self.columns[k] for k in chosen)])
        found = log_evidence_at_scales(self.information[np.ix_(index, index)], self.vector[index], PLAUSIBLE)
        return log_mixture(found, PLAUSIBLE) + len(chosen) * float(np.log(limits.PRIOR_PHYSICAL / len(self.columns)))


def exchanged_set(linear: LinearModel, candidates: Sequence[Candidate], chosen: Sequence[Ranked]) -> list[Candidate]:
    """Return effects that together are 20 to 1 likelier than those chosen, some of which they do without; else none.

    Args:
        candidates: that may take a place; of those with a time constant or an event only the chosen count.
    """
    if not chosen:
        return []
    own = {r.name: r.score.form for r in chosen}
    free = [c for c in candidates if c.name in own or not c.forms[0].term.gridded.any()]
    evidence = _joint_evidence(linear, chosen, [(own.get(c.name) or c.forms[0]) for c in free])
    now = [k for k, c in enumerate(free) if c.name in own]
    best, least = list[int](), evidence.log_posterior(now) + limits.ODDS
    for taken in (out for count in range(1, _TAKEN_OUT + 1) for out in combinations(now, count)):
        rest, others = [k for k in now if k not in taken], [k for k in range(len(free)) if k not in now]
        found = select_forward(evidence.log_posterior, others, rest, limits.MAX_JOINT_EFFECTS)
        found = eliminate_backward(evidence.log_posterior, found)
        if (value := evidence.log_posterior(found)) > least:
            best, least = found, value
    return [free[k] for k in best]


def _joint_evidence(linear: LinearModel, chosen: Sequence[Ranked], forms: Sequence[Form]) -> _JointEvidence:
    """At the scatter that is left beside the chosen effects."""
    scatter = conditioned_on_effects(linear, chosen).null.variances
    at = replace(linear, null=at_variances(linear.mixed, scatter))
    white = [at.residual(form.columns) * form.sizes for form in forms]
    ends = np.cumsum([0, *(w.shape[1] for w in white)])
    every = np.hstack(white)
    columns = [np.arange(begin, end) for begin, end in pairwise(ends)]
    return _JointEvidence(every.T @ every, every.T @ at.white_residual, columns)


def is_better_set(linear: LinearModel, new: Sequence[Ranked], old: Sequence[Ranked]) -> bool:
    """True if effects are 20 to 1 likelier than others, all variances fitted, and predict views left out better."""
    likelier = _log_posterior(linear, new) > _log_posterior(linear, old) + limits.ODDS
    shares = [group_share(linear, [r.score for r in effects])[0] for effects in (new, old)]
    return bool(likelier and shares[0] < shares[1])


def _log_posterior(linear: LinearModel, chosen: Sequence[Ranked]) -> float:
    """Return the log posterior of effects together, not yet normalised."""
    if not chosen:
        return 0.0
    G = linear.in_blocks(np.hstack([r.score.form.columns for r in chosen]))
    start = conditioned_on_effects(linear, chosen).null.variances
    fit = fit_variances(linear.mixed, G, np.concatenate([r.score.sizes for r in chosen]), start)
    prior = sum(float(np.log(limits.PRIOR_PHYSICAL / r.tests)) for r in chosen)
    return 0.5 * (linear.null.deviance - fit.deviance) + prior
