"""Which effects would explain the views, and what explains them as well: questions that are asked in order.

Each question of `NAMING` changes the evidence at most, and its answer is kept (`Evidence.answers`): the last one that
changed what is named decided. What is named is then held against views left out and against rivals (`evidence`).

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
from stitch.diagnosis.law_ranking import rank_laws
from stitch.diagnosis.ranking import (
    Ranked,
    conditioned_on_effects,
    is_certain,
    is_contender,
    likeliest_first,
    rank,
    rank_all,
    rank_one,
    rescored_against,
    stands_out,
)
from stitch.diagnosis.regime import regime_of
from stitch.diagnosis.score import ScatterLimit, beyond_expected, expected_scatter, implausible, promising, score
from stitch.diagnosis.stepwise_selection import forward_selection, keep_worth_adding
from stitch.diagnosis.systematic_laws import Dictionary
from stitch.diagnosis.unmodelled_time_effects import (
    find_repeating_errors,
    least_log_bayes_factor,
    unmodelled_log_posterior,
)
from stitch.diagnosis.verdict import Answer, Evidence
from stitch.observations.linear_model import LinearModel
from stitch.system.threads import parallel


class Reply(NamedTuple):
    """What a question replies."""

    text: str
    changes: Mapping[str, Any] = {}  # fields of the evidence with their new values
    ends: bool = False  # the questions behind it are not asked


class Case(NamedTuple):
    """What all questions are asked about: the views of a session, and what could be missing in their model."""

    linear: LinearModel
    candidates: Sequence[Candidate]  # effects
    dictionary: Dictionary  # laws

    @property
    def many_views(self) -> bool:
        """True where many views tell several effects apart at once."""
        return regime_of(self.linear).many_views


# A question; None where it does not arise.
Question = Callable[[Case, Evidence], Reply | None]


def propose(case: Case, limit: ScatterLimit) -> Evidence:
    """Return the evidence after the questions of `NAMING`, which propose a name that is not tested yet.

    Args:
        limit: scatter of the flange poses that no sound arm exceeds.
    """
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
    """Return the evidence after asking questions in order; each one sees what those before it changed.

    A question that does not arise leaves no answer; a reply with `ends` skips those behind it.
    """
    for question in questions:
        reply = question(case, evidence)
        if reply is None:
            continue
        evidence = answered(evidence, question, reply)
        if reply.ends:
            break
    return evidence


def answered(evidence: Evidence, question: Callable[..., object], reply: Reply) -> Evidence:
    """Return the evidence with a reply's changes and with its answer recorded.

    The first line of the question's docstring is recorded as its text, and whether the reply changed verdict or names.
    """
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
    return Reply(names_of(certain) or "a shape without a cause", {"alarm": True, "shape": shape})


def are_several_required(case: Case, evidence: Evidence) -> Reply | None:
    """Are several effects required of which none is certain by itself?"""
    if evidence.alarm:
        return None
    group = required_group(case, len(evidence.ranked))
    return Reply(names_of(group) or "no", {"explanation": group}, ends=bool(group))


def which_explains_most(case: Case, evidence: Evidence) -> Reply | None:
    """Which effect explains most, where none that could be named is among the errors that remain?"""
    if not evidence.alarm:
        return None
    contenders = [r for r in evidence.ranked if is_contender(r)]
    if not contenders:
        shape = evidence.shape
        assert shape is not None
        formula = shape.score.candidate.effect.formula
        note = f"what stands out, {formula} (p = {shape.adjusted:.1g}), has no known cause"
        return Reply("none that could be named", {"notes": (*evidence.notes, note)}, ends=True)
    first = contenders[0]
    # Random effects of the arm in the model can explain what a further contender would: without those of the known
    # contenders it may show. Each one that shows may reveal more.
    while hidden := _hidden_contenders(case, contenders):
        contenders += hidden
    base = case.linear.without([r.name for r in contenders])
    if len(contenders) > 1 and base is not case.linear:
        # All are scored over the same null model, so that their Bayes factors compare.
        contenders = [rescored_in(base, r) for r in contenders]
    ranked = _raise_hidden(evidence.ranked, first, contenders)
    laws = evidence.laws if base is case.linear else rank_laws(base, case.dictionary)
    credited = likeliest_first(case.dictionary.credited(r, laws) for r in contenders)
    best = credited[0]
    rivals = case.dictionary.without(base, laws, best)
    unmodelled = max([unmodelled_log_posterior(base), *(r.log_posterior for r in rivals)])
    shapes = [r for r in (*evidence.empirical, *rivals) if stands_out(r)]
    shape = max(shapes, key=lambda r: r.log_posterior, default=None)
    changes = {
        "laws": laws,
        "explanation": (best,),
        "together": (best,),
        "shape": shape and (shape if shape in rivals else rescored_in(base, shape)),
        "contenders": credited,
        "base": base,
        "unmodelled_log_posterior": unmodelled,
        "ranked": rescored_against(ranked, best, unmodelled),
    }
    return Reply(best.name, changes)


def which_hold_together(case: Case, evidence: Evidence) -> Reply | None:
    """Of many views: which effects are missing at once, each holding its place beside the others?"""
    if not evidence.alarm or not case.many_views:
        return None
    best = evidence.explanation[0]
    shape = evidence.shape
    selection = forward_selection(case.linear, case.candidates, best)
    explained = max(selection.explained, best.log_posterior)
    # The changes for an alarm without a name.
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
    return Reply(names_of(effects), changes)


def do_poses_err_without_a_name(case: Case, evidence: Evidence) -> Reply | None:
    """Where no effect is wanted: do the poses err again in a way that has no name?"""
    if evidence.alarm:
        return None
    errors = find_repeating_errors(case.linear)
    text = "they " + " and ".join(error.words for error in errors) if errors else "no"
    return Reply(text, {"repeating_errors": errors}, ends=True)


def does_an_unmodelled_effect_explain_it(case: Case, evidence: Evidence) -> Reply | None:
    """Of few views: does something without a name explain them as well, alone and beside a second effect?

    "Without a name" is an error of a joint or in time that follows no law of the library. Two known effects at once may
    look like such an error: the best effect is tried with a second one before it loses.
    """
    if case.many_views:
        return None
    best = evidence.explanation[0]
    if not _beaten_by_unmodelled(best.log_posterior, evidence):
        return Reply("no")
    second = find_second_effect(case, best)
    if second is not None:
        prior = float(np.log(limits.PRIOR_PHYSICAL / len(evidence.ranked)))
        of_both = best.log_posterior + (second.score.log_bayes_factor + prior)
        if not _beaten_by_unmodelled(of_both, evidence):
            # The likelier one beside the other goes first, which alone may have been the weaker.
            beside = rank_one(conditioned_on_effects(case.linear, [second]), best.score.candidate, second.tests)
            pair = (best, second) if beside.log_posterior >= second.log_posterior else (second, beside)
            return Reply(f"not beside {second.name}", both_missing(pair))
    note = f"{best.name} explains these views no better than an error without a name"
    return Reply("yes", {"unmodelled_explains_it": True, "notes": (*evidence.notes, note)}, ends=True)


def is_it_wanted_beside_smooth_errors(case: Case, evidence: Evidence) -> Reply | None:
    """Is it wanted beside the others and beside any trend without a name, of a joint or in time?

    Let f be the effect's log Bayes factor with the most favourable such trend in the model. Beyond log 20 the effect is
    needed. Between ± log 20 the trend is a rival that these views cannot exclude. Below, the trend is the explanation.
    """
    if regime_of(case.linear).prior:
        return None  # the prior of pose errors has asked already
    best, *others = evidence.together
    log_bayes_factor, trend = least_log_bayes_factor(conditioned_on_effects(case.linear, others), best.score)
    if log_bayes_factor > limits.ODDS:
        return Reply("yes")
    if log_bayes_factor > -limits.ODDS:
        return Reply(f"or {trend}", {"rival_trend": trend})
    note = f"{best.name} explains these views less well than an unnamed error, smooth in the joint angles or in time"
    return Reply("no", {"unmodelled_explains_it": True, "notes": (*evidence.notes, note)}, ends=True)


def which_come_near(case: Case, evidence: Evidence) -> Reply | None:
    """Which other effects come within 20 to 1?"""
    if evidence.further is not None:
        return None  # each was asked beside the other
    best = evidence.explanation[0]
    others = [r for r in evidence.contenders if r.name != best.name and r.name not in evidence.refused]
    near = [r for r in others if r.comes_near(best)]
    return Reply(names_of(near) or "none", {"explanation": (best, *near)})


def are_two_missing(case: Case, evidence: Evidence) -> Reply | None:
    """Of few views: are two missing, of which one alone took for itself what both do?"""
    if len(evidence.explanation) == 1 or case.many_views:
        return None
    pair = find_missing_pair(case, evidence.explanation[0])
    return Reply("no") if pair is None else Reply(names_of(pair), both_missing(pair))


def which_laws_come_near(case: Case, evidence: Evidence) -> Reply | None:
    """Which laws that are no effect's come within 20 to 1, wherever they act and whatever they follow?"""
    best, *others = evidence.together or evidence.explanation
    base = conditioned_on_effects(evidence.base or case.linear, others)
    laws = rank_laws(base, case.dictionary) if others else evidence.laws
    rivals = case.dictionary.without(base, laws, best)
    near = tuple(r for r in rivals if r.log_posterior > best.log_posterior - limits.ODDS and stands_out(r))
    return Reply(names_of(near) or "none", {"rival_laws": near})


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


def _hidden_contenders(case: Case, contenders: Sequence[Ranked]) -> list[Ranked]:
    """Return contenders that show only once the random effects of the known contenders are taken out of the model.

    A compliant base or an uneven gear, say, explains nothing while joints may give way by any amount. Effects that are
    random effects of the model themselves are scored again, and the most promising of the others. Empty where the model
    has no random effects of these names.

    Args:
        contenders: effects that could be named already; not empty.
    """
    known = {r.name for r in contenders}
    base = case.linear.without(known)
    if base is case.linear:
        return []
    weak = [c for c in case.candidates if not c.empirical and c.name not in known]
    remaining = [c for c in weak if c.name in base.causes]
    likely = promising(base, [c for c in weak if c not in remaining], limits.CANDIDATES_TRIED)
    tried = [*remaining, *(candidate for candidate, _ in likely)]
    again = rank(list(parallel(partial(score, base), tried)), contenders[0].tests)[0]
    return [r for r in again if is_contender(r)]


def _raise_hidden(ranked: Sequence[Ranked], first: Ranked, contenders: Sequence[Ranked]) -> tuple[Ranked, ...]:
    """Return the ranking with hidden contenders raised to their new place; all posteriors add up to 1 again.

    The ranking was scored beside random effects of the contenders' names, the contenders without these. So only
    differences compare: a hidden contender stands as far from `first` in the ranking as it does among the contenders.

    Args:
        ranked: all effects as they were ranked, hidden ones too low.
        first: the contender that was the likeliest there.
        contenders: all contenders, as they are scored now; `first` is among them.
    """
    rescored = {r.name: r for r in contenders}
    first_now = rescored[first.name]
    hidden = [rescored[r.name] for r in ranked if r.name in rescored and not is_contender(r)]
    ahead = [r.log_posterior - first_now.log_posterior for r in hidden]
    # Room in the sum of posteriors is made for all of them together.
    ranked = rescored_against(ranked, first, first.log_posterior + float(np.logaddexp.reduce(ahead)))
    posterior = next(r.posterior for r in ranked if r.name == first.name)
    raised = dict[str, Ranked]()
    for r, nats in zip(hidden, ahead, strict=True):
        gain = r.score.log_bayes_factor - first_now.score.log_bayes_factor
        raised[r.name] = replace(
            r,
            score=replace(r.score, log_bayes_factor=first.score.log_bayes_factor + gain),
            log_posterior=first.log_posterior + nats,
            posterior=posterior * float(np.exp(nats)),
        )
    return likeliest_first(raised.get(r.name, r) for r in ranked)


def rescored_in(base: LinearModel, ranked: Ranked) -> Ranked:
    """Return a candidate scored in another linear model, with the same number of tests and the same prior.

    Its `posterior` stays that of the old ranking.
    """
    again = score(base, ranked.score.candidate)
    return replace(
        ranked,
        score=again,
        adjusted=min(1.0, again.p_value * ranked.tests),
        log_posterior=ranked.log_posterior + again.log_bayes_factor - ranked.score.log_bayes_factor,
    )


def required_group(case: Case, tests: int) -> tuple[Ranked, ...]:
    """Return effects of which at least one is needed though none is certain by itself, likeliest first; () if none is.

    None is certain since random effects of joints and links in the model explain whatever it would. So all these are
    removed. If an effect is certain then, they are put back, and removed one by one, that with the largest gain first,
    until it is certain again. The removed ones, as effects, are the group. It is () where an unmodelled error explains
    the views as well.

    Args:
        tests: number of candidates among which the best is chosen.
    """
    linear = case.linear
    # Names of effects that are random effects of the model.
    random_effects = () if linear.pose_errors is None else tuple(linear.pose_errors.effects)
    without_any = linear.without(random_effects)
    if not random_effects or without_any.null.deviance < linear.null.deviance:
        # No error of joints or links helps: none stands in for another.
        return ()
    known = {c.name: c for c in case.candidates if not c.empirical}
    ranked = rank([score(without_any, c) for c in known.values()], tests)[0]
    best = next((r for r in ranked if is_certain(r)), None)
    if best is None:
        return ()
    candidate = known[best.name]
    removed = {best.name}
    while not is_certain(rank_one(linear.without(removed), candidate, tests)):
        others = [name for name in random_effects if name in known and name not in removed]
        if not others:
            return ()
        bases = {name: linear.without(removed | {name}) for name in others}
        removed.add(max(others, key=lambda name: score(bases[name], candidate).log_bayes_factor))
    base = linear.without(removed)
    group = rank([score(base, c) for c in known.values() if c.name in removed], tests)[0]
    if unmodelled_log_posterior(base) > group[0].log_posterior - limits.ODDS:
        return ()
    near = [r for r in group if is_contender(r) and r.comes_near(group[0])]
    # One far ahead is no name either: it was not certain with the others as random effects. Then all are returned.
    return tuple(near) if len(near) > 1 else group


def find_second_effect(case: Case, best: Ranked) -> Ranked | None:
    """Return the likeliest effect that is certain with the best one in the model; None where there is none."""
    others = [c for c in case.candidates if c.name != best.name and not c.empirical]
    ranked, _ = rank_all(conditioned_on_effects(case.linear, [best]), others)
    return next((r for r in ranked if is_certain(r)), None)


def find_missing_pair(case: Case, best: Ranked) -> tuple[Ranked, Ranked] | None:
    """Return two missing effects, each scored with the other in the model; None where there is no such pair.

    The second is the likeliest beside `best`; the first, usually `best` again, is the likeliest beside the second. Each
    must be certain beside the other, and beside the second no other contender may be within 20 to 1 of the first.
    """
    second = find_second_effect(case, best)
    if second is None:
        return None
    others = [c for c in case.candidates if c.name != second.name and not c.empirical]
    first, *rest = rank_all(conditioned_on_effects(case.linear, [second]), others)[0]
    least = first.log_posterior - limits.ODDS
    if not is_certain(first) or any(is_contender(r) and r.log_posterior > least for r in rest):
        return None
    again = rank_one(conditioned_on_effects(case.linear, [first]), second.score.candidate, tests=len(others))
    return (first, again) if is_certain(again) else None


def _beaten_by_unmodelled(known: float, evidence: Evidence) -> bool:
    """Return whether an error without a name is too likely for known effects to be named.

    A shape without a cause wins if it is 20 to 1 likelier. An unmodelled error of a joint or in time wins unless it is
    20 to 1 less likely, as any other rival would.

    Args:
        known: log posterior of the effects that would be named.
    """
    shape = evidence.shape
    by_shape = shape is not None and shape.log_posterior > known + limits.ODDS
    return by_shape or evidence.unmodelled_log_posterior > known - limits.ODDS


def _refusals(refused: Mapping[str, str]) -> dict[str, Any]:
    """Return the changes of the evidence by refused effects: the reasons by name, and each reason once as a note."""
    return {"refused": refused, "notes": tuple(dict.fromkeys(refused.values()))}


def both_missing(pair: tuple[Ranked, Ranked]) -> dict[str, Any]:
    """Return the changes of the evidence where two effects are missing, of which the first is named."""
    return {"explanation": pair[:1], "further": pair[1], "together": pair}


def names_of(effects: Sequence[Ranked]) -> str:
    """Return the names of effects as text."""
    return ", ".join(r.name for r in effects)
