"""Two effects that are both missing: each of them is asked for beside the other."""

from collections.abc import Sequence

from stitch.diagnosis.candidates import Candidate
from stitch.diagnosis.selection.ranking import (
    Ranked,
    conditioned_on_effects,
    is_certain,
    is_contender,
    rank_all,
    rank_one,
)
from stitch.diagnosis.thresholds import ODDS
from stitch.observations.linear_model import LinearModel


def find_second_effect(linear: LinearModel, candidates: Sequence[Candidate], best: Ranked) -> Ranked | None:
    """The effect that explains most beside the best one, if it is certain."""
    others = [c for c in candidates if c.name != best.name and not c.empirical]
    ranked, _ = rank_all(conditioned_on_effects(linear, [best]), others)
    return next((r for r in ranked if is_certain(r)), None)


def find_missing_pair(
    linear: LinearModel, candidates: Sequence[Candidate], best: Ranked
) -> tuple[Ranked, Ranked] | None:
    """Two effects where one alone took for itself what both do, each scored beside the other.

    Each must be certain beside the other, and beside the second no other may come near the first.
    """
    second = find_second_effect(linear, candidates, best)
    if second is None:
        return None
    others = [c for c in candidates if c.name != second.name and not c.empirical]
    first, *rest = rank_all(conditioned_on_effects(linear, [second]), others)[0]
    if not is_certain(first) or any(is_contender(r) and r.log_posterior > first.log_posterior - ODDS for r in rest):
        return None
    again = rank_one(conditioned_on_effects(linear, [first]), second.score.candidate, tests=len(others))
    return (first, again) if is_certain(again) else None


def score_pair(linear: LinearModel, first: Ranked, second: Ranked, tests: int) -> tuple[Ranked, Ranked]:
    """Two effects, each scored beside the other.

    Args:
        tests: candidates among which they were chosen.
    """
    of_first = rank_one(conditioned_on_effects(linear, [second]), first.score.candidate, tests)
    return of_first, rank_one(conditioned_on_effects(linear, [first]), second.score.candidate, tests)
