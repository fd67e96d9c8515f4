"""The verdict: which effect is named, which cannot be told apart, whether something unknown is there, or nothing."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from stitch.diagnosis import unnamed_time_laws
from stitch.diagnosis.candidates import Candidate
from stitch.diagnosis.ranking import (
    Ranked,
    conditioned_on_effects,
    is_certain,
    is_contender,
    rank,
    rank_all,
    rank_one,
    rescored_against,
)
from stitch.diagnosis.score import ScatterLimit, implausible, score
from stitch.diagnosis.stepwise_selection import forward_selection, keep_worth_adding
from stitch.diagnosis.thresholds import (
    ALPHA_UNKNOWN,
    LOG_BAYES_FACTOR,
    MANY_VIEWS,
    MIN_STEADINESS,
    ODDS,
    PRIOR_PHYSICAL,
)
from stitch.diagnosis.unnamed_time_laws import RepeatingError, find_repeating_errors
from stitch.diagnosis.validation import CrossValidation, Halves, cross_validate, validate_in_halves
from stitch.model.forward import moves_points
from stitch.model.model import Term
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.scanner_errors import FieldError, field_error
from stitch.observations.surfaces.surface_model import SurfaceObservation
from stitch.observations.surfaces.view_poses import noise_floor

# What remains between the views however each of them is moved: no error of poses, joints or mount leaves that.
#
# A seam or a ripple in the scanner's field, a corner that is off, a part that changes its shape: overlaps show it, and
# the poses that fit best take only a share of it. Only beside the noise can it be seen that it is there.


def overlap_misfit_beyond_noise(linear: LinearModel, stated: float | None = None) -> float:
    """Rms (length_unit) of it beside the noise that the scans show, where it is more than that; else 0, and where no
    overlap of surfaces was observed.

    The noise is the scatter about the surface within each scan (`noise_floor.py`), whatever a data sheet says.

    Args:
        stated: noise of the scanner, for scans too small to show their own.
    """
    if not isinstance(linear.observation, SurfaceObservation):
        return 0.0
    surfaces = linear.observation
    freed, noise = (
        surfaces.unconstrained.overlaps,
        noise_floor(surfaces.capture, surfaces.unconstrained.overlaps, stated),
    )
    left = float(max(freed.gram.rms**2 - noise**2, 0.0) ** 0.5)
    return left if left > noise else 0.0


def find_scanner_error(linear: LinearModel, other_terms: Sequence[Term] = ()) -> FieldError | None:
    """Smooth errors of the scans where they are larger than every scanner's; None where overlaps show no such.

    It may be small beside the noise: many points average that, and not what is the same in every view.

    Args:
        other_terms: effects of points that may have any size.
    """
    if not isinstance(linear.observation, SurfaceObservation):
        return None
    found = field_error(linear.measurement, linear.model, linear.observation.unconstrained, ALPHA_UNKNOWN, other_terms)
    return found if found.unusual else None


# Two effects that are both missing: each of them is asked for beside the other.


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


# Which effects the data want beside everything else that an arm may do wrong.
#
# A candidate is scored without its own share of the pose errors (`score.py`), while every other joint and link may err
# by as much as the views show. What two effects can both do no single one is wanted for, since the errors that remain
# do
# the other's part: then the smallest set is sought without which the views cannot do.


def rescore_contenders(linear: LinearModel, contenders: Sequence[Ranked]) -> tuple[list[Ranked], LinearModel]:
    """Contenders, likeliest first, where none of them is among the errors that remain; and the model in which they
    are not: there their Bayes factors are over one and the same."""
    base = linear.without([r.name for r in contenders])
    if len(contenders) < 2 or base is linear:
        return list(contenders), base
    return sorted((rescored_in(base, r) for r in contenders), key=lambda r: -r.log_posterior), base


def rescored_in(base: LinearModel, ranked: Ranked) -> Ranked:
    """The same candidate with its score in another model; it counts among as many as before."""
    own = score(base, ranked.score.candidate)
    return replace(
        ranked,
        score=own,
        adjusted=min(1.0, own.p_value * ranked.tests),
        log_posterior=ranked.log_posterior + own.log_bayes_factor - ranked.score.log_bayes_factor,
    )


def required_group(linear: LinearModel, candidates: Sequence[Candidate], tests: int) -> tuple[Ranked, ...]:
    """Effects of which some are wanted though none is alone, likeliest first; () if the views do without any.

    Args:
        tests: candidates among which the best is chosen.
    """
    families = () if linear.pose_errors is None else tuple(linear.pose_errors.effects)
    if not families or linear.without(families).null.deviance < linear.null.deviance:
        # No error of joints or links helps: none stands in for another.
        return ()
    known = {c.name: c for c in candidates if not c.empirical}
    ranked = rank([score(linear.without(families), c) for c in known.values()], tests)[0]
    best = next((r for r in ranked if is_certain(r)), None)
    if best is None:
        return ()
    removed = {best.name}
    while not is_certain(rank_one(linear.without(removed), known[best.name], tests)):
        others = [name for name in families if name in known and name not in removed]
        if not others:
            return ()
        removed.add(max(others, key=lambda name: _log_bayes_factor(linear.without({*removed, name}), known[best.name])))
    base = linear.without(removed)
    again = rank([score(base, c) for c in known.values() if c.name in removed], tests)[0]
    if unnamed_time_laws.unnamed_law_log_posterior(base) > again[0].log_posterior - ODDS:
        return ()
    near = [r for r in again if is_contender(r) and r.log_posterior > again[0].log_posterior - ODDS]
    # One that is far ahead of the others is still not wanted beside them, all of them being a little wrong.
    return tuple(near) if len(near) > 1 else again


def _log_bayes_factor(linear: LinearModel, candidate: Candidate) -> float:
    return score(linear, candidate).log_bayes_factor


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
    stray, law = stray and rescored_in(base, stray), unnamed_time_laws.unnamed_law_log_posterior(base)
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
        unnamed_time_laws.least_log_bayes_factor(conditioned_on_effects(linear, others), best.score) > ODDS
    )


def _gear_order_ambiguous(base: LinearModel, best: Ranked, empirical: Sequence[Ranked]) -> bool:
    """True for a gear error that over so short a range may be one of an order without a name."""
    nameless = [r for r in empirical if r.name.startswith(_NAMELESS_ORDERS)] if best.name in _GEARS else []
    if base.pose_errors is not None:
        nameless = [rescored_in(base, r) for r in nameless]
    return any(r.log_posterior > best.log_posterior - ODDS for r in nameless)


# Scans that err smoothly, more clearly than anything else: it is said first, and no name is given beside it.
#
# Poses found from such scans are off too, and an effect that explains some of that is not thereby there.


def check_scanner_errors(linear: LinearModel, selection: Selection) -> tuple[Selection, FieldError | None]:
    """A verdict held against what the overlaps show of smooth errors, and those where they are part of the answer.

    Where nothing is missing it stays beside the verdict, as long as it is smaller than the noise. A name is not given
    where the data want smooth errors, beside it, more than the effect itself.
    """
    unknown = replace(selection, verdict="unknown_effect", named=(), second=None)
    if selection.verdict == "adequate":
        found = find_scanner_error(linear)
        return (unknown if found is not None and found.over_noise else selection), found
    if selection.verdict != "missing_effect":
        return selection, None
    named = selection.named[0]
    said = [r.score.form.term for r in (named, selection.second) if r is not None]
    found = find_scanner_error(linear, other_terms=[term for term in said if moves_points([term])])
    if found is None or found.gain < named.score.log_bayes_factor:
        return selection, None
    return replace(unknown, notes=(f"{named.name} is less clear than that", *selection.notes)), found


# Whether a name stands before the views that took no part in choosing it.


def validate_named(
    selection: Selection, found: Mapping[str, CrossValidation], in_halves: Mapping[str, Halves | None]
) -> Selection:
    """An effect that does not hold on views left out or in halves, or that one view carries, is not named; a second
    one may be. Where neither holds, something is there of another form: the alarm that asked for a name stands.
    """
    if selection.verdict != "missing_effect":
        return selection
    notes = list(selection.notes)
    for named in (selection.named[0], selection.second):
        if named is None:
            continue
        refusal = _rejection_reason(named, found.get(named.name), in_halves.get(named.name))
        if refusal is None:
            if named is selection.named[0]:
                return selection
            return replace(selection, named=(named,), second=None, notes=tuple(notes))
        notes.append(refusal)
    kept = tuple(notes[: len(selection.notes) + 1])
    return Selection("unknown_effect", (), selection.ranked, selection.empirical, notes=kept)


def pair_is_validated(linear: LinearModel, pair: tuple[Ranked, Ranked]) -> bool:
    """True if each of two effects stands that test beside the other, beside which it was scored."""
    asked = (pair, pair[::-1])
    return not any(
        _rejection_reason(
            one, cross_validate(conditioned_on_effects(linear, [other]), one.score), validate_in_halves(one.score)
        )
        for one, other in asked
    )


def _rejection_reason(named: Ranked, left_out: CrossValidation | None, halves: Halves | None) -> str | None:
    """Why an effect does not stand the test of views left out."""
    if left_out is not None and left_out.steadiness < MIN_STEADINESS:
        return f"{named.name} rests on a single view: without it {max(left_out.steadiness, 0):.0%} of it remain"
    if left_out is not None and not left_out.helps:
        share = f"{left_out.poses:.2f} ± {left_out.poses_sigma:.2f}"
        return f"{named.name} would not help on views left out (mean square pose error {share} of now)"
    return None if halves is None else halves.rejection_reason(named.name)


# The verdict, held against views left out, halves of the views and what the scanner itself may do wrong.


def decide(linear: LinearModel, candidates: Sequence[Candidate], limit: ScatterLimit) -> Selection:
    """The verdict alone: selected, and held against all that may speak against it."""
    selection = select(linear, candidates, limit)
    return check_verdict(linear, candidates, selection, cross_validate_named(linear, selection))[0]


def cross_validate_named(linear: LinearModel, selection: Selection) -> dict[str, CrossValidation]:
    """What each effect that may be named does on views left out: beside all that it was named beside, or, where pose
    errors have no prior, alone, as it would be added next."""
    alone = {r.name: r.score for r in selection.ranked}
    asked = {r.name: r.score if r.score.base_model else alone[r.name] for r in _named_effects(selection)}
    return {name: cross_validate(linear, score) for name, score in asked.items()}


def check_verdict(
    linear: LinearModel,
    candidates: Sequence[Candidate],
    selection: Selection,
    left_out: Mapping[str, CrossValidation],
) -> tuple[Selection, FieldError | None]:
    """What may still be named, and the scanner's own error where that is part of the answer.

    Where a name does not stand, a second effect that is missing too may be why.

    Args:
        left_out: of `on_views_left_out`.
    """
    if selection.verdict != "missing_effect":
        return check_scanner_errors(linear, selection)
    found = check_scanner_errors(linear, _keep_validated(linear, selection, left_out))
    two = None if found[0].named else _name_pair(linear, candidates, selection)
    with_second = found if two is None else check_scanner_errors(linear, two)
    return with_second if with_second[0].named else found


def _keep_validated(linear: LinearModel, selection: Selection, left_out: Mapping[str, CrossValidation]) -> Selection:
    """What holds on views left out and in halves. A second effect that is named without the first is asked alone, and
    is not named where alone it is not certain."""
    held = validate_named(selection, left_out, {r.name: validate_in_halves(r.score) for r in _named_effects(selection)})
    if not held.named or held.named[0] is selection.named[0]:
        return held
    alone = next(r for r in selection.ranked if r.name == held.named[0].name)
    if not is_certain(alone):
        return replace(held, verdict="unknown_effect", named=())
    again = replace(held, named=(alone,))
    return validate_named(again, cross_validate_named(linear, again), {alone.name: validate_in_halves(alone.score)})


def _named_effects(selection: Selection) -> list[Ranked]:
    return [r for r in (*selection.named, selection.second) if r is not None]


def _name_pair(linear: LinearModel, candidates: Sequence[Candidate], selection: Selection) -> Selection | None:
    """Two effects named where the first, the likeliest of all, does not stand alone: what the second does made it
    another in each half of the views, or looked like a smooth error of the scanner."""
    if linear.measurement.views.count >= MANY_VIEWS:
        return None
    two = find_missing_pair(linear, candidates, selection.named[0])
    if two is None or two[0].name != selection.named[0].name or not pair_is_validated(linear, two):
        return None
    return replace(selection, named=two[:1], second=two[1])
