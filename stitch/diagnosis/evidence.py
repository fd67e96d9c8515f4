"""Evidence for the verdict: effects that explain the views, and what speaks against naming them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from stitch.diagnosis import thresholds as limits
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
from stitch.diagnosis.regime import regime_of
from stitch.diagnosis.score import ScatterLimit, implausible, score
from stitch.diagnosis.stepwise_selection import forward_selection, keep_worth_adding
from stitch.diagnosis.unnamed_time_laws import (
    find_repeating_errors,
    least_log_bayes_factor,
    unnamed_law_log_posterior,
)
from stitch.diagnosis.validation import CrossValidation, Halves, cross_validate, validate_in_halves
from stitch.diagnosis.verdict import Evidence, scanner_explains_it
from stitch.model.forward import moves_points
from stitch.model.model import Term
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.scanner_errors import FieldError, field_error
from stitch.observations.surfaces.surface_model import surfaces_of
from stitch.observations.surfaces.view_poses import noise_floor
from stitch.session.measurement import Views

# What remains between the views however each of them is moved: no error of poses, joints or mount leaves that.
#
# A seam or a ripple in the scanner's field, a corner that is off, a part that changes its shape: overlaps show it, and
# the poses that fit best take only a share of it. Only beside the noise can it be seen that it is there.


def overlap_misfit_beyond_noise(linear: LinearModel, stated: float | None = None) -> float:
    """Rms (length_unit) of it beside the noise that the scans show, where it is more than that; else 0, and where no
    overlap of surfaces was observed.

    The noise is the scatter about the surface within each scan (`noise_floor`), whatever a data sheet says.

    Args:
        stated: noise of the scanner, for scans too small to show their own.
    """
    surfaces = surfaces_of(linear)
    if surfaces is None:
        return 0.0
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
    surfaces = surfaces_of(linear)
    if surfaces is None:
        return None
    found = field_error(linear.measurement, linear.model, surfaces.unconstrained, limits.ALPHA_UNKNOWN, other_terms)
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
    if not is_certain(first) or any(
        is_contender(r) and r.log_posterior > first.log_posterior - limits.ODDS for r in rest
    ):
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
# A candidate is scored without its own share of the pose errors (`score`), while every other joint and link may err
# by as much as the views show. What two effects can both do no single one is wanted for, since the errors that remain
# do the other's part: then the smallest set is sought without which the views cannot do.


def rescore_contenders(linear: LinearModel, contenders: Sequence[Ranked]) -> tuple[list[Ranked], LinearModel]:
    """Contenders, likeliest first, where none of them is among the errors that remain; and the model in which they
    are not: there their Bayes factors are over one and the same."""
    base = linear.restricted(linear.causes - {r.name for r in contenders})
    if len(contenders) < 2 or base is linear:
        return list(contenders), base
    return sorted((rescored_in(base, r) for r in contenders), key=lambda r: -r.log_posterior), base


def rescored_in(base: LinearModel, ranked: Ranked) -> Ranked:
    """Score a candidate in another model; it counts among as many as before."""
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
    if not families or linear.restricted(linear.causes - set(families)).null.deviance < linear.null.deviance:
        # No error of joints or links helps: none stands in for another.
        return ()
    known = {c.name: c for c in candidates if not c.empirical}
    ranked = rank([score(linear.restricted(linear.causes - set(families)), c) for c in known.values()], tests)[0]
    best = next((r for r in ranked if is_certain(r)), None)
    if best is None:
        return ()
    removed = {best.name}
    while not is_certain(rank_one(linear.restricted(linear.causes - removed), known[best.name], tests)):
        others = [name for name in families if name in known and name not in removed]
        if not others:
            return ()
        removed.add(
            max(
                others,
                key=lambda name: (
                    score(linear.restricted(linear.causes - {*removed, name}), known[best.name]).log_bayes_factor
                ),
            )
        )
    base = linear.restricted(linear.causes - removed)
    again = rank([score(base, c) for c in known.values() if c.name in removed], tests)[0]
    if unnamed_law_log_posterior(base) > again[0].log_posterior - limits.ODDS:
        return ()
    near = [r for r in again if is_contender(r) and r.log_posterior > again[0].log_posterior - limits.ODDS]
    # One that is far ahead of the others is still not wanted beside them, all of them being a little wrong.
    return tuple(near) if len(near) > 1 else again


# Errors of one and two periods a turn have a name; those of three and four have not.
_GEARS, _NAMELESS_ORDERS = ("gear_eccentricity", "gear_harmonic"), ("fourier_3", "fourier_4")
_NOT_REQUIRED = "{}: an unnamed error, smooth in the joint angles or in time, explains these views as well"
_LESS_CLEAR = "{} explains less than the scanner's own error"


def gather_evidence(linear: LinearModel, candidates: Sequence[Candidate], limit: ScatterLimit) -> Evidence:
    """Gather all that the views say for and against every effect; the verdict follows from it (`verdict.decide`).

    What remains between the overlaps is not asked here (`overlap_misfit_beyond_noise`).
    """
    evidence = select(linear, candidates, limit)
    evidence = challenge(linear, candidates, replace(evidence, left_out=cross_validate_named(linear, evidence)))
    equal = with_equal_rivals(linear, evidence)
    if equal.verdict != evidence.verdict and not regime_of(linear).many_views:
        equal = _with_validated_second(linear, candidates, evidence) or equal
    return with_turning_joints(linear.measurement.views, equal)


def select(linear: LinearModel, candidates: Sequence[Candidate], limit: ScatterLimit) -> Evidence:
    """Find the effects that would explain the views, and what explains them as well; nothing is left out yet."""
    ranked, empirical = rank_all(linear, candidates)
    shape = next(iter(empirical), None)
    if shape is not None and not (
        shape.adjusted < limits.ALPHA_UNKNOWN and shape.score.log_bayes_factor > limits.LOG_BAYES_FACTOR
    ):
        shape = None
    found = Evidence(ranked, empirical, implausible_scatter=implausible(linear, limit))
    if shape is None and not any(is_certain(r) for r in ranked):
        # No effect is certain by itself: several of which some are required, errors without a name, or nothing.
        group = required_group(linear, candidates, len(ranked))
        return (
            replace(found, explanation=group)
            if group
            else replace(found, repeating_errors=find_repeating_errors(linear))
        )
    found = replace(found, alarm=True)
    contenders, base = rescore_contenders(linear, [r for r in ranked if is_contender(r)])
    if not contenders:
        return found
    best, second, refused = contenders[0], None, dict[str, str]()
    others: Sequence[Ranked] = ()
    shape, law = shape and rescored_in(base, shape), unnamed_law_log_posterior(base)
    found = replace(found, ranked=rescored_against(ranked, best, law))
    if regime_of(linear).many_views:
        effects, refused, other = _select_jointly(linear, candidates, best, shape)
        found = replace(found, notes=tuple(dict.fromkeys(refused.values())))  # what speaks against several is said once
        if not effects:
            return found if other else replace(found, alarm=False, repeating_errors=find_repeating_errors(linear))
        best, *others = effects
        second = others[0] if others else None
    elif _beaten_by_unnamed(best, shape, law):
        # Two known effects at once may look like none of them: try the best with a second one.
        second = find_second_effect(linear, candidates, best)
        if second is None or _beaten_by_unnamed(best, shape, law, second, len(ranked)):
            return replace(found, explanation=(best,), unnamed_explains_it=True)
        others = [second]
    if not _required(linear, best, others):
        notes = (*found.notes, _NOT_REQUIRED.format(best.name))
        return replace(found, explanation=(best,), unnamed_explains_it=True, notes=notes)
    if _gear_order_ambiguous(base, best, empirical):
        return replace(found, explanation=(best,), unnamed_explains_it=True, notes=())
    likely = (r for r in contenders if r.log_posterior > best.log_posterior - limits.ODDS)
    near = (r for r in likely if r.name != best.name and r.name not in refused)
    group = (best, *(() if second is not None else near))
    if len(group) > 1 and not regime_of(linear).many_views:
        two = find_missing_pair(linear, candidates, best)
        if two is not None:
            return replace(found, explanation=two[:1], further=two[1], together=two)
    return replace(found, explanation=group, further=second, together=(best, *others))


def _select_jointly(
    linear: LinearModel, candidates: Sequence[Candidate], best: Ranked, empirical: Ranked | None
) -> tuple[list[Ranked], dict[str, str], bool]:
    """Select effects that are missing at once, the one to be named first; what is not among them, and
    why; and whether there is something of another form."""
    found = forward_selection(linear, candidates, best)
    explained = max(found.explained, best.log_posterior)
    if (empirical is not None and empirical.log_posterior > explained + limits.ODDS) or (
        found.refused and not found.effects
    ):
        return [], found.refused, True
    effects, idle = list(found.effects or (best,)), dict[str, str]()
    if not regime_of(linear).prior:
        effects, idle = keep_worth_adding(linear, effects, sum(not c.empirical for c in candidates))
    return effects, found.refused | idle, False


def _beaten_by_unnamed(
    best: Ranked, empirical: Ranked | None, law: float, second: Ranked | None = None, tests: int = 1
) -> bool:
    """True where something without a name does what an effect of the library does, with a second one or alone.

    A shape without a cause must be 20 to 1 likelier; that a joint or the flange follows no law that has a name must be
    20 to 1 less likely, as all others that might have the name.

    Args:
        law: log posterior of that (`unnamed_law_log_posterior`).
        tests: effects among which the second was chosen.
    """
    known = best.log_posterior
    if second is not None:
        known += second.score.log_bayes_factor + float(np.log(limits.PRIOR_PHYSICAL / tests))
    return (empirical is not None and empirical.log_posterior > known + limits.ODDS) or law > known - limits.ODDS


def _required(linear: LinearModel, best: Ranked, others: Sequence[Ranked]) -> bool:
    """True if an effect is 20 to 1 wanted beside others and any course without a name; a prior of pose errors has
    asked already."""
    return regime_of(linear).prior or (
        least_log_bayes_factor(conditioned_on_effects(linear, others), best.score) > limits.ODDS
    )


def _gear_order_ambiguous(base: LinearModel, best: Ranked, empirical: Sequence[Ranked]) -> bool:
    """True for a gear error that over so short a range may be one of an order without a name."""
    nameless = [r for r in empirical if r.name.startswith(_NAMELESS_ORDERS)] if best.name in _GEARS else []
    if regime_of(base).prior:
        nameless = [rescored_in(base, r) for r in nameless]
    return any(r.log_posterior > best.log_posterior - limits.ODDS for r in nameless)


# A name, held against views left out, halves of the views and what the scanner itself may do wrong.


def challenge(linear: LinearModel, candidates: Sequence[Candidate], evidence: Evidence) -> Evidence:
    """Add what speaks against the name: views left out, halves of the views, smooth errors of the scans.

    Where a name does not stand, a second effect that is missing too may be why: what it does made the first another in
    each half of the views, or looked like a smooth error of the scanner.
    """
    if evidence.verdict != "missing_effect":
        return with_scanner_error(linear, evidence)
    found = with_scanner_error(linear, _validated(linear, evidence))
    if found.named or regime_of(linear).many_views:
        return found
    return _with_validated_second(linear, candidates, evidence) or found


def _with_validated_second(linear: LinearModel, candidates: Sequence[Candidate], evidence: Evidence) -> Evidence | None:
    """Add a second effect to a name where both stand every test beside each other; None where no two do.

    What a second one leaves on views left out may hide by how much the first predicts them better than its rivals.
    """
    two = find_missing_pair(linear, candidates, evidence.named[0])
    if two is None or two[0].name != evidence.named[0].name or not pair_is_validated(linear, two):
        return None
    pair = with_scanner_error(linear, replace(evidence, explanation=two[:1], further=two[1], together=two))
    return pair if pair.named else None


def with_equal_rivals(linear: LinearModel, evidence: Evidence) -> Evidence:
    """Add to a single name the contenders that predict views left out as well: these views cannot tell which it is.

    One that predicts them clearly better and stands every other test takes the place of the name: a Bayes factor
    charges for plausible sizes that may be wrong, as a user's are, and what was not seen does not.
    """
    if evidence.verdict != "missing_effect" or evidence.second is not None:
        return evidence
    named = evidence.named[0]
    rivals = {
        r.name: r
        for r in evidence.ranked[: limits.CROSS_VALIDATED_CANDIDATES]
        if r.name != named.name and is_contender(r) and not any(r.name in note for note in evidence.notes)
    }
    own = {name: cross_validate(linear, r.score) for name, r in rivals.items()}
    left_out = dict(evidence.left_out) | own
    ahead = (name for name, found in own.items() if found.better_than(left_out[named.name]))
    better = min(ahead, key=lambda name: own[name].heldout, default=named.name)
    if better != named.name and not _rejection_reason(
        rivals[better], own[better], validate_in_halves(rivals[better].score)
    ):
        rivals, named = rivals | {named.name: named}, rivals[better]
    as_good = [r for name, r in rivals.items() if r is not named and left_out[name].as_good_as(left_out[named.name])]
    return replace(evidence, explanation=(named, *as_good), left_out=left_out)


def cross_validate_named(linear: LinearModel, evidence: Evidence) -> dict[str, CrossValidation]:
    """Cross-validate each effect that may be named, beside all that it was named beside, or, where pose
    errors have no prior, alone, as it would be added next."""
    alone = {r.name: r.score for r in evidence.ranked}
    asked = {r.name: r.score if r.score.base_model else alone[r.name] for r in _named_effects(evidence)}
    return {name: cross_validate(linear, score) for name, score in asked.items()}


def with_scanner_error(linear: LinearModel, evidence: Evidence) -> Evidence:
    """Add smooth errors of the scans: beside a model to which nothing is missing, or beside one name."""
    if evidence.verdict == "adequate":
        return replace(evidence, scanner_error=find_scanner_error(linear))
    if evidence.verdict != "missing_effect":
        return evidence
    moving = [r.score.form.term for r in _named_effects(evidence) if moves_points([r.score.form.term])]
    out = replace(evidence, scanner_error=find_scanner_error(linear, other_terms=moving))
    if scanner_explains_it(out):
        return replace(out, notes=(_LESS_CLEAR.format(evidence.named[0].name), *evidence.notes))
    return replace(out, scanner_error=None)


def _validated(linear: LinearModel, evidence: Evidence) -> Evidence:
    """Keep what holds on views left out and in halves.

    A second effect that is named without the first is asked alone, and is refuted where alone it is not certain.
    """
    halves = {r.name: validate_in_halves(r.score) for r in _named_effects(evidence)}
    held = with_validation(evidence, evidence.left_out, halves)
    if held.refuted or held.named[0] is evidence.named[0]:
        return held
    alone = next(r for r in evidence.ranked if r.name == held.named[0].name)
    again = replace(held, explanation=(alone,))
    if not is_certain(alone):
        return replace(again, refuted=True)
    return with_validation(again, cross_validate_named(linear, again), {alone.name: validate_in_halves(alone.score)})


def with_validation(
    evidence: Evidence, found: Mapping[str, CrossValidation], in_halves: Mapping[str, Halves | None]
) -> Evidence:
    """Add whether the name holds on views left out and in halves; a second effect takes its place where that holds."""
    notes = list(evidence.notes)
    for named in _named_effects(evidence):
        refusal = _rejection_reason(named, found.get(named.name), in_halves.get(named.name))
        if refusal is None:
            if named is evidence.named[0]:
                return evidence
            return replace(evidence, explanation=(named,), further=None, notes=tuple(notes))
        notes.append(refusal)
    return replace(evidence, refuted=True, notes=tuple(notes[: len(evidence.notes) + 1]))


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
    if left_out is not None and left_out.steadiness < limits.MIN_STEADINESS:
        return f"{named.name} rests on one view: without it {max(left_out.steadiness, 0):.0%} of the effect remain"
    if left_out is not None and not left_out.helps:
        share = f"{left_out.poses:.2f} ± {left_out.poses_sigma:.2f}"
        return f"{named.name} does not help on views left out: it leaves a mean square pose error of {share} of now"
    return None if halves is None else halves.rejection_reason(named.name)


def _named_effects(evidence: Evidence) -> list[Ranked]:
    return [r for r in (*evidence.named, evidence.second) if r is not None]


# A jump in time that is a joint turning back as well: a path that was driven once shows both at the same view.

# The effect of the direction from which a joint comes.
_BY_DIRECTION = "backlash"
# Share of a joint's moves on either side of a jump that go one way, and the moves there must be to tell.
_ONE_WAY, _FEWEST_MOVES = 0.95, 3


def joints_turning_at(views: Views, first: float) -> list[int]:
    """Return the joints, counted from 1, that come from one side before a view and from the other side from there on.

    Args:
        first: number of the view, as events count it.
    """
    out, after = list[int](), views.number >= first
    for joint, side in enumerate(views.approach.T, 1):
        sides = [side[now & (side != 0)] for now in (~after, after)]
        if min(map(len, sides)) < _FEWEST_MOVES:
            continue
        # 1 where all moves go one way, −1 where all go the other.
        before, later = (2 * np.mean(own > 0) - 1 for own in sides)
        if before * later < 0 and min(abs(before), abs(later)) >= 2 * _ONE_WAY - 1:
            out.append(joint)
    return out


def with_turning_joints(views: Views, evidence: Evidence) -> Evidence:
    """Add to a jump that is named the joints that turn back where it happens: this session cannot tell the two apart.

    A jump that is missing beside other effects is not added with them.
    """
    if evidence.verdict != "missing_effect":
        return evidence
    named, found = evidence.named[0], {r.name: _coincidence(views, r) for r in (*evidence.named, *evidence.together)}
    rest = tuple(r for r in evidence.together if not found[r.name])
    notes = (*evidence.notes, *(text for name, text in found.items() if text and name != named.name))
    if not found[named.name]:
        return replace(evidence, together=rest, further=evidence.further and next(iter(rest[1:]), None), notes=notes)
    rival = next((r for r in evidence.ranked if r.name == _BY_DIRECTION and r.score.observable), None)
    if rival is None:
        return replace(evidence, unnamed_explains_it=True, notes=(found[named.name], *notes))
    return replace(
        evidence, explanation=(named, rival), further=None, together=(), notes=notes, coincidence=found[named.name]
    )


def _coincidence(views: Views, ranked: Ranked) -> str:
    """Return what else begins where an effect jumps; empty where it does not, or nothing does."""
    event = next((p for p in ranked.score.form.term.parameters if p.discrete), None)
    joints = joints_turning_at(views, event.value) if event is not None else []
    if event is None or not joints:
        return ""
    which = f"joint {joints[0]} comes" if len(joints) == 1 else f"joints {', '.join(map(str, joints))} come"
    return f"{ranked.name} begins at view {event.view}, and from there on {which} from the other side"
