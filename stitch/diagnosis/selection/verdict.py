"""The verdict: which effect is named, which cannot be told apart, whether something unknown is there, or nothing."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from stitch.diagnosis.candidates import Candidate
from stitch.diagnosis.plausible_scatter import ScatterLimit, implausible
from stitch.diagnosis.selection.forward_selection import forward_selection, keep_worth_adding
from stitch.diagnosis.selection.inclusion import required_group, rescore_contenders, rescored_in
from stitch.diagnosis.selection.pairs import find_missing_pair, find_second_effect
from stitch.diagnosis.selection.ranking import (
    Ranked,
    conditioned_on_effects,
    is_certain,
    is_contender,
    rank_all,
    rescored_against,
)
from stitch.diagnosis.thresholds import (
    ALPHA_UNKNOWN,
    LOG_BAYES_FACTOR,
    MANY_VIEWS,
    ODDS,
    PRIOR_PHYSICAL,
)
from stitch.diagnosis.unknown import rivals, unnamed_courses
from stitch.diagnosis.unknown.unnamed_errors import RepeatingError, find_repeating_errors
from stitch.observations.linear_model import LinearModel

# Errors of one and two periods a turn have a name; those of three and four have not.
_GEARS, _NAMELESS_ORDERS = ("gear_eccentricity", "gear_harmonic"), ("fourier_3", "fourier_4")
_NOT_REQUIRED = "{}: an error without a name, smooth in the joint angles or in time, explains these views as well"


@dataclass(frozen=True)
class Selection:
    """The answer before it is put into words."""

    verdict: str  # adequate | missing_effect | cannot_tell | unknown_effect
    named: tuple[Ranked, ...]  # the effect, or the group
    ranked: tuple[Ranked, ...]  # physical, best first, unobservable last
    empirical: tuple[Ranked, ...]  # best first
    second: Ranked | None = None  # a further effect that the views show beside the first
    notes: tuple[str, ...] = ()  # effects that explain much and are not named, and why
    repeating_errors: tuple[RepeatingError, ...] | None = (
        None  # what repeats without a name; None where the verdict asked for none
    )

    @property
    def log_odds_over_nothing(self) -> float:
        """Log odds of the name, or of one of the group, over nothing being missing; infinite where none is given."""
        odds = [r.log_odds_over_nothing for r in self.named]
        return float(logsumexp(odds)) if odds else np.inf


def select(linear: LinearModel, candidates: Sequence[Candidate], limit: ScatterLimit) -> Selection:
    """Name what is missing, or abstain."""
    ranked, empirical = rank_all(linear, candidates)
    stray = _best_empirical(empirical)
    adequate = Selection("adequate", (), ranked, empirical)
    unknown = replace(adequate, verdict="unknown_effect")
    if stray is None and not any(is_certain(r) for r in ranked):
        return _select_group_or_unnamed(linear, candidates, limit, adequate)
    contenders, base = rescore_contenders(linear, [r for r in ranked if is_contender(r)])
    if not contenders:
        return unknown
    best, second, refused = contenders[0], None, dict[str, str]()
    others: Sequence[Ranked] = ()
    stray, law = stray and rescored_in(base, stray), rivals.unnamed_law_log_posterior(base)
    ranked = rescored_against(ranked, best, law)
    adequate, unknown = replace(adequate, ranked=ranked), replace(unknown, ranked=ranked)
    if linear.measurement.views.count >= MANY_VIEWS:
        effects, refused, other = _select_jointly(linear, candidates, best, stray)
        if not effects:
            rest = replace(adequate, notes=_rejection_notes(refused))
            return replace(rest, verdict="unknown_effect") if other else _unnamed_or_adequate(linear, limit, rest)
        best, *others = effects
        second = others[0] if others else None
    elif _beaten_by_unnamed(best, stray, law):
        # Two known effects at once may look like none of them: try the best with a second one.
        second = find_second_effect(linear, candidates, best)
        if second is None or _beaten_by_unnamed(best, stray, law, second, len(ranked)):
            return unknown
        others = [second]
    if not _required(linear, best, others):
        return replace(unknown, notes=(*_rejection_notes(refused), _NOT_REQUIRED.format(best.name)))
    if _gear_order_ambiguous(base, best, empirical):
        return unknown
    likely = (r for r in contenders if r.log_posterior > best.log_posterior - ODDS)
    near = (r for r in likely if r.name != best.name and r.name not in refused)
    group = (best, *(() if second is not None else near))
    if len(group) > 1 and linear.measurement.views.count < MANY_VIEWS:
        two = find_missing_pair(linear, candidates, best)
        if two is not None:
            return replace(adequate, verdict="missing_effect", named=two[:1], second=two[1])
    verdict = "missing_effect" if len(group) == 1 else "cannot_tell"
    return Selection(verdict, group, ranked, empirical, second, _rejection_notes(refused))


def _select_jointly(
    linear: LinearModel, candidates: Sequence[Candidate], best: Ranked, empirical: Ranked | None
) -> tuple[list[Ranked], dict[str, str], bool]:
    """Of many views: effects that are missing at once, the one first that is to be named; what is not among them, and
    why; and whether there is something of another form."""
    found = forward_selection(linear, candidates, best)
    explained = max(found.explained, best.log_posterior)
    if (empirical is not None and empirical.log_posterior > explained + ODDS) or (found.refused and not found.effects):
        return [], found.refused, True
    effects, idle = list(found.effects or (best,)), dict[str, str]()
    if linear.pose_errors is None:
        effects, idle = keep_worth_adding(linear, effects, sum(not c.empirical for c in candidates))
    return effects, found.refused | idle, False


def _rejection_notes(refused: Mapping[str, str]) -> tuple[str, ...]:
    """Why effects that explain much are not named; what speaks against several is said once."""
    return tuple(dict.fromkeys(refused.values()))


def _select_group_or_unnamed(
    linear: LinearModel, candidates: Sequence[Candidate], limit: ScatterLimit, adequate: Selection
) -> Selection:
    """Where no effect is certain by itself: several of which some are wanted, errors without a name, or nothing."""
    group = required_group(linear, candidates, len(adequate.ranked))
    if group:
        return replace(adequate, verdict="cannot_tell", named=group)
    return _unnamed_or_adequate(linear, limit, adequate)


def _unnamed_or_adequate(linear: LinearModel, limit: ScatterLimit, adequate: Selection) -> Selection:
    """Errors without a name, more scatter than an arm has, or nothing."""
    unnamed = find_repeating_errors(linear)
    verdict = "unknown_effect" if unnamed or implausible(linear, limit) else "adequate"
    return replace(adequate, verdict=verdict, repeating_errors=unnamed)


def _best_empirical(empirical: Sequence[Ranked]) -> Ranked | None:
    """The best shape without a cause, where it is certain."""
    for r in empirical[:1]:
        if r.adjusted < ALPHA_UNKNOWN and r.score.log_bayes_factor > LOG_BAYES_FACTOR:
            return r
    return None


def _beaten_by_unnamed(
    best: Ranked, empirical: Ranked | None, law: float, second: Ranked | None = None, tests: int = 1
) -> bool:
    """True where something without a name does what an effect of the library does, with a second one or alone.

    A shape without a cause must be 20 to 1 likelier; that a joint or the flange follows no law that has a name must be
    20 to 1 less likely, as all others that might have the name.

    Args:
        law: log posterior of that (`rivals.py`).
        tests: effects among which the second was chosen.
    """
    known = best.log_posterior
    if second is not None:
        known += second.score.log_bayes_factor + float(np.log(PRIOR_PHYSICAL / tests))
    return (empirical is not None and empirical.log_posterior > known + ODDS) or law > known - ODDS


def _required(linear: LinearModel, best: Ranked, others: Sequence[Ranked]) -> bool:
    """True if an effect is 20 to 1 wanted beside others and any course without a name; a prior of pose errors has
    asked already."""
    return linear.pose_errors is not None or (
        unnamed_courses.least_log_bayes_factor(conditioned_on_effects(linear, others), best.score) > ODDS
    )


def _gear_order_ambiguous(base: LinearModel, best: Ranked, empirical: Sequence[Ranked]) -> bool:
    """True for a gear error that over so short a range may be one of an order without a name."""
    nameless = [r for r in empirical if r.name.startswith(_NAMELESS_ORDERS)] if best.name in _GEARS else []
    if base.pose_errors is not None:
        nameless = [rescored_in(base, r) for r in nameless]
    return any(r.log_posterior > best.log_posterior - ODDS for r in nameless)
