"""Whether a candidate helps where nothing was measured: at ends of joints' ranges that were left out.

A wrong effect may imitate among the measured poses what is not known, and err beyond them; left-out neighbours in
time or pose lie among the others and do not show it. All ends are judged together: one that goes wrong altogether
outweighs the rest, while each alone would refuse a true effect by chance, for there are two to a joint and the
views of one are neighbours.
"""

from dataclasses import dataclass

import numpy as np

from stitch.diagnosis.evidence import ViewEvidence
from stitch.diagnosis.heldout import share_of
from stitch.diagnosis.score import Score
from stitch.folds import JointEnd


@dataclass(frozen=True)
class Beyond:
    """What a candidate leaves at the ends, each predicted from all other views."""

    share: float  # mean square distance over that of the present model, all ends together
    sigma: float  # standard error of `share`, ends as samples
    worst: JointEnd
    worst_share: float  # the same at the end where it is largest

    @property
    def helps(self) -> bool:
        """True if the ends are predicted better, by more than a standard error."""
        return self.share <= 1 - self.sigma

    def told(self, name: str) -> str:
        """What speaks against an effect that explains much."""
        return (
            f"{name} would help among the poses that were measured, but not beyond: at ends of joints' ranges that are "
            f"left out it leaves {self.share:.2f} ± {self.sigma:.2f} of the mean square error, "
            f"{self.worst_share:.2f} in {self.worst.name}"
        )


def beyond(evidence: ViewEvidence, scored: Score) -> Beyond | None:
    """The best form of a candidate at the ends; None where the views are too few to leave one out."""
    trial = evidence.trial(np.hstack([evidence.model, scored.form.twists]))
    present = evidence.trial(evidence.model)
    ends = evidence.ends()
    if not ends:
        return None
    with_it, without = (
        np.array([t.squares(t.solve(end.views))[end.views].sum() for end in ends]) for t in (trial, present)
    )
    each = with_it / np.maximum(without, 1e-300)
    return Beyond(*share_of(with_it, without), ends[int(each.argmax())], float(each.max()))
