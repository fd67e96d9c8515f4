"""A scanner that errs by where in its field a point is seen, by no law of the library.

Axes of unequal scale or not at right angles, a plane of focus that is bent to one side: the same in every view, so that
overlaps show it, and joints, mount or time only seem to have a part in it.
"""

from collections.abc import Sequence

from stitch.diagnosis.selection.ranking import Ranked
from stitch.diagnosis.thresholds import ALPHA_UNKNOWN, ODDS
from stitch.diagnosis.unknown.unnamed_errors import RepeatingError
from stitch.effects.empirical import FIELD


def follows_field(empirical: Sequence[Ranked], unnamed: Sequence[RepeatingError]) -> bool:
    """True if the field is the likeliest of all shapes without a cause, 20 to 1 over errors of poses that repeat.

    Args:
        empirical: best first.
        unnamed: what poses do again without a name; both are over scatter and what an arm usually errs by.
    """
    best = next(iter(empirical), None)
    if best is None or best.name != FIELD or best.adjusted >= ALPHA_UNKNOWN:
        return False
    others = [r.score.log_bayes_factor for r in empirical[1:2]] + [u.log_bayes_factor for u in unnamed]
    return bool(best.score.log_bayes_factor > max([0.0, *others]) + ODDS)
