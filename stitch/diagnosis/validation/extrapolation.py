"""Whether a candidate helps where nothing was measured: at ends of joints' ranges that were left out.

A wrong effect may imitate among the measured poses what is not known, and err beyond them; left-out neighbours in
time or pose lie among the others and do not show it. The ends judge together. Where more than one thing is missing, a
right effect takes away what hid another at some end and makes that one a little worse; an imitation helps at many ends
and is far off at others. So a further end must be likely to become better, the ends being samples of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.diagnosis.score import Score
from stitch.diagnosis.thresholds import MAX_REMAINING_SHARE
from stitch.frames import Array
from stitch.observations.linear_model import LinearModel
from stitch.observations.response import CoefficientPrior
from stitch.statistics.folds import JointEnd
from stitch.statistics.shares import mean_square_share
from stitch.statistics.tails import normal_tail

# Odds of three to one that an end of which nobody knows would be predicted better.
_LIKELY_SHARE = 0.75
# Of Student's t, and a prior so wide that all views find what they can see.
_FREEDOM, _WIDE = 4.0, 10.0


@dataclass(frozen=True)
class Extrapolation:
    """What a candidate leaves at the ends, each predicted from all other views."""

    share: float  # mean square distance over that of the present model, all ends together
    sigma: float  # standard error of `share`, ends as samples
    worst: JointEnd
    worst_share: float  # the same at the end that is made worse most clearly
    worst_sigma: float  # standard error of `worst_share`, views as samples
    likely: float  # probability that a further end is predicted better

    @property
    def helps(self) -> bool:
        """True if the ends together are predicted better by more than a standard error, and a further one probably."""
        return self.share <= 1 - self.sigma and self.likely >= _LIKELY_SHARE

    @property
    def errs_somewhere(self) -> bool:
        """True if an end is predicted worse by more than a standard error."""
        return self.worst_share > 1 + self.worst_sigma

    @property
    def unseen(self) -> bool:
        """True if the ends together are as well predicted with the effect as without."""
        return MAX_REMAINING_SHARE <= self.share <= 1 / MAX_REMAINING_SHARE

    def rejection_reason(self, name: str) -> str:
        """What speaks against an effect that explains much."""
        return (
            f"{name} would help among the poses that were measured, but not beyond: at ends of joints' ranges that are "
            f"left out it leaves {self.share:.2f} ± {self.sigma:.2f} of the mean square error, "
            f"{self.worst_share:.2f} ± {self.worst_sigma:.2f} in {self.worst.name}; a further end would become better "
            f"with a probability of {self.likely:.0%}"
        )


def untested_ends_reason(names: Sequence[str]) -> str:
    """What speaks against effects of which the ends together tell nothing."""
    return (
        f"{', '.join(names[:-1])} and {names[-1]} would help among the poses that were measured, but not beyond: ends "
        f"of joints' ranges that are left out change by less than {1 - MAX_REMAINING_SHARE:.0%} together, for better or worse"
    )


def extrapolate(linear: LinearModel, scored: Score) -> Extrapolation | None:
    """The best form of a candidate at the ends; None where the views are too few to leave one out."""
    ends = linear.observation.joint_ends(linear.measurement.views.joints)
    if not ends:
        return None
    a, X = linear.design.shape[1], np.hstack([linear.design, scored.form.response])
    prior = _student_prior(linear, X, np.append(linear.sizes, scored.sizes))
    trials = (
        linear.trial(X, None, prior),
        linear.trial(X[:, :a], None, CoefficientPrior(prior.precision[:a], prior.mean[:a])),
    )
    squares = [[t.squares(t.solve(end.views))[end.views] for t in trials] for end in ends]
    shares = [mean_square_share(with_it, without) for with_it, without in squares]
    worst = max(range(len(ends)), key=lambda k: (shares[k][0] - 1) / max(shares[k][1], 1e-300))
    total = mean_square_share(*np.array([[own.sum() for own in row] for row in squares]).T)
    logs = np.log([max(share, 1e-300) for share, _ in shares])
    spread = np.std(logs, ddof=1) * np.sqrt(1 + 1 / len(logs)) if len(logs) > 1 else 0.0
    likely = normal_tail(float(np.mean(logs) / max(spread, 1e-12)))
    return Extrapolation(*total, ends[worst], *shares[worst], likely)


def _student_prior(linear: LinearModel, X: Array, sizes: Array) -> CoefficientPrior:
    """A prior of the parameters' plausible sizes with the tails of Student's t, for fits that lack an end.

    What the other views hardly see would otherwise be anything, and the end would judge that instead of the effect. The
    normal prior that stands for t with ν degrees of freedom at an estimate θ has the variance (ν·s² + θ²)/(ν + 1)
    (Lange, Little & Taylor 1989, J. Am. Stat. Assoc. 84:881).
    """
    middle = np.append(-linear.values, np.zeros(len(sizes) - len(linear.values)))
    free = 1 / (_WIDE * sizes) ** 2
    found = linear.trial(X, None, CoefficientPrior(free, middle)).solve() - middle
    known = np.where(np.isfinite(sizes), found, 0.0)
    return CoefficientPrior((_FREEDOM + 1) / (_FREEDOM * sizes**2 + known**2), middle)
