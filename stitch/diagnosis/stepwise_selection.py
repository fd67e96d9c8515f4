"""Effects that are missing at once: found one by one, each asked to hold its place beside all the others.

Two effects may each leave nothing to the other among the measured poses. What an imitation gains is no measure then: it
has the more parameters, gains more, and is far off where nothing was measured. Ends of joints' ranges that were left
out tell the two apart as far as these poses can: an effect that errs at some end gives way to one that does the same
and is likelier to hold beyond (`find_exchange`).

An effect that was found first explains a part of what others do, and beside it these are not wanted: one by one nothing
leads away from it. At fixed variances the evidence of any set is a determinant of sums that are made once, so that sets
without it can be tried by the hundred (`exchanged_set`).
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, pairwise

import numpy as np

from stitch.diagnosis import thresholds as limits
from stitch.diagnosis.candidates import Candidate, candidate_as_fitted, candidates_of
from stitch.diagnosis.ranking import Ranked, conditioned_on_effects, conditioned_without, is_certain, rank, rank_one
from stitch.diagnosis.regime import regime_of
from stitch.diagnosis.score import promising, score
from stitch.diagnosis.validation import (
    Extrapolation,
    cross_validate,
    extrapolate,
    group_share,
    untested_ends_reason,
)
from stitch.fit.pipelines import linearise
from stitch.model.model import Term
from stitch.numerics.parameter_selection import (
    PLAUSIBLE,
    eliminate_backward,
    log_evidence_at_scales,
    log_mixture,
    select_forward,
)
from stitch.numerics.reml import at_variances, fit_variances
from stitch.observations.linear_model import LinearModel
from stitch.run_data import RunData
from stitch.system.threads import parallel

# Effects that are taken out at once.
_TAKEN_OUT = 2


def find_effect_to_drop(state: RunData, names: Collection[str]) -> tuple[str, str] | None:
    """Return the weakest effect of labelled points that does not hold its place beside all others, and why; None if all
    do.

    Effects are asked at once, of many poses one after the other. Scans, whose overlaps are found by all cores already,
    do not allow it.

    Args:
        names: effects of the model that may go.
    """
    asked = [term for term in state.model.terms if term.name in names]
    each = parallel if state.measurement.views.count < limits.MANY_POSES else map
    tested = zip(asked, each(partial(_test_effect, state), asked), strict=True)
    failing = [(factor, term.name, reason) for term, (factor, reason) in tested if reason is not None]
    if not failing:
        return None
    _, name, reason = min(failing)
    return name, reason


def _test_effect(state: RunData, term: Term) -> tuple[float, str | None]:
    """Return the log Bayes factor of an effect beside the others, and why it should go, if it should."""
    name = term.name
    linear = linearise(state.session, state.measurement, state.model.without(name), state.gate)
    candidate = candidate_as_fitted(linear, term)
    if not candidate.forms[0].keep.any():
        return 0.0, f"{name} is not seen beside the others"
    ranked = rank_one(linear, candidate, tests=1)
    factor = ranked.score.log_bayes_factor
    if not is_certain(ranked):
        return factor, f"{name} explains too little beside the others"
    return factor, cross_validate(linear, ranked.score).rejection_reason(name)


@dataclass(frozen=True)
class ForwardSelection:
    """Effects beside each other; first the one without which most would stay unexplained."""

    effects: tuple[Ranked, ...]
    explained: float  # log posterior of what was found one by one
    refused: dict[str, str]  # effects that explain much and are not among them, and why


def forward_selection(linear: LinearModel, candidates: Sequence[Candidate], best: Ranked) -> ForwardSelection:
    """Return the effects that are missing together, found by adding and removing one at a time.

    One effect alone may explain more than each of two true ones, because it imitates a part of both. So effects are
    added as long as one is certain beside those before, then each is tested with all others in the model. At last sets
    of other effects replace the chosen ones, if they are likelier and predict views left out better (`exchanged_set`).

    Args:
        best: the effect to begin with.
    """
    physical = [c for c in candidates if not c.empirical]
    selection = _stable_selection(linear, physical, _add_effects(linear, physical, [best]))
    while (better := _better_selection(linear, physical, selection)) is not None:
        selection = better
    return selection


def find_better_effects(state: RunData, added: Collection[str]) -> list[str]:
    """Return names of effects that together do better than those that were added to a run's model; [] without such.

    Args:
        added: names of effects of the model that may be replaced; the others stay.
    """
    terms = [term for term in state.model.terms if term.name not in added]
    linear = linearise(state.session, state.measurement, state.model.with_terms(terms), state.gate)
    candidates = [c for c in candidates_of(linear, empirical=False)[0] if c.name not in state.tried]
    chosen = tuple(rank_one(linear, c, len(candidates)) for c in candidates if c.name in added)
    better = _better_selection(linear, candidates, ForwardSelection(chosen, 0.0, {}))
    return [] if better is None else [r.name for r in better.effects]


def _better_selection(
    linear: LinearModel, candidates: Sequence[Candidate], selection: ForwardSelection
) -> ForwardSelection | None:
    """Return a better selection with other effects, each tested beside all others; None where there is none.

    Effects that the present selection refused, since they err beyond the measured poses, are not tried again.
    """
    instead = exchanged_set(linear, [c for c in candidates if c.name not in selection.refused], selection.effects)
    if not instead:
        return None
    other = _stable_selection(linear, candidates, [rank_one(linear, c, len(candidates)) for c in instead])
    return other if is_better_set(linear, other.effects, selection.effects) else None


def _stable_selection(
    linear: LinearModel, candidates: Sequence[Candidate], chosen: Sequence[Ranked]
) -> ForwardSelection:
    """Return a selection in which every effect is certain beside all others and holds at ends of joint ranges left out.

    Each round removes effects that are not certain. Then the one that predicts the ends worst goes, unless it helps
    there beside the likeliest further effect; others may explain what it imitated, so effects are added again. Where
    none is wrong at the ends altogether, one that is wrong at a single end is exchanged for one that predicts better.
    It ends when nothing is left to remove or exchange.

    Args:
        chosen: effects to begin with.
    """
    remaining = list(candidates)
    exchanged = set[str]()
    unseen = set[str]()
    refused = dict[str, str]()
    explained = sum(r.log_posterior for r in chosen)
    while True:
        chosen, beyond = _eliminate_backward(linear, chosen, len(remaining))
        at_all_ends = zip(chosen, beyond.values(), strict=True)
        erring = [(r, at_ends) for r, at_ends in at_all_ends if at_ends is not None and not at_ends.helps]
        erring.sort(key=lambda each: -each[1].share)
        worst = next((each for each in erring if not _helps_beside_next(linear, remaining, chosen, each[0])), None)
        replacement: Ranked | None = None
        if worst is not None:
            name, at_ends = worst[0].name, worst[1]
            refused[name] = at_ends.rejection_reason(name)
            (unseen.add if at_ends.unseen else unseen.discard)(name)
        else:
            rivals = [c for c in candidates if c.name not in exchanged]
            exchange = find_exchange(linear, rivals, chosen, beyond)
            if exchange is None:
                break
            name, reason, replacement = exchange
            refused.pop(replacement.name, None)  # it erred beside the one that gives way
            refused[name] = reason
            exchanged.add(name)
            unseen -= {name, replacement.name}
        remaining = [c for c in remaining if c.name != name]
        kept = [r for r in chosen if r.name != name]
        chosen = _add_effects(linear, remaining, kept if replacement is None else [*kept, replacement])
    if len(unseen) > 1:
        refused |= dict.fromkeys(unseen, untested_ends_reason(sorted(unseen)))
    likeliest_first = tuple(sorted(chosen, key=lambda r: -r.log_posterior))
    return ForwardSelection(likeliest_first, explained, refused)


def _helps_beside_next(
    linear: LinearModel, candidates: Sequence[Candidate], chosen: Sequence[Ranked], r: Ranked
) -> bool:
    """Return whether a chosen effect r predicts ends of joint ranges better once the likeliest further effect is added.

    That further effect may be too small to be named. Without it, r takes over a part of it, and errs at the ends.
    """
    beside = conditioned_on_effects(linear, chosen)
    further = promising(beside, [c for c in candidates if c.name not in {r.name for r in chosen}], 1)
    if not further or further[0][1] < 0:
        return False
    second = rank_one(beside, further[0][0], len(candidates))
    rest = conditioned_without(linear, [*chosen, second], r)
    again = rank_one(rest, r.score.candidate, len(candidates))
    at_ends = extrapolate(rest, again.score) if is_certain(again) else None
    return at_ends is not None and at_ends.helps


def _add_effects(linear: LinearModel, candidates: Sequence[Candidate], chosen: Sequence[Ranked]) -> list[Ranked]:
    """Return the chosen effects with further ones, added as long as one is certain, up to `MAX_JOINT_EFFECTS`."""
    chosen = list(chosen)
    while len(chosen) < limits.MAX_JOINT_EFFECTS:
        others = [c for c in candidates if c.name not in {r.name for r in chosen}]
        following = _next_effect(conditioned_on_effects(linear, chosen), others)
        if following is None:
            break
        chosen.append(following)
    return chosen


def _next_effect(base: LinearModel, others: Sequence[Candidate]) -> Ranked | None:
    """Return the most likely effect that is certain in the model `base`; None where there is none.

    Candidates with less than `NEAR_BEST_GAIN` of the best quick gain are fitted only if none of the others is certain;
    they are tried again in later rounds.
    """
    likely = promising(base, others, limits.CANDIDATES_TRIED)
    near = [c for c, gain in likely if gain >= limits.NEAR_BEST_GAIN * likely[0][1]]
    for tried in (near, [c for c, _ in likely if c not in near]):
        # Preselected by what they gain: all that were looked at count as tests.
        ranked, _ = rank(list(parallel(partial(score, base), tried)), tests=len(others))
        following = next((r for r in ranked if is_certain(r)), None)
        if following is not None:
            return following
    return None


def _eliminate_backward(
    linear: LinearModel, chosen: Sequence[Ranked], tests: int
) -> tuple[list[Ranked], dict[str, Extrapolation | None]]:
    """Return the chosen effects that are certain with all others in the model, and their test at ends of joint ranges.

    Effects are judged in order; one that fails is removed before the next is judged. All are first scored in parallel
    beside all the others. These results hold as long as no effect fails or changes its form; then they are redone.

    Returns:
        Effects kept; and by name the test, None where the views are too few for one.
    """
    start = conditioned_on_effects(linear, chosen).null.variances if not regime_of(linear).prior else None

    def beside_others(r: Ranked, among: Sequence[Ranked] = chosen) -> tuple[Ranked, Extrapolation | None]:
        beside = conditioned_without(linear, among, r, start)
        again = rank_one(beside, r.score.candidate, tests, start)
        return again, extrapolate(beside, again.score) if is_certain(again) else None

    # Mostly all hold their place: then none was asked beside one that goes, and the order is of no account.
    kept = list(chosen)
    beyond = dict[str, Extrapolation | None]()
    as_asked = True
    for r, at_once in zip(chosen, list(parallel(beside_others, chosen)), strict=True):
        again, at_ends = at_once if as_asked else beside_others(r, kept)
        others = [other for other in kept if other.name != r.name]
        if not (is_certain(again) and again.score.form is r.score.form):
            beyond, as_asked = {}, False  # what was asked of the others was asked beside this one
        kept = [*others, again] if is_certain(again) else others
        if is_certain(again):
            beyond[again.name] = at_ends
    for r in kept:
        if r.name not in beyond:
            beyond[r.name] = extrapolate(conditioned_without(linear, kept, r, start), r.score)
    return kept, {r.name: beyond[r.name] for r in kept}


def find_exchange(
    linear: LinearModel,
    candidates: Sequence[Candidate],
    chosen: Sequence[Ranked],
    beyond: Mapping[str, Extrapolation | None],
) -> tuple[str, str, Ranked] | None:
    """Return the name of an effect to exchange, the reason, and its replacement; None if all chosen effects may stay.

    An effect is exchanged if it errs at some end of a joint's range, and no longer helps there once a rival that
    predicts the ends better is in the model.

    Args:
        candidates: possible replacements.
        chosen: effects in the model together.
        beyond: by name, each one's test at the ends with the others in the model.
    """
    names = {r.name for r in chosen}
    for r in chosen:
        at_ends = beyond[r.name]
        if at_ends is None or not at_ends.errs_somewhere:
            continue
        rest = conditioned_without(linear, chosen, r)
        for rival in _better_extrapolating_effects(rest, [c for c in candidates if c.name not in names], at_ends):
            beside = conditioned_on_effects(rest, [rival])
            left = extrapolate(beside, rank_one(beside, r.score.candidate, len(candidates)).score)
            if left is not None and not left.helps:
                return r.name, f"{left.rejection_reason(r.name)}; this beside {rival.name}", rival
    return None


def _better_extrapolating_effects(
    rest: LinearModel, candidates: Sequence[Candidate], at_ends: Extrapolation
) -> list[Ranked]:
    """Return certain effects that more probably predict a further end of a joint's range than a given test says.

    The best comes first. Events are left out: one that begins at the second view imitates a lasting effect, and the
    ends cannot tell the two apart.

    Args:
        rest: the model without the effect that would be exchanged.
        at_ends: the test of that effect.
    """
    better = list[tuple[float, Ranked]]()
    lasting = [c for c in candidates if not any(p.discrete for p in c.parameters)]
    for candidate, _ in promising(rest, lasting, limits.CANDIDATES_TRIED):
        other = rank_one(rest, candidate, len(candidates))
        its_ends = extrapolate(rest, other.score) if is_certain(other) else None
        if its_ends is not None and its_ends.helps and its_ends.likely > at_ends.likely:
            better.append((its_ends.likely, other))
    return [other for _, other in sorted(better, key=lambda item: -item[0])]


def exchanged_set(linear: LinearModel, candidates: Sequence[Candidate], chosen: Sequence[Ranked]) -> list[Candidate]:
    """Return a set of effects 20 to 1 likelier than the chosen one, without some of its effects; [] if there is none.

    All sets are compared at the variances beside the chosen effects: information and vector of all candidates are
    computed once, and sets select from them. Up to `_TAKEN_OUT` chosen effects are removed, then a forward selection
    and a backward elimination follow.

    Args:
        candidates: possible members; those with time constants or events only if they are chosen.
        chosen: the present effects.
    """
    if not chosen:
        return []
    chosen_forms = {r.name: r.score.form for r in chosen}
    free = [c for c in candidates if c.name in chosen_forms or not c.forms[0].term.gridded.any()]
    # Sums of all candidates at once, at the scatter that is left beside the chosen effects.
    scatter = conditioned_on_effects(linear, chosen).null.variances
    at = replace(linear, null=at_variances(linear.mixed, scatter))
    forms = [chosen_forms.get(c.name) or c.forms[0] for c in free]
    white = [at.residual(form.columns) * form.sizes for form in forms]
    ends = np.cumsum([0, *(columns.shape[1] for columns in white)])
    places = [np.arange(begin, end) for begin, end in pairwise(ends)]
    stacked = np.hstack(white)
    information = stacked.T @ stacked
    vector = stacked.T @ at.white_residual

    def log_posterior(numbers: Sequence[int]) -> float:
        """Return the log posterior of a set of candidates, by their indices in `free`, not yet normalised."""
        index = np.concatenate([np.zeros(0, np.int64), *(places[k] for k in numbers)])
        evidence = log_evidence_at_scales(information[np.ix_(index, index)], vector[index], PLAUSIBLE)
        return log_mixture(evidence, PLAUSIBLE) + len(numbers) * float(np.log(limits.PRIOR_PHYSICAL / len(free)))

    now = [k for k, c in enumerate(free) if c.name in chosen_forms]
    others = [k for k in range(len(free)) if k not in now]
    best = list[int]()
    least = log_posterior(now) + limits.ODDS
    for taken in (out for count in range(1, _TAKEN_OUT + 1) for out in combinations(now, count)):
        rest = [k for k in now if k not in taken]
        numbers = select_forward(log_posterior, others, rest, limits.MAX_JOINT_EFFECTS)
        numbers = eliminate_backward(log_posterior, numbers)
        if (value := log_posterior(numbers)) > least:
            best, least = numbers, value
    return [free[k] for k in best]


def is_better_set(linear: LinearModel, new: Sequence[Ranked], old: Sequence[Ranked]) -> bool:
    """Return whether a new set of effects is 20 to 1 likelier than an old one, and predicts views left out better.

    The log posteriors are those of fits with all variances.
    """
    likelier = _log_posterior(linear, new) > _log_posterior(linear, old) + limits.ODDS
    shares = [group_share(linear, [r.score for r in effects])[0] for effects in (new, old)]
    return bool(likelier and shares[0] < shares[1])


def _log_posterior(linear: LinearModel, chosen: Sequence[Ranked]) -> float:
    """Return the log posterior of effects together, not yet normalised."""
    if not chosen:
        return 0.0
    G = linear.in_blocks(np.hstack([r.score.form.columns for r in chosen]))
    start = conditioned_on_effects(linear, chosen).null.variances
    fit = fit_variances(linear.mixed, G, np.concatenate([r.score.sizes for r in chosen]), start)
    prior = sum(float(np.log(limits.PRIOR_PHYSICAL / r.tests)) for r in chosen)
    return 0.5 * (linear.null.deviance - fit.deviance) + prior


def keep_worth_adding(linear: LinearModel, chosen: Sequence[Ranked], tests: int) -> tuple[list[Ranked], dict[str, str]]:
    """Return the chosen effects that all help on views left out, and the dropped ones with the reason, by name.

    The weakest is tested first; after each one that is dropped, the others are scored again. Hundreds of poses show
    even effects that move hardly anything: such would be dropped from the model again at once.

    Args:
        tests: number of candidates among which they were chosen.
    """

    def beside(others: Sequence[Ranked], r: Ranked) -> Ranked:
        without = conditioned_without(linear, others, r)
        return rank_one(without, r.score.candidate, tests, r.score.variances)

    chosen = list(chosen)
    idle = dict[str, str]()
    while True:
        objections = (
            (r, cross_validate(conditioned_without(linear, chosen, r), r.score).rejection_reason(r.name))
            for r in reversed(chosen)
        )
        first = next(((r, reason) for r, reason in objections if reason is not None), None)
        if first is None:
            return chosen, idle
        idle[first[0].name] = first[1]
        rest = [r for r in chosen if r.name != first[0].name]
        chosen = sorted(filter(is_certain, parallel(partial(beside, rest), rest)), key=lambda r: -r.log_posterior)
