"""Evidence for a verdict: what would explain the views (`naming`), and what that is then held against.

`TESTS` hold a name against views left out, halves of the views, the scanner's own errors and rivals that predict as
well: questions that are asked in order, as those that led to the name.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stitch.diagnosis import thresholds as limits
from stitch.diagnosis.candidates import Candidate
from stitch.diagnosis.law_ranking import laws_of_base
from stitch.diagnosis.naming import (
    Case,
    Question,
    Reply,
    answered,
    ask,
    both_missing,
    find_missing_pair,
    names_of,
    propose,
)
from stitch.diagnosis.ranking import (
    Ranked,
    beyond_belief_text,
    conditioned_on_effects,
    is_certain,
    is_contender,
    likeliest_first,
    rank_one,
    too_large,
)
from stitch.diagnosis.score import ScatterLimit
from stitch.diagnosis.sensitivity import imitated_share
from stitch.diagnosis.systematic_laws import dictionary_of, law_of
from stitch.diagnosis.validation import CrossValidation, cross_validate, objection_in_halves
from stitch.diagnosis.verdict import Evidence, scanner_explains_it
from stitch.model.forward import moves_points
from stitch.model.model import ARM_PLACES, Term
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.field_error import FieldError, field_error
from stitch.observations.surfaces.surface_model import surfaces_of
from stitch.observations.surfaces.view_poses import noise_floor
from stitch.session.measurement import Views
from stitch.system.threads import remembered

# The effect of the direction from which a joint comes.
_BY_DIRECTION = "backlash"
# Share of a joint's moves on either side of a jump that go one way, and the moves there must be to tell.
_ONE_WAY, _FEWEST_MOVES = 0.95, 3


def gather_evidence(
    linear: LinearModel, candidates: Sequence[Candidate], limit: ScatterLimit, overlap_misfit: float = 0.0
) -> Evidence:
    """Return the evidence for and against every effect, after all questions; the verdict is a property of it.

    First the questions of `NAMING` propose a name, then those of `TESTS` try to refute it.

    Args:
        candidates: effects that could be missing.
        limit: scatter of the flange poses that no sound arm exceeds.
        overlap_misfit: rms that no motion of the views removes (`overlap_misfit_beyond_noise`), length_unit.
    """
    case = Case(linear, candidates, dictionary_of(linear, candidates))
    proposed = propose(case, limit)
    evidence = ask(TESTS, case, replace(proposed, proposed=proposed))
    if overlap_misfit:
        misfit = Reply("yes, beyond the noise", {"overlap_misfit": overlap_misfit})
        evidence = answered(evidence, overlap_misfit_beyond_noise, misfit)
    return evidence


def does_it_hold_elsewhere(case: Case, evidence: Evidence) -> Reply | None:
    """Does it hold on views left out and in halves of the views?

    Every effect that may be named is cross-validated. Where pose errors have a prior, the effects it was named beside
    are in the model; else it is tested alone, as it would be added next. If the first effect fails and the second
    holds, the second is named, provided that it is certain and holds alone.
    """
    effects = _named_effects(evidence)
    alone = {r.name: r for r in evidence.ranked}
    # A score with `base_model` was made beside other effects, and is kept.
    scores = {r.name: (r if r.score.base_model else alone[r.name]).score for r in effects}
    left_out = {name: cross_validate(case.linear, scored) for name, scored in scores.items()}
    if not effects:
        return None
    if len(evidence.named) != 1:
        return Reply("not asked of a group", {"left_out": left_out})
    objection = _objection(effects[0], left_out[effects[0].name])
    if objection is None:
        return Reply("yes", {"left_out": left_out})
    second = evidence.second
    if second is None or _objection(second, left_out[second.name]) is not None:
        notes = (*evidence.notes, objection)
        return Reply(objection, {"left_out": left_out, "refuted": True, "notes": notes})
    second = alone[second.name]
    objections = [objection]
    is_refuted = not is_certain(second)
    if not is_refuted and (objection := _objection(second, cross_validate(case.linear, second.score))) is not None:
        is_refuted = True
        objections.append(objection)
    changes = {"explanation": (second,), "further": None, "refuted": is_refuted}
    notes = (*evidence.notes, *objections)
    return Reply("; ".join(objections), {**changes, "left_out": left_out, "notes": notes})


def does_the_scanner_explain_it(case: Case, evidence: Evidence) -> Reply | None:
    """Do the scans err smoothly: by more than every scanner, and by as many nats as what is named?"""
    if evidence.verdict == "adequate":
        error = find_scanner_error(case.linear)
        return Reply("no" if error is None else "yes", {"scanner_error": error})
    if evidence.verdict != "missing_effect":
        return None
    error = _scanner_error_in_place_of(case.linear, evidence)
    if error is None:
        return Reply("no")
    less_clear = f"{evidence.named[0].name} explains less than the scanner's own error"
    return Reply("yes", {"scanner_error": error, "notes": (less_clear, *evidence.notes)})


def does_it_hold_with_a_second(case: Case, evidence: Evidence) -> Reply | None:
    """Of few views: does the effect that was proposed and then refuted hold beside a second effect?

    A second missing effect can make the first look different in each half of the views, or like a smooth error of the
    scanner. If both hold beside each other, the answer is "yes": both are missing, and what refuted the first is taken
    back. None, not asked, where nothing was refuted, or the views are many.
    """
    before_tests = evidence.proposed
    if before_tests is None or before_tests.verdict != "missing_effect" or evidence.named or case.many_views:
        return None
    pair = _pair_that_stands(case, evidence, before_tests.explanation[0])
    if pair is None:
        return Reply("no")
    taken_back = {"notes": before_tests.notes, "refuted": False, "scanner_error": None}
    return Reply(f"yes, beside {pair[1].name}", {**both_missing(pair), **taken_back})


def which_predict_as_well(case: Case, evidence: Evidence) -> Reply | None:
    """Which contenders predict views left out as well as a single name, or better?

    Such contenders form a group with the name that cannot be told apart. One that predicts clearly better and passes
    the other tests is named instead: a Bayes factor depends on assumed plausible sizes, a prediction does not. If there
    are rivals as good, a second missing effect may hide the difference: then a pair is tried first.

    A rival must be within 20 to 1 of the name where either of the two is an event. An event near the first view is the
    same as a lasting effect, and views left out near an event say little of it.
    """
    if evidence.verdict != "missing_effect" or evidence.second is not None:
        return None
    named = evidence.named[0]
    least = next(r.log_posterior for r in evidence.ranked if r.name == named.name) - limits.ODDS
    rivals = dict[str, Ranked]()
    for r in evidence.ranked[: limits.CROSS_VALIDATED_CANDIDATES]:
        is_refused = any(r.name in note for note in evidence.notes)
        if r.name == named.name or is_refused or not is_contender(r):
            continue
        if r.log_posterior > least or not any(p.discrete for e in (r, named) for p in e.score.candidate.parameters):
            rivals[r.name] = r
    validations = {name: cross_validate(case.linear, r.score) for name, r in rivals.items()}
    left_out = dict(evidence.left_out) | validations
    ahead = [name for name, validation in validations.items() if validation.better_than(left_out[named.name])]
    better = min(ahead, key=lambda name: validations[name].heldout, default=named.name)
    if better != named.name and _objection(rivals[better], validations[better]) is None:
        # The better one is named instead, and the name is one of its rivals.
        rivals, named = rivals | {named.name: named}, rivals[better]
    as_good = [r for name, r in rivals.items() if r is not named and left_out[name].as_good_as(left_out[named.name])]
    if as_good and not case.many_views:
        pair = _pair_that_stands(case, evidence, evidence.explanation[0])
        if pair is not None:
            return Reply(f"none beside {pair[1].name}", both_missing(pair))
    return Reply(names_of(as_good) or "none", {"explanation": (named, *as_good), "left_out": left_out})


def is_a_likelier_effect_not_needed(case: Case, evidence: Evidence) -> Reply | None:
    """Is an effect that alone explains more than the name not needed beside what is named?

    If it is certain even with the named effect in the model, there are two cases. Of few views, if the name is certain
    beside it too, both are missing; otherwise these views cannot tell the two apart.
    """
    first = evidence.ranked[0]
    named = evidence.named[:1]
    missing = {r.name for r in (*named, *evidence.together, evidence.second) if r is not None}
    if evidence.verdict != "missing_effect" or first.name in missing or not is_contender(first):
        return None
    if any(first.name in note for note in evidence.notes):
        return Reply("what speaks against it is said")
    tests = len(evidence.ranked)
    with_name = conditioned_on_effects(case.linear, evidence.together or named)
    first_beside_name = rank_one(with_name, first.score.candidate, tests)
    if not is_certain(first_beside_name):
        return Reply(f"no: {first.name} is not")
    name_beside_first = rank_one(conditioned_on_effects(case.linear, [first]), named[0].score.candidate, tests)
    if is_certain(name_beside_first) and not case.many_views:
        pair = (name_beside_first, first_beside_name)
        return Reply(f"both are missing: {names_of(pair)}", both_missing(pair))
    return Reply(f"yes: {first.name}", {"explanation": (*named, first), "further": None, "together": ()})


def does_the_arm_do_what_hangs_at_it(case: Case, evidence: Evidence) -> Reply | None:
    """Does an effect of the arm do what hangs at it is said to do, or what hangs at it the jump of a joint?

    Two cases arise. For labelled points, a mount or part that droops under gravity may be an arm that does: over few
    joints both follow the same curve. And a jump of a joint may be a jump of the part or the mount: no view tells a
    step of the last joint from a part that turned about its axis. Contenders of the other kind whose pattern correlates
    beyond a limit form a group with the name.
    """
    linear = case.linear
    if evidence.verdict != "missing_effect":
        return None
    named = evidence.named[0]
    scored = named.score
    effect = scored.candidate.effect
    jumps = effect.place in ARM_PLACES and any(p.discrete for p in scored.candidate.parameters)
    droops = not linear.measurement.capture.scans and any(need.startswith("gravity_at") for need in effect.needs)
    if not jumps and not droops:
        return None
    pattern = linear.residual(scored.form.columns) @ scored.values
    least_share = limits.SAME_CORRELATION if jumps else limits.ALIAS_CORRELATION
    aliases = list[Ranked]()
    for r in filter(is_contender, evidence.ranked):
        of_arm = r.score.candidate.effect.place in ARM_PLACES
        form = r.score.form if jumps else r.score.candidate.forms[0]
        is_of_other_kind = of_arm != jumps and form.term.gridded.any() == jumps
        if is_of_other_kind and imitated_share(pattern, linear.residual(form.columns) * form.sizes) > least_share:
            aliases.append(r)
    explanation = (named, *aliases) if jumps else (*aliases, named)
    changes = {"explanation": explanation, "further": None, "together": ()} if aliases else {}
    return Reply(names_of(aliases) or "no", changes)


def is_its_size_believable(case: Case, evidence: Evidence) -> Reply | None:
    """Is the name of a believable size, or else another that is missing beside it, which then goes first?"""
    large = too_large(evidence.named) if evidence.verdict == "missing_effect" else ()
    if not large:
        return None
    first, *others = evidence.together or _named_effects(evidence)
    believable = next((r for r in others if not too_large((r,))), None)
    if believable is None:
        return Reply("no, and there is no other")
    rest = (first, *(r for r in others if r is not believable))
    note = f"{first.name} is missing too, but {beyond_belief_text(large)}"
    changes = {"explanation": (believable,), "further": rest[0], "together": (believable, *rest)}
    return Reply(f"{believable.name} is", {**changes, "notes": (*evidence.notes, note)})


def does_a_joint_turn_back(case: Case, evidence: Evidence) -> Reply | None:
    """Does a joint turn back where a jump in time is named, so that this session cannot tell the two apart?

    If joints change their direction at the view of the jump, backlash would show there too. Backlash is then named with
    the jump as a group; where it cannot be tested, the finding has no name. A jump among further missing effects is
    only taken out of these.
    """
    if evidence.verdict != "missing_effect":
        return None
    views = case.linear.measurement.views
    named = evidence.named[0]
    coincidences = {r.name: _coincidence(views, r) for r in (named, *evidence.together)}
    if not any(coincidences.values()):
        return Reply("no")
    rest = tuple(r for r in evidence.together if not coincidences[r.name])
    notes = (*evidence.notes, *(text for name, text in coincidences.items() if text and name != named.name))
    text = coincidences[named.name]
    if not text:
        further = evidence.further and next(iter(rest[1:]), None)
        return Reply("not where the name jumps", {"together": rest, "further": further, "notes": notes})
    rival = next((r for r in evidence.ranked if r.name == _BY_DIRECTION and r.score.observable), None)
    if rival is None:
        return Reply(text, {"unmodelled_explains_it": True, "notes": (text, *notes)})
    changes = {"explanation": (named, rival), "further": None, "together": (), "notes": notes, "coincidence": text}
    return Reply(text, changes)


def could_it_be_the_base(case: Case, evidence: Evidence) -> Reply | None:
    """Where a joint errs: does the base do as much about the same axis, and follow the same?

    The base cannot follow a joint's own angle or torque. So for a named effect only laws of a joint that follow
    something else, such as time, are compared; without a name, all laws that are told.
    """
    said_by = case.dictionary.said_by
    if evidence.named and not evidence.second:
        of_joints = (r for r in evidence.laws if law_of(r).place.joint and not law_of(r).driver.name.startswith("j"))
        pairs = ((r, named) for r in of_joints for named in evidence.named if named.name in said_by[law_of(r).key])
        law, effect = next(pairs, (None, None))
        if law is None or effect is None:
            return None
        of_base = laws_of_base(case.linear, case.dictionary, (law,), effect.score)
        # A law that a named effect says is no rival of the name.
        names = {r.name for r in evidence.named}
        of_base = tuple(r for r in of_base if not names & said_by[law_of(r).key])
        return Reply(names_of(of_base) or "no", {"rival_laws": (*evidence.rival_laws, *of_base)})
    if evidence.named or not evidence.reported_laws:
        return None
    of_base = laws_of_base(case.linear, case.dictionary, evidence.reported_laws)
    laws = {law_of(r).key: r for r in (*evidence.laws, *of_base)}
    return Reply(names_of(of_base) or "no", {"laws": likeliest_first(laws.values())} if of_base else {})


TESTS: tuple[Question, ...] = (
    does_it_hold_elsewhere,
    does_the_scanner_explain_it,
    does_it_hold_with_a_second,
    which_predict_as_well,
    is_a_likelier_effect_not_needed,
    does_the_arm_do_what_hangs_at_it,
    is_its_size_believable,
    does_a_joint_turn_back,
    could_it_be_the_base,
)


def overlap_misfit_beyond_noise(linear: LinearModel, stated_noise: float | None = None) -> float:
    """Do the overlaps keep a misfit however the views are moved?

    A seam or a ripple in the scanner's field, or a part that changes its shape, shows in overlaps, and no poses take it
    away. The noise is the scatter about the surface within each scan (`noise_floor`), whatever a data sheet says.

    Args:
        stated_noise: of the scanner, length_unit, for scans too small to show their own.

    Returns:
        The rms of the misfit without the noise, length_unit, where it is larger than the noise; else 0. It is 0 too
        where no overlap of surfaces was observed.
    """
    surfaces = surfaces_of(linear)
    if surfaces is None:
        return 0.0
    overlaps = surfaces.unconstrained.overlaps
    noise = noise_floor(surfaces.capture, overlaps, stated_noise)
    misfit = float(max(overlaps.gram.rms**2 - noise**2, 0.0) ** 0.5)
    return misfit if misfit > noise else 0.0


def find_scanner_error(linear: LinearModel, other_terms: Sequence[Term] = ()) -> FieldError | None:
    """Return smooth errors of the scans if they are larger than those of usual scanners; None if they are not.

    They may be smaller than the noise of a point, which many points average away. None also without overlaps of clouds.

    Args:
        other_terms: effects of points, fitted beside the error with any size.
    """
    return _unusual_field_error(linear, other_terms) if other_terms else lone_scanner_error(linear)


@remembered
def lone_scanner_error(linear: LinearModel) -> FieldError | None:
    """Return `find_scanner_error` without further effects: kept, since several questions ask for it."""
    return _unusual_field_error(linear, ())


def _unusual_field_error(linear: LinearModel, other_terms: Sequence[Term]) -> FieldError | None:
    surfaces = surfaces_of(linear)
    if surfaces is None:
        return None
    error = field_error(linear.measurement, linear.model, surfaces.unconstrained, limits.ALPHA_UNKNOWN, other_terms)
    return error if error.unusual else None


def pair_is_validated(linear: LinearModel, pair: tuple[Ranked, Ranked]) -> bool:
    """Return whether each of two effects predicts views left out with the other in the model, where it was scored."""
    return not any(
        _objection(one, cross_validate(conditioned_on_effects(linear, [other]), one.score))
        for one, other in (pair, pair[::-1])
    )


def _named_effects(evidence: Evidence) -> list[Ranked]:
    """Return the effects that are named, and the second one that is missing beside them."""
    return [r for r in (*evidence.named, evidence.second) if r is not None]


def _objection(effect: Ranked, left_out: CrossValidation) -> str | None:
    """Return the reason, as text, to reject an effect: it rests on one view, predicts no others, or differs in halves.

    None where it passes all three tests.

    Args:
        left_out: its cross-validation.
    """
    if left_out.steadiness < limits.MIN_STEADINESS:
        return f"{effect.name} rests on one view: without it {max(left_out.steadiness, 0):.0%} of the effect remain"
    if not left_out.helps:
        share = f"{left_out.poses:.2f} ± {left_out.poses_sigma:.2f}"
        return f"{effect.name} does not help on views left out: it leaves a mean square pose error of {share} of now"
    return objection_in_halves(effect.score)


def _scanner_error_in_place_of(linear: LinearModel, evidence: Evidence) -> FieldError | None:
    """Return smooth errors of the scans if they explain at least as much as the effect that is named; else None.

    Named effects that change points are fitted beside the error: it may not claim what they explain.
    """
    terms = [r.score.form.term for r in _named_effects(evidence)]
    error = find_scanner_error(linear, other_terms=[term for term in terms if moves_points([term])])
    return error if scanner_explains_it(replace(evidence, scanner_error=error)) else None


def _pair_that_stands(case: Case, evidence: Evidence, first: Ranked) -> tuple[Ranked, Ranked] | None:
    """Return an effect and a second one that is missing beside it, if both pass every test beside each other.

    None where there is no second effect, where it replaces the first, or where the scanner explains as much.
    """
    pair = find_missing_pair(case, first)
    if pair is None or pair[0].name != first.name or not pair_is_validated(case.linear, pair):
        return None
    both = replace(evidence, refuted=False, scanner_error=None, **both_missing(pair))
    return pair if _scanner_error_in_place_of(case.linear, both) is None else None


def _coincidence(views: Views, ranked: Ranked) -> str:
    """Return a text on joints that change their direction at the view where an effect jumps; "" without such.

    It is "" also for an effect without a jump.
    """
    event = next((p for p in ranked.score.form.term.parameters if p.discrete), None)
    joints = [] if event is None else _joints_turning_at(views, event.value)
    if event is None or not joints:
        return ""
    which = f"joint {joints[0]} comes" if len(joints) == 1 else f"joints {', '.join(map(str, joints))} come"
    return f"{ranked.name} begins at view {event.view}, and from there on {which} from the other side"


def _joints_turning_at(views: Views, first: float) -> list[int]:
    """Return the joints, counted from 1, whose moves go one way before a view and the other way from it on.

    On each side at least `_ONE_WAY` of at least `_FEWEST_MOVES` moves must go the same way.

    Args:
        first: number of the view at which an event begins.
    """
    joints = list[int]()
    after = views.number >= first
    for joint, approach in enumerate(views.approach.T, 1):
        moves = [approach[part & (approach != 0)] for part in (~after, after)]
        if min(map(len, moves)) < _FEWEST_MOVES:
            continue
        # 1 where all moves go up, −1 where all go down.
        before_event, after_event = (2 * np.mean(part > 0) - 1 for part in moves)
        one_way = min(abs(before_event), abs(after_event)) >= 2 * _ONE_WAY - 1
        if one_way and before_event * after_event < 0:
            joints.append(joint)
    return joints
