"""Whether a candidate helps where nothing was measured: at ends of joints' ranges that were left out.

A wrong effect may imitate among the measured poses what is not known, and err beyond them; left-out neighbours in
time or pose lie among the others and do not show it. It must help at all ends together, and must not make a single
one worse by more than chance, however much it helps elsewhere.
"""

from dataclasses import dataclass

import numpy as np

from stitch.diagnosis.score import Score
from stitch.diagnosis.validation.cross_validation import believed_size, share_of
from stitch.observations.linear_model import LinearModel
from stitch.statistics.folds import JointEnd
from stitch.statistics.tails import normal_limit, normal_tail


@dataclass(frozen=True)
class Extrapolation:
    """What a candidate leaves at the ends, each predicted from all other views."""

    share: float  # mean square distance over that of the present model, all ends together
    sigma: float  # standard error of `share`, ends as samples
    worst: JointEnd
    worst_share: float  # the same at the end that is made worse most clearly
    worst_sigma: float  # standard error of `worst_share`, views as samples
    count: int  # of ends
    believed: float  # `share` where the other views are not believed to know a larger effect than all views do

    @property
    def helps(self) -> bool:
        """True if the ends are predicted better by more than a standard error, and none is worse by more than chance.

        Of many ends one is worse by a standard error sooner than a single one is (Bonferroni).
        """
        chance = normal_limit(normal_tail(1.0) / self.count)
        return self.share <= 1 - self.sigma and self.worst_share <= 1 + chance * self.worst_sigma

    def objection(self, name: str) -> str:
        """What speaks against an effect that explains much."""
        return (
            f"{name} would help among the poses that were measured, but not beyond: at ends of joints' ranges that are "
            f"left out it leaves {self.share:.2f} ± {self.sigma:.2f} of the mean square error, "
            f"{self.worst_share:.2f} ± {self.worst_sigma:.2f} in {self.worst.name}"
        )


def extrapolate(linear: LinearModel, scored: Score) -> Extrapolation | None:
    """The best form of a candidate at the ends; None where the views are too few to leave one out."""
    X = np.hstack([linear.design, scored.form.response])
    trials = linear.trial(X), linear.present, linear.trial(X, None, believed_size(linear, scored))
    ends = linear.observation.ends(linear.measurement.views.joints)
    if not ends:
        return None
    squares = [[t.squares(t.solve(end.views))[end.views] for t in trials] for end in ends]
    shares = [share_of(with_it, without) for with_it, without, _ in squares]
    worst = max(range(len(ends)), key=lambda k: (shares[k][0] - 1) / max(shares[k][1], 1e-300))
    with_it, without, believed = np.array([[own.sum() for own in row] for row in squares]).T
    total = share_of(with_it, without)
    return Extrapolation(*total, ends[worst], *shares[worst], len(ends), float(believed.sum() / without.sum()))
