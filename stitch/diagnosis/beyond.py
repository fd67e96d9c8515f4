"""Whether a candidate helps where nothing was measured: at an end of a joint's range that was left out.

A wrong effect may imitate among the measured poses what is not known, and err beyond them; left-out neighbours in
time or pose lie among the others and do not show it.
"""

from dataclasses import dataclass

import numpy as np

from stitch.diagnosis.evidence import ViewEvidence
from stitch.diagnosis.heldout import share_of
from stitch.diagnosis.score import Score
from stitch.folds import JointEnd


@dataclass(frozen=True)
class Beyond:
    """What a candidate leaves at one end, predicted from all other views."""

    end: JointEnd
    share: float  # mean square distance over that of the present model
    sigma: float  # standard error of `share`, views as samples

    @property
    def worse(self) -> bool:
        """True if the candidate errs there by more than chance."""
        return self.share > 1 + self.sigma


def errs_beyond(evidence: ViewEvidence, scored: Score) -> Beyond | None:
    """The end that the best form of a candidate makes worse by most; None where it makes none worse."""
    trial = evidence.trial(np.hstack([evidence.model, scored.form.twists]))
    present = evidence.trial(evidence.model)
    found = []
    for end in evidence.ends():
        found.append(Beyond(end, *share_of(*(t.squares(t.solve(end.views))[end.views] for t in (trial, present)))))
    return max((beyond for beyond in found if beyond.worse), key=lambda beyond: beyond.share, default=None)
