"""Two effects that are both missing: each of them is asked for beside the other."""

from collections.abc import Sequence

from stitch.diagnosis.candidates import Candidate
from stitch.diagnosis.selection.ranking import Ranked, certain, conditioned, contends, ranked_all, ranked_one
from stitch.diagnosis.thresholds import ODDS
from stitch.observations.linear_model import LinearModel


def second_beside(linear: LinearModel, candidates: Sequence[Candidate], best: Ranked) -> Ranked | None:
    """The effect that explains most beside the best one, if it is certain."""
    others = [c for c in candidates if c.name != best.name and not c.empirical]
    ranked, _ = ranked_all(conditioned(linear, [best]), others)
    return next((r for r in ranked if certain(r)), None)


def both_missing(linear: LinearModel, candidates: Sequence[Candidate], best: Ranked) -> tuple[Ranked, Ranked] | None:
    """Two effects where one alone took for itself what both do, each scored beside the other.

    Each must be certain beside the other, and beside the second no other may come near the first.
    """
    second = second_beside(linear, candidates, best)
    if second is None:
        return None
    others = [c for c in candidates if c.name != second.name and not c.empirical]
    first, *rest = ranked_all(conditioned(linear, [second]), others)[0]
    if not certain(first) or any(contends(r) and r.log_posterior > first.log_posterior - ODDS for r in rest):
        return None
    again = ranked_one(conditioned(linear, [first]), second.score.candidate, tests=len(others))
    return (first, again) if certain(again) else None


def beside_each_other(linear: LinearModel, first: Ranked, second: Ranked, tests: int) -> tuple[Ranked, Ranked]:
    """Two effects, each scored beside the other.

    Args:
        tests: candidates among which they were chosen.
    """
    of_first = ranked_one(conditioned(linear, [second]), first.score.candidate, tests)
    return of_first, ranked_one(conditioned(linear, [first]), second.score.candidate, tests)
