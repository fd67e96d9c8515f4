"""The verdict: which effect is named, which cannot be told apart, whether something unknown is there, or nothing."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from stitch.diagnosis.candidates import Candidate
from stitch.diagnosis.plausible_scatter import ScatterLimit, implausible
from stitch.diagnosis.selection.forward_selection import forward_selection, worth_adding
from stitch.diagnosis.selection.inclusion import contest, rescored, wanted_group
from stitch.diagnosis.selection.pairs import both_missing, second_beside
from stitch.diagnosis.selection.ranking import Ranked, beside, certain, conditioned, contends, ranked_all
from stitch.diagnosis.thresholds import (
    ALPHA_UNKNOWN,
    LOG_BAYES_FACTOR,
    MANY_VIEWS,
    ODDS,
    PRIOR_PHYSICAL,
)
from stitch.diagnosis.unknown import rivals, unnamed_courses
from stitch.diagnosis.unknown.unnamed_errors import Unnamed, unnamed_errors
from stitch.observations.linear_model import LinearModel

# Errors of one and two periods a turn have a name; those of three and four have not.
_GEARS, _NAMELESS_ORDERS = ("gear_eccentricity", "gear_harmonic"), ("fourier_3", "fourier_4")
_UNWANTED = "{}: an error without a name, smooth in the joint angles or in time, explains these views as well"


@dataclass(frozen=True)
class Selection:
    """The answer before it is put into words."""

    verdict: str  # adequate | missing_effect | cannot_tell | unknown_effect
    named: tuple[Ranked, ...]  # the effect, or the group
    ranked: tuple[Ranked, ...]  # physical, best first, unobservable last
    empirical: tuple[Ranked, ...]  # best first
    second: Ranked | None = None  # a further effect that the views show beside the first
    notes: tuple[str, ...] = ()  # effects that explain much and are not named, and why
    unnamed: tuple[Unnamed, ...] | None = None  # what repeats without a name; None where the verdict asked for none

    @property
    def over_nothing(self) -> float:
        """Log odds of the name, or of one of the group, over nothing being missing; infinite where none is given."""
        odds = [r.over_nothing for r in self.named]
        return float(logsumexp(odds)) if odds else np.inf


def select(linear: LinearModel, candidates: Sequence[Candidate], limit: ScatterLimit) -> Selection:
    """Name what is missing, or abstain."""
    ranked, empirical = ranked_all(linear, candidates)
    stray = _stray(empirical)
    adequate = Selection("adequate", (), ranked, empirical)
    unknown = replace(adequate, verdict="unknown_effect")
    if stray is None and not any(certain(r) for r in ranked):
        return _none_alone(linear, candidates, limit, adequate)
    contenders, base = contest(linear, [r for r in ranked if contends(r)])
    if not contenders:
        return unknown
    best, second, refused = contenders[0], None, dict[str, str]()
    others: Sequence[Ranked] = ()
    stray, law = stray and rescored(base, stray), rivals.log_posterior(base)
    ranked = beside(ranked, best, law)
    adequate, unknown = replace(adequate, ranked=ranked), replace(unknown, ranked=ranked)
    if linear.measurement.views.count >= MANY_VIEWS:
        effects, refused, other = _at_once(linear, candidates, best, stray)
        if not effects:
            rest = replace(adequate, notes=_notes(refused))
            return replace(rest, verdict="unknown_effect") if other else _without_name(linear, limit, rest)
        best, *others = effects
        second = others[0] if others else None
    elif _outdone(best, stray, law):
        # Two known effects at once may look like none of them: try the best with a second one.
        second = second_beside(linear, candidates, best)
        if second is None or _outdone(best, stray, law, second, len(ranked)):
            return unknown
        others = [second]
    if not _wanted(linear, best, others):
        return replace(unknown, notes=(*_notes(refused), _UNWANTED.format(best.name)))
    if _order_open(base, best, empirical):
        return unknown
    likely = (r for r in contenders if r.log_posterior > best.log_posterior - ODDS)
    near = (r for r in likely if r.name != best.name and r.name not in refused)
    group = (best, *(() if second is not None else near))
    if len(group) > 1 and linear.measurement.views.count < MANY_VIEWS:
        two = both_missing(linear, candidates, best)
        if two is not None:
            return replace(adequate, verdict="missing_effect", named=two[:1], second=two[1])
    verdict = "missing_effect" if len(group) == 1 else "cannot_tell"
    return Selection(verdict, group, ranked, empirical, second, _notes(refused))


def _at_once(
    linear: LinearModel, candidates: Sequence[Candidate], best: Ranked, stray: Ranked | None
) -> tuple[list[Ranked], dict[str, str], bool]:
    """Of many views: effects that are missing at once, the one first that is to be named; what is not among them, and
    why; and whether there is something of another form."""
    found = forward_selection(linear, candidates, best)
    explained = max(found.explained, best.log_posterior)
    if (stray is not None and stray.log_posterior > explained + ODDS) or (found.refused and not found.effects):
        return [], found.refused, True
    effects, idle = list(found.effects or (best,)), dict[str, str]()
    if linear.pose_errors is None:
        effects, idle = worth_adding(linear, effects, sum(not c.empirical for c in candidates))
    return effects, found.refused | idle, False


def _notes(refused: Mapping[str, str]) -> tuple[str, ...]:
    """Why effects that explain much are not named; what speaks against several is said once."""
    return tuple(dict.fromkeys(refused.values()))


def _none_alone(
    linear: LinearModel, candidates: Sequence[Candidate], limit: ScatterLimit, adequate: Selection
) -> Selection:
    """Where no effect is certain by itself: several of which some are wanted, errors without a name, or nothing."""
    group = wanted_group(linear, candidates, len(adequate.ranked))
    if group:
        return replace(adequate, verdict="cannot_tell", named=group)
    return _without_name(linear, limit, adequate)


def _without_name(linear: LinearModel, limit: ScatterLimit, adequate: Selection) -> Selection:
    """Errors without a name, more scatter than an arm has, or nothing."""
    unnamed = unnamed_errors(linear)
    verdict = "unknown_effect" if unnamed or implausible(linear, limit) else "adequate"
    return replace(adequate, verdict=verdict, unnamed=unnamed)


def _stray(empirical: Sequence[Ranked]) -> Ranked | None:
    """The best shape without a cause, where it is certain."""
    for r in empirical[:1]:
        if r.adjusted < ALPHA_UNKNOWN and r.score.log_bayes_factor > LOG_BAYES_FACTOR:
            return r
    return None


def _outdone(best: Ranked, stray: Ranked | None, law: float, second: Ranked | None = None, tests: int = 1) -> bool:
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
    return (stray is not None and stray.log_posterior > known + ODDS) or law > known - ODDS


def _wanted(linear: LinearModel, best: Ranked, others: Sequence[Ranked]) -> bool:
    """True if an effect is 20 to 1 wanted beside others and any course without a name; a prior of pose errors has
    asked already."""
    return linear.pose_errors is not None or (
        unnamed_courses.least_wanted(conditioned(linear, others), best.score) > ODDS
    )


def _order_open(base: LinearModel, best: Ranked, empirical: Sequence[Ranked]) -> bool:
    """True for a gear error that over so short a range may be one of an order without a name."""
    nameless = [r for r in empirical if r.name.startswith(_NAMELESS_ORDERS)] if best.name in _GEARS else []
    if base.pose_errors is not None:
        nameless = [rescored(base, r) for r in nameless]
    return any(r.log_posterior > best.log_posterior - ODDS for r in nameless)
