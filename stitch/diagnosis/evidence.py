"""Evidence for a verdict, gathered by questions that are asked in order.

`NAMING` asks which effects would explain the views and what explains them as well; `TESTS` hold what is named against
views left out, halves of the views, the scanner's own errors and rivals that predict as well. Each question changes the
evidence at most, and its answer is kept (`Evidence.answers`): the last one that changed what is named decided.

A candidate is scored without its own share of the pose errors (`score`), while every other joint and link may err by as
much as the views show. What two effects can both do no single one is wanted for, since the errors that remain do the
other's part: then the smallest set is sought without which the views cannot do (`required_group`).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from stitch.diagnosis import thresholds as limits
from stitch.diagnosis.candidates import Candidate
from stitch.diagnosis.ranking import (
    Ranked,
    beyond_belief_text,
    conditioned_on_effects,
    is_certain,
    is_contender,
    rank,
    rank_all,
    rank_one,
    rescored_against,
    stands_out,
    too_large,
)
from stitch.diagnosis.regime import regime_of
from stitch.diagnosis.score import ScatterLimit, beyond_expected, expected_scatter, implausible, promising, score
from stitch.diagnosis.sensitivity import imitated_share
from stitch.diagnosis.stepwise_selection import forward_selection, keep_worth_adding
from stitch.diagnosis.systematic_laws import Dictionary, dictionary_of, law_of, laws_of_base, rank_laws
from stitch.diagnosis.unmodelled_time_effects import (
    find_repeating_errors,
    least_log_bayes_factor,
    unmodelled_log_posterior,
)
from stitch.diagnosis.validation import CrossValidation, cross_validate, objection_in_halves
from stitch.diagnosis.verdict import Answer, Evidence, scanner_explains_it
from stitch.model.forward import moves_points
from stitch.model.model import ARM_PLACES, Term
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.field_error import FieldError, field_error
from stitch.observations.surfaces.surface_model import surfaces_of
from stitch.observations.surfaces.view_poses import noise_floor
from stitch.session.measurement import Views
from stitch.system.threads import parallel

# The effect of the direction from which a joint comes.
_BY_DIRECTION = "backlash"
# Share of a joint's moves on either side of a jump that go one way, and the moves there must be to tell.
_ONE_WAY, _FEWEST_MOVES = 0.95, 3


class Reply(NamedTuple):
    """An answer in words, what it changes in the evidence, and whether the next questions do not arise."""

    text: str
    changes: Mapping[str, Any] = {}
    ends: bool = False


class Case(NamedTuple):
    """What all questions are asked about: the views of a session, and effects that could be missing."""

    linear: LinearModel
    candidates: Sequence[Candidate]
    dictionary: Dictionary

    @property
    def many_views(self) -> bool:
        """True where many views tell several effects apart at once."""
        return regime_of(self.linear).many_views


# A question; None where it does not arise.
Question = Callable[[Case, Evidence], Reply | None]


def gather_evidence(
    linear: LinearModel, candidates: Sequence[Candidate], limit: ScatterLimit, overlap_misfit: float = 0.0
) -> Evidence:
    """Return all that the views say for and against every effect; the verdict follows from it.

    Args:
        overlap_misfit: rms that no motion of the views removes (`overlap_misfit_beyond_noise`), length_unit.
    """
    case = Case(linear, candidates, dictionary_of(linear, candidates))
    proposed = _propose_names(case, limit)
    evidence = ask(TESTS, case, replace(proposed, proposed=proposed))
    if overlap_misfit:
        misfit = Reply("yes, beyond the noise", {"overlap_misfit": overlap_misfit})
        evidence = _answered(evidence, overlap_misfit_beyond_noise, misfit)
    return evidence


def propose_names(linear: LinearModel, candidates: Sequence[Candidate], limit: ScatterLimit) -> Evidence:
    """Return the effects that would explain the views, and what explains them as well; nothing is left out yet."""
    return _propose_names(Case(linear, candidates, dictionary_of(linear, candidates)), limit)


def _propose_names(case: Case, limit: ScatterLimit) -> Evidence:
    ranked, empirical = rank_all(case.linear, case.candidates)
    laws = rank_laws(case.linear, case.dictionary)
    evidence = Evidence(
        ranked,
        empirical,
        laws=laws,
        dictionary=case.dictionary,
        implausible_scatter=implausible(case.linear, limit),
        beyond_expected=beyond_expected(case.linear, expected_scatter(case.linear, limit)),
    )
    return ask(NAMING, case, evidence)


def ask(questions: Sequence[Question], case: Case, evidence: Evidence) -> Evidence:
    """Return the evidence after questions that were asked in order, with their answers."""
    for question in questions:
        reply = question(case, evidence)
        if reply is None:
            continue
        evidence = _answered(evidence, question, reply)
        if reply.ends:
            break
    return evidence


def _answered(evidence: Evidence, question: Callable[..., object], reply: Reply) -> Evidence:
    """Return the evidence with what a reply changes, and with the answer; a docstring's first line is the question."""
    after = replace(evidence, **reply.changes)
    changed = after.verdict != evidence.verdict or [r.name for r in after.named] != [r.name for r in evidence.named]
    sentence = (question.__doc__ or "").strip().splitlines()[0]
    answer = Answer(question.__name__, sentence, reply.text, changed)
    return replace(after, answers=(*evidence.answers, answer))


def is_anything_certain(case: Case, evidence: Evidence) -> Reply | None:
    """Is an effect certain by itself, or a shape without a cause?"""
    certain = [r for r in evidence.ranked if is_certain(r)]
    shapes = [r for r in (*evidence.empirical, *evidence.laws) if stands_out(r)]
    shape = max(shapes, key=lambda r: r.log_posterior, default=None)
    if shape is None and not certain:
        return Reply("no")
    return Reply(_names(certain) or "a shape without a cause", {"alarm": True, "shape": shape})


def are_several_required(case: Case, evidence: Evidence) -> Reply | None:
    """Are several effects required of which none is certain by itself?"""
    if evidence.alarm:
        return None
    group = required_group(case.linear, case.candidates, len(evidence.ranked))
    return Reply(_names(group) or "no", {"explanation": group}, ends=bool(group))


def which_explains_most(case: Case, evidence: Evidence) -> Reply | None:
    """Which effect explains most, where none that could be named is among the errors that remain?"""
    if not evidence.alarm:
        return None
    contenders = [r for r in evidence.ranked if is_contender(r)]
    if not contenders:
        return Reply("none that could be named", ends=True)
    first = contenders[0]
    while hidden := _hidden_contenders(case, contenders):
        contenders += hidden
    base = _without(case.linear, contenders)
    if len(contenders) > 1 and base is not case.linear:
        # There their Bayes factors are over one and the same.
        contenders = [rescored_in(base, r) for r in contenders]
    ranked = _with_hidden(evidence.ranked, first, contenders)
    laws = evidence.laws if base is case.linear else rank_laws(base, case.dictionary)
    contenders = sorted((case.dictionary.credited(r, laws) for r in contenders), key=lambda r: -r.log_posterior)
    best = contenders[0]
    rivals = case.dictionary.without(base, laws, best)
    unmodelled = max([unmodelled_log_posterior(base), *(r.log_posterior for r in rivals)])
    shapes = [r for r in (*evidence.empirical, *rivals) if stands_out(r)]
    shape = max(shapes, key=lambda r: r.log_posterior, default=None)
    changes = {
        "laws": laws,
        "explanation": (best,),
        "together": (best,),
        "shape": shape and (shape if shape in rivals else rescored_in(base, shape)),
        "contenders": tuple(contenders),
        "base": base,
        "unmodelled_log_posterior": unmodelled,
        "ranked": rescored_against(ranked, best, unmodelled),
    }
    return Reply(best.name, changes)


def _without(linear: LinearModel, effects: Sequence[Ranked]) -> LinearModel:
    """Return the model in which none of the effects is among the errors that remain."""
    return linear.restricted(linear.causes - {r.name for r in effects})


def _hidden_contenders(case: Case, contenders: Sequence[Ranked]) -> list[Ranked]:
    """Return effects that could be named only where no contender is among the errors that remain: a base that gives
    way, or an uneven gear, explains nothing beside joints that may give way by as much as the views show."""
    base = _without(case.linear, contenders)
    if base is case.linear:
        return []
    known = {r.name for r in contenders}
    weak = [c for c in case.candidates if not c.empirical and c.name not in known]
    remaining = [c for c in weak if c.name in base.causes]
    likely = promising(base, [c for c in weak if c not in remaining], limits.CANDIDATES_TRIED)
    tried = [*remaining, *(candidate for candidate, _ in likely)]
    again = rank(list(parallel(partial(score, base), tried)), contenders[0].tests)[0]
    return [r for r in again if is_contender(r)]


def _with_hidden(ranked: Sequence[Ranked], first: Ranked, contenders: Sequence[Ranked]) -> tuple[Ranked, ...]:
    """Return the ranking with those contenders that were none in it; posterior shares make room for them.

    Args:
        first: the contender that was the likeliest.
        contenders: as they are scored now.
    """
    now = {r.name: r for r in contenders}
    hidden = [now[r.name] for r in ranked if r.name in now and not is_contender(r)]
    behind = {r.name: r.log_posterior - now[first.name].log_posterior for r in hidden}
    for name in behind:
        ranked = rescored_against(ranked, first, first.log_posterior + behind[name])
    share = next(r.posterior for r in ranked if r.name == first.name)
    beside = dict[str, Ranked]()
    for r in hidden:
        less = r.score.log_bayes_factor - now[first.name].score.log_bayes_factor
        beside[r.name] = replace(
            r,
            score=replace(r.score, log_bayes_factor=first.score.log_bayes_factor + less),
            log_posterior=first.log_posterior + behind[r.name],
            posterior=share * float(np.exp(behind[r.name])),
        )
    return tuple(sorted((beside.get(r.name, r) for r in ranked), key=lambda r: -r.log_posterior))


def which_hold_together(case: Case, evidence: Evidence) -> Reply | None:
    """Of many views: which effects are missing at once, each holding its place beside the others?"""
    if not evidence.alarm or not case.many_views:
        return None
    best = evidence.explanation[0]
    shape = evidence.shape
    selection = forward_selection(case.linear, case.candidates, best)
    explained = max(selection.explained, best.log_posterior)
    nothing = {"explanation": (), "together": (), **_refusals(selection.refused)}
    if shape is not None and shape.log_posterior > explained + limits.ODDS:
        return Reply("none: a shape without a cause explains more", nothing, ends=True)
    if selection.refused and not selection.effects:
        return Reply("none holds beyond the measured poses", nothing, ends=True)
    effects, idle = list(selection.effects or (best,)), dict[str, str]()
    if not regime_of(case.linear).prior:
        effects, idle = keep_worth_adding(case.linear, effects, sum(not c.empirical for c in case.candidates))
    refused = _refusals(selection.refused | idle)
    if not effects:
        return Reply("none helps on views left out", {**nothing, **refused, "alarm": False})
    further = effects[1] if len(effects) > 1 else None
    changes = {"explanation": tuple(effects[:1]), "further": further, "together": tuple(effects), **refused}
    return Reply(_names(effects), changes)


def do_poses_err_without_a_name(case: Case, evidence: Evidence) -> Reply | None:
    """Where no effect is wanted: do the poses err again in a way that has no name?"""
    if evidence.alarm:
        return None
    errors = find_repeating_errors(case.linear)
    text = "they " + " and ".join(error.words for error in errors) if errors else "no"
    return Reply(text, {"repeating_errors": errors}, ends=True)


def does_an_unmodelled_effect_explain_it(case: Case, evidence: Evidence) -> Reply | None:
    """Of few views: does something without a name explain them as well, alone and beside a second effect?

    Two known effects at once may look like none of them: the best is tried with a second one.
    """
    if case.many_views:
        return None
    best = evidence.explanation[0]
    if not _beaten_by_unmodelled(best.log_posterior, evidence):
        return Reply("no")
    second = find_second_effect(case.linear, case.candidates, best)
    if second is not None:
        prior = float(np.log(limits.PRIOR_PHYSICAL / len(evidence.ranked)))
        of_both = best.log_posterior + (second.score.log_bayes_factor + prior)
        if not _beaten_by_unmodelled(of_both, evidence):
            # The likelier one beside the other goes first, which alone may have been the weaker.
            beside = rank_one(conditioned_on_effects(case.linear, [second]), best.score.candidate, second.tests)
            pair = (best, second) if beside.log_posterior >= second.log_posterior else (second, beside)
            return Reply(f"not beside {second.name}", _naming(pair))
    return Reply("yes", {"unmodelled_explains_it": True}, ends=True)


def is_it_wanted_beside_smooth_errors(case: Case, evidence: Evidence) -> Reply | None:
    """Is it wanted beside the others and beside any trend without a name, of a joint or in time?

    A trend that is as likely is a rival: these views cannot tell it from the effect. One that is likelier explains them
    instead.
    """
    if regime_of(case.linear).prior:
        return None  # the prior of pose errors has asked already
    best, *others = evidence.together
    factor, trend = least_log_bayes_factor(conditioned_on_effects(case.linear, others), best.score)
    if factor > limits.ODDS:
        return Reply("yes")
    if factor > -limits.ODDS:
        return Reply(f"or {trend}", {"rival_trend": trend})
    note = f"{best.name}: an unnamed error, smooth in the joint angles or in time, explains these views better"
    return Reply("no", {"unmodelled_explains_it": True, "notes": (*evidence.notes, note)}, ends=True)


def which_come_near(case: Case, evidence: Evidence) -> Reply | None:
    """Which other effects come within 20 to 1?"""
    if evidence.further is not None:
        return None  # each was asked beside the other
    best = evidence.explanation[0]
    others = [r for r in evidence.contenders if r.name != best.name and r.name not in evidence.refused]
    near = [r for r in others if r.comes_near(best)]
    return Reply(_names(near) or "none", {"explanation": (best, *near)})


def which_laws_come_near(case: Case, evidence: Evidence) -> Reply | None:
    """Which laws that are no effect's come within 20 to 1, wherever they act and whatever they follow?"""
    best, *others = evidence.together or evidence.explanation
    base = conditioned_on_effects(evidence.base or case.linear, others)
    laws = rank_laws(base, case.dictionary) if others else evidence.laws
    rivals = case.dictionary.without(base, laws, best)
    near = tuple(r for r in rivals if r.log_posterior > best.log_posterior - limits.ODDS and stands_out(r))
    return Reply(_names(near) or "none", {"rival_laws": near})


def are_two_missing(case: Case, evidence: Evidence) -> Reply | None:
    """Of few views: are two missing, of which one alone took for itself what both do?"""
    if len(evidence.explanation) == 1 or case.many_views:
        return None
    pair = find_missing_pair(case.linear, case.candidates, evidence.explanation[0])
    return Reply("no") if pair is None else Reply(_names(pair), _naming(pair))


NAMING: tuple[Question, ...] = (
    is_anything_certain,
    are_several_required,
    which_explains_most,
    which_hold_together,
    do_poses_err_without_a_name,
    does_an_unmodelled_effect_explain_it,
    is_it_wanted_beside_smooth_errors,
    which_come_near,
    are_two_missing,
    which_laws_come_near,
)


def does_it_hold_elsewhere(case: Case, evidence: Evidence) -> Reply | None:
    """Does it hold on views left out and in halves of the views?

    Every effect that may be named is asked beside all that it was named beside or, where pose errors have no prior,
    alone, as it would be added next. A second effect takes the place of a first that does not hold, where the second
    holds alone too and is certain there.
    """
    effects = _named_effects(evidence)
    alone = {r.name: r for r in evidence.ranked}
    asked = {r.name: (r if r.score.base_model else alone[r.name]).score for r in effects}
    left_out = {name: cross_validate(case.linear, scored) for name, scored in asked.items()}
    if len(evidence.named) != 1:
        return Reply("not asked of a group", {"left_out": left_out}) if effects else None
    objections = list[str]()
    for effect in effects:
        objection = _objection(effect, left_out[effect.name])
        if objection is None:
            break
        objections.append(objection)
    else:
        notes = (*evidence.notes, objections[0])
        return Reply(objections[0], {"left_out": left_out, "refuted": True, "notes": notes})
    if effect is effects[0]:
        return Reply("yes", {"left_out": left_out})
    second = alone[effect.name]
    changes = {"left_out": left_out, "explanation": (second,), "further": None}
    refuted = not is_certain(second)
    if not refuted and (objection := _objection(second, cross_validate(case.linear, second.score))) is not None:
        refuted = True
        objections.append(objection)
    return Reply("; ".join(objections), {**changes, "refuted": refuted, "notes": (*evidence.notes, *objections)})


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
    """Of few views: does a name that fell hold beside a second effect?

    What that one did made the first another in each half of the views, or looked like a smooth error of the scanner.
    """
    proposed = evidence.proposed
    if proposed is None or proposed.verdict != "missing_effect" or evidence.named or case.many_views:
        return None
    pair = _pair_that_stands(case, replace(evidence, explanation=proposed.explanation))
    if pair is None:
        return Reply("no")
    back = {"notes": proposed.notes, "refuted": False, "scanner_error": None}
    return Reply(f"yes, beside {pair[1].name}", {**_naming(pair), **back})


def which_predict_as_well(case: Case, evidence: Evidence) -> Reply | None:
    """Which contenders predict views left out as well as a single name, or better?

    These views cannot tell it from those. One that predicts them clearly better and stands every other test takes the
    place of the name: a Bayes factor charges for plausible sizes that may be wrong, as a user's are, and what was not
    seen does not. What a second effect leaves on views left out may hide by how much the first predicts them better.
    What begins at some view may begin at nearly the first, where it is what lasts, and views left out beside a jump say
    little of it: of such the odds decide.
    """
    if evidence.verdict != "missing_effect" or evidence.second is not None:
        return None
    named = evidence.named[0]
    least = next(r.log_posterior for r in evidence.ranked if r.name == named.name) - limits.ODDS
    rivals = {
        r.name: r
        for r in evidence.ranked[: limits.CROSS_VALIDATED_CANDIDATES]
        if r.name != named.name and is_contender(r) and not any(r.name in note for note in evidence.notes)
        if r.log_posterior > least or not any(p.discrete for e in (r, named) for p in e.score.candidate.parameters)
    }
    of_rivals = {name: cross_validate(case.linear, r.score) for name, r in rivals.items()}
    left_out = dict(evidence.left_out) | of_rivals
    ahead = [name for name, validation in of_rivals.items() if validation.better_than(left_out[named.name])]
    better = min(ahead, key=lambda name: of_rivals[name].heldout, default=named.name)
    if better != named.name and _objection(rivals[better], of_rivals[better]) is None:
        rivals, named = rivals | {named.name: named}, rivals[better]
    as_good = [r for name, r in rivals.items() if r is not named and left_out[name].as_good_as(left_out[named.name])]
    if as_good and not case.many_views:
        pair = _pair_that_stands(case, evidence)
        if pair is not None:
            return Reply(f"none beside {pair[1].name}", _naming(pair))
    return Reply(_names(as_good) or "none", {"explanation": (named, *as_good), "left_out": left_out})


def is_a_likelier_effect_not_needed(case: Case, evidence: Evidence) -> Reply | None:
    """Is an effect that alone explains more than the name not needed beside what is named?

    If it is wanted all the same, these views cannot tell the two apart, or of few views both are missing.
    """
    first = evidence.ranked[0]
    named = evidence.named[:1]
    missing = {r.name for r in (*named, *evidence.together, evidence.second) if r is not None}
    if evidence.verdict != "missing_effect" or first.name in missing or not is_contender(first):
        return None
    if any(first.name in note for note in evidence.notes):
        return Reply("what speaks against it is said")
    tests = len(evidence.ranked)
    beside = conditioned_on_effects(case.linear, evidence.together or named)
    again = rank_one(beside, first.score.candidate, tests)
    if not is_certain(again):
        return Reply(f"no: {first.name} is not")
    other = rank_one(conditioned_on_effects(case.linear, [first]), named[0].score.candidate, tests)
    if is_certain(other) and not case.many_views:
        return Reply(f"both are missing: {_names((other, again))}", _naming((other, again)))
    return Reply(f"yes: {first.name}", {"explanation": (*named, first), "further": None, "together": ()})


def does_the_arm_do_what_hangs_at_it(case: Case, evidence: Evidence) -> Reply | None:
    """Does an effect of the arm do what hangs at it is said to do, or what hangs at it the jump of a joint?

    Over a sweep of few joints gravity bends either alike, and reflectors weigh grams: these views cannot tell. Nor does
    any view tell a step of the last joint from a part that turned about its axis.
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
    alike = []
    for r in filter(is_contender, evidence.ranked):
        of_arm = r.score.candidate.effect.place in ARM_PLACES
        form = r.score.form if jumps else r.score.candidate.forms[0]
        if of_arm == jumps or form.term.gridded.any() != jumps:
            continue
        least = limits.SAME_CORRELATION if jumps else limits.ALIAS_CORRELATION
        if imitated_share(pattern, linear.residual(form.columns) * form.sizes) > least:
            alike.append(r)
    explanation = (named, *alike) if jumps else (*alike, named)
    changes = {"explanation": explanation, "further": None, "together": ()} if alike else {}
    return Reply(_names(alike) or "no", changes)


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

    A path that was driven once shows both at the same view. A jump that is missing beside other effects is not added
    with them.
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

    Of an effect with a name only where it follows nothing of the joints, which the base knows nothing of.
    """
    said_by = case.dictionary.said_by
    if evidence.named and not evidence.second:
        of_joints = (r for r in evidence.laws if law_of(r).place.joint and not law_of(r).driver.name.startswith("j"))
        pairs = ((r, named) for r in of_joints for named in evidence.named if named.name in said_by[law_of(r).key])
        law, effect = next(pairs, (None, None))
        if law is None or effect is None:
            return None
        of_base = laws_of_base(case.linear, case.dictionary, (law,), effect.score)
        # What has a name is told by it.
        names = {r.name for r in evidence.named}
        of_base = tuple(r for r in of_base if not names & said_by[law_of(r).key])
        return Reply(_names(of_base) or "no", {"rival_laws": (*evidence.rival_laws, *of_base)})
    if evidence.named or not evidence.told_laws:
        return None
    of_base = laws_of_base(case.linear, case.dictionary, evidence.told_laws)
    laws = {law_of(r).key: r for r in (*evidence.laws, *of_base)}
    ranked = tuple(sorted(laws.values(), key=lambda r: -r.log_posterior))
    return Reply(_names(of_base) or "no", {"laws": ranked} if of_base else {})


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

    A seam or a ripple in the scanner's field, a corner that is off, a part that changes its shape: overlaps show it,
    and the poses that fit best take only a share of it.

    Args:
        stated_noise: of the scanner, for scans too small to show their own.

    Returns:
        Its rms (length_unit) beside the noise, where it is more than that; else 0, and where no overlap of surfaces was
        observed. The noise is the scatter about the surface within each scan (`noise_floor`), whatever a data sheet
        says.
    """
    surfaces = surfaces_of(linear)
    if surfaces is None:
        return 0.0
    overlaps = surfaces.unconstrained.overlaps
    noise = noise_floor(surfaces.capture, overlaps, stated_noise)
    misfit = float(max(overlaps.gram.rms**2 - noise**2, 0.0) ** 0.5)
    return misfit if misfit > noise else 0.0


def find_scanner_error(linear: LinearModel, other_terms: Sequence[Term] = ()) -> FieldError | None:
    """Return smooth errors of the scans where they are larger than every scanner's; None where overlaps show no such.

    It may be small beside the noise: many points average that, and not what is the same in every view.

    Args:
        other_terms: effects of points that may have any size.
    """
    surfaces = surfaces_of(linear)
    if surfaces is None:
        return None
    error = field_error(linear.measurement, linear.model, surfaces.unconstrained, limits.ALPHA_UNKNOWN, other_terms)
    return error if error.unusual else None


def required_group(linear: LinearModel, candidates: Sequence[Candidate], tests: int) -> tuple[Ranked, ...]:
    """Return effects of which some are wanted though none is alone, likeliest first; () if the views do without any.

    Args:
        tests: candidates among which the best is chosen.
    """
    families = () if linear.pose_errors is None else tuple(linear.pose_errors.effects)
    without_families = linear.restricted(linear.causes - set(families))
    if not families or without_families.null.deviance < linear.null.deviance:
        # No error of joints or links helps: none stands in for another.
        return ()
    known = {c.name: c for c in candidates if not c.empirical}
    ranked = rank([score(without_families, c) for c in known.values()], tests)[0]
    best = next((r for r in ranked if is_certain(r)), None)
    if best is None:
        return ()
    asked = known[best.name]
    removed = {best.name}
    while not is_certain(rank_one(linear.restricted(linear.causes - removed), asked, tests)):
        others = [name for name in families if name in known and name not in removed]
        if not others:
            return ()
        bases = {name: linear.restricted(linear.causes - removed - {name}) for name in others}
        removed.add(max(others, key=lambda name: score(bases[name], asked).log_bayes_factor))
    base = linear.restricted(linear.causes - removed)
    again = rank([score(base, c) for c in known.values() if c.name in removed], tests)[0]
    if unmodelled_log_posterior(base) > again[0].log_posterior - limits.ODDS:
        return ()
    near = [r for r in again if is_contender(r) and r.comes_near(again[0])]
    # One that is far ahead of the others is still not wanted beside them, all of them being a little wrong.
    return tuple(near) if len(near) > 1 else again


def rescored_in(base: LinearModel, ranked: Ranked) -> Ranked:
    """Return a candidate scored in another model; it counts among as many as before."""
    again = score(base, ranked.score.candidate)
    return replace(
        ranked,
        score=again,
        adjusted=min(1.0, again.p_value * ranked.tests),
        log_posterior=ranked.log_posterior + again.log_bayes_factor - ranked.score.log_bayes_factor,
    )


def find_second_effect(linear: LinearModel, candidates: Sequence[Candidate], best: Ranked) -> Ranked | None:
    """Return the effect that explains most beside the best one, if it is certain."""
    others = [c for c in candidates if c.name != best.name and not c.empirical]
    ranked, _ = rank_all(conditioned_on_effects(linear, [best]), others)
    return next((r for r in ranked if is_certain(r)), None)


def find_missing_pair(
    linear: LinearModel, candidates: Sequence[Candidate], best: Ranked
) -> tuple[Ranked, Ranked] | None:
    """Return two effects where one alone took for itself what both do, each scored beside the other.

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


def pair_is_validated(linear: LinearModel, pair: tuple[Ranked, Ranked]) -> bool:
    """Return whether each of two effects holds on views left out beside the other, beside which it was scored."""
    return not any(
        _objection(one, cross_validate(conditioned_on_effects(linear, [other]), one.score))
        for one, other in (pair, pair[::-1])
    )


def _beaten_by_unmodelled(known: float, evidence: Evidence) -> bool:
    """Return whether something without a name does what effects of the library do.

    A shape without a cause must be 20 to 1 likelier; that a joint or the flange follows nothing that has a name must be
    20 to 1 less likely, as all others that might have the name.

    Args:
        known: log posterior of the effects.
    """
    shape = evidence.shape
    by_shape = shape is not None and shape.log_posterior > known + limits.ODDS
    return by_shape or evidence.unmodelled_log_posterior > known - limits.ODDS


def _refusals(refused: Mapping[str, str]) -> dict[str, Any]:
    """Return the changes; what speaks against several effects is said once."""
    return {"refused": refused, "notes": tuple(dict.fromkeys(refused.values()))}


def _naming(pair: tuple[Ranked, Ranked]) -> dict[str, Any]:
    """Return the changes that name the first of two effects, which are missing both."""
    return {"explanation": pair[:1], "further": pair[1], "together": pair}


def _names(effects: Sequence[Ranked]) -> str:
    return ", ".join(r.name for r in effects)


def _named_effects(evidence: Evidence) -> list[Ranked]:
    return [r for r in (*evidence.named, evidence.second) if r is not None]


def _objection(effect: Ranked, left_out: CrossValidation) -> str | None:
    """Return why an effect does not hold on views left out or in halves of the views; None where it does."""
    if left_out.steadiness < limits.MIN_STEADINESS:
        return f"{effect.name} rests on one view: without it {max(left_out.steadiness, 0):.0%} of the effect remain"
    if not left_out.helps:
        share = f"{left_out.poses:.2f} ± {left_out.poses_sigma:.2f}"
        return f"{effect.name} does not help on views left out: it leaves a mean square pose error of {share} of now"
    return objection_in_halves(effect.score)


def _scanner_error_in_place_of(linear: LinearModel, evidence: Evidence) -> FieldError | None:
    """Return smooth errors of the scans that explain as much as what is named; None where they explain less."""
    terms = [r.score.form.term for r in _named_effects(evidence)]
    error = find_scanner_error(linear, other_terms=[term for term in terms if moves_points([term])])
    return error if scanner_explains_it(replace(evidence, scanner_error=error)) else None


def _pair_that_stands(case: Case, evidence: Evidence) -> tuple[Ranked, Ranked] | None:
    """Return the first of the explanation with a second effect, where both stand every test beside each other."""
    named = evidence.explanation[0]
    pair = find_missing_pair(case.linear, case.candidates, named)
    if pair is None or pair[0].name != named.name or not pair_is_validated(case.linear, pair):
        return None
    both = replace(evidence, refuted=False, scanner_error=None, **_naming(pair))
    return pair if _scanner_error_in_place_of(case.linear, both) is None else None


def _coincidence(views: Views, ranked: Ranked) -> str:
    """Return what else begins where an effect jumps; empty where it does not, or nothing does."""
    event = next((p for p in ranked.score.form.term.parameters if p.discrete), None)
    joints = [] if event is None else _joints_turning_at(views, event.value)
    if event is None or not joints:
        return ""
    which = f"joint {joints[0]} comes" if len(joints) == 1 else f"joints {', '.join(map(str, joints))} come"
    return f"{ranked.name} begins at view {event.view}, and from there on {which} from the other side"


def _joints_turning_at(views: Views, first: float) -> list[int]:
    """Return the joints, counted from 1, that come from one side before a view and from the other side from there on.

    Args:
        first: number of the view, as events count it.
    """
    joints, after = list[int](), views.number >= first
    for joint, approach in enumerate(views.approach.T, 1):
        sides = [approach[part & (approach != 0)] for part in (~after, after)]
        if min(map(len, sides)) < _FEWEST_MOVES:
            continue
        # 1 where all moves go one way, −1 where all go the other.
        before, later = (2 * np.mean(side > 0) - 1 for side in sides)
        if before * later < 0 and min(abs(before), abs(later)) >= 2 * _ONE_WAY - 1:
            joints.append(joint)
    return joints
