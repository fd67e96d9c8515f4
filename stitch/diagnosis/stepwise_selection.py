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
from stitch.diagnosis.ranking import (
    Ranked,
    conditioned_on_effects,
    conditioned_without,
    is_certain,
    likeliest_first,
    rank,
    rank_one,
)
from stitch.diagnosis.regime import regime_of
from stitch.diagnosis.score import promising, score
from stitch.diagnosis.validation import Extrapolation, cross_validate, extrapolate, group_share, untested_ends_reason
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

# Chosen effects that `exchanged_set` removes at once, at the most.
_MOST_REMOVED = 2


def find_effect_to_drop(state: RunData, names: Collection[str]) -> tuple[str, str] | None:
    """Return the name of the weakest effect that the model does not need beside all others, and why; None if all hold.

    Only for labelled points: effects are tested in parallel, and matching scans takes all cores already. Of many poses
    they are tested one after the other, for memory.

    Args:
        names: effects of the model that may go.
    """
    terms = [term for term in state.model.terms if term.name in names]
    each = parallel if state.measurement.views.count < limits.MANY_POSES else map
    tested = zip(terms, each(partial(_test_effect, state), terms), strict=True)
    failing = [(factor, term.name, reason) for term, (factor, reason) in tested if reason is not None]
    if not failing:
        return None
    _, name, reason = min(failing)
    return name, reason


def _test_effect(state: RunData, term: Term) -> tuple[float, str | None]:
    """Return the log Bayes factor of an effect beside the others, and the reason to drop it; None if it holds."""
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
    """Effects that are missing together."""

    effects: tuple[Ranked, ...]  # each scored beside all others, the likeliest first
    explained: float  # sum of the log posteriors of the effects with which the selection began
    refused: dict[str, str]  # by name of an effect that explains much and is not among them, why


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
    replacement = exchanged_set(linear, [c for c in candidates if c.name not in selection.refused], selection.effects)
    if not replacement:
        return None
    other = _stable_selection(linear, candidates, [rank_one(linear, c, len(candidates)) for c in replacement])
    return other if is_better_set(linear, other.effects, selection.effects) else None


def _stable_selection(
    linear: LinearModel, candidates: Sequence[Candidate], chosen: Sequence[Ranked]
) -> ForwardSelection:
    """Return a selection in which every effect is certain beside all others and holds at ends of joint ranges left out.

    Each round has four steps:

    1. Effects that are not certain beside all others are removed.
    2. The one that predicts the ends worst is removed, unless it helps there beside the likeliest further effect.
    3. Where none was, one that errs at a single end is exchanged for one that predicts it better (`find_exchange`).
    4. Effects are added again: others may explain what the one removed had imitated.

    It ends when nothing is left to remove or exchange.

    Args:
        candidates: effects that may be added; one that was removed is added no more, but as a replacement.
        chosen: effects to begin with.
    """
    addable = list(candidates)
    exchanged = set[str]()
    # By name of an effect that was removed: why, and whether the ends change as little with it as without.
    removed = dict[str, tuple[str, bool]]()
    explained = sum(r.log_posterior for r in chosen)
    while True:
        chosen, end_tests = _eliminate_backward(linear, chosen, len(addable))
        worst = _worst_at_ends(linear, addable, chosen, end_tests)
        replacements = list[Ranked]()
        if worst is not None:
            name, at_ends = worst
            removed[name] = at_ends.rejection_reason(name), at_ends.unseen
        else:
            rivals = [c for c in candidates if c.name not in exchanged]
            exchange = find_exchange(linear, rivals, chosen, end_tests)
            if exchange is None:
                break
            name, reason, replacement = exchange
            replacements.append(replacement)
            removed.pop(replacement.name, None)  # it erred beside the one that gives way
            removed[name] = reason, False
            exchanged.add(name)
        addable = [c for c in addable if c.name != name]
        kept = [r for r in chosen if r.name != name]
        chosen = _add_effects(linear, addable, [*kept, *replacements])
    refused = {name: reason for name, (reason, _) in removed.items()}
    untested = sorted(name for name, (_, unseen) in removed.items() if unseen)
    if len(untested) > 1:
        refused |= dict.fromkeys(untested, untested_ends_reason(untested))
    return ForwardSelection(likeliest_first(chosen), explained, refused)


def _worst_at_ends(
    linear: LinearModel,
    candidates: Sequence[Candidate],
    chosen: Sequence[Ranked],
    end_tests: Mapping[str, Extrapolation | None],
) -> tuple[str, Extrapolation] | None:
    """Return the name of the chosen effect that errs most at ends of joint ranges, and its test; None if all may stay.

    The error is the mean square distance with the effect over that without it. An effect may stay that helps there,
    alone or beside the likeliest further effect (`_helps_beside_next`).

    Args:
        candidates: further effects.
        end_tests: by name, the test of each chosen effect at the ends.
    """
    tests = ((r, end_tests[r.name]) for r in chosen)
    erring = [(r, at_ends) for r, at_ends in tests if at_ends is not None and not at_ends.helps]
    for r, at_ends in sorted(erring, key=lambda pair: -pair[1].share):
        if not _helps_beside_next(linear, candidates, chosen, r):
            return r.name, at_ends
    return None


def _helps_beside_next(
    linear: LinearModel, candidates: Sequence[Candidate], chosen: Sequence[Ranked], r: Ranked
) -> bool:
    """Return whether a chosen effect r predicts ends of joint ranges better once the likeliest further effect is added.

    That further effect may be too small to be named. Without it, r takes over a part of it, and errs at the ends.
    """
    with_chosen = conditioned_on_effects(linear, chosen)
    likeliest = promising(with_chosen, [c for c in candidates if c.name not in {r.name for r in chosen}], 1)
    if not likeliest or likeliest[0][1] < 0:
        return False
    further = rank_one(with_chosen, likeliest[0][0], len(candidates))
    without_r = conditioned_without(linear, [*chosen, further], r)
    again = rank_one(without_r, r.score.candidate, len(candidates))
    at_ends = extrapolate(without_r, again.score) if is_certain(again) else None
    return at_ends is not None and at_ends.helps


def _add_effects(linear: LinearModel, candidates: Sequence[Candidate], chosen: Sequence[Ranked]) -> list[Ranked]:
    """Return the chosen effects with further ones, added as long as one is certain, up to `MAX_JOINT_EFFECTS`."""
    chosen = list(chosen)
    while len(chosen) < limits.MAX_JOINT_EFFECTS:
        others = [c for c in candidates if c.name not in {r.name for r in chosen}]
        further = _next_effect(conditioned_on_effects(linear, chosen), others)
        if further is None:
            break
        chosen.append(further)
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
        certain = next((r for r in ranked if is_certain(r)), None)
        if certain is not None:
            return certain
    return None


def _eliminate_backward(
    linear: LinearModel, chosen: Sequence[Ranked], tests: int
) -> tuple[list[Ranked], dict[str, Extrapolation | None]]:
    """Return the chosen effects that are certain with all others in the model, and their test at ends of joint ranges.

    The rule is sequential: each effect is judged beside those that stay of the ones before it, and all after it. As
    mostly all stay as they are, all are judged at once, beside all the others. Those results count up to the first
    effect that fails, or stays in another form; from there on each is judged anew.

    Args:
        tests: number of effects among which each was chosen.

    Returns:
        Effects kept; and by name the test, None where the views are too few for one.
    """
    start = conditioned_on_effects(linear, chosen).null.variances if not regime_of(linear).prior else None

    def judged(r: Ranked, among: Sequence[Ranked] = chosen) -> tuple[Ranked, Extrapolation | None]:
        """Return an effect scored with the others of `among` in the model, and, if it is certain, its test at ends."""
        without_r = conditioned_without(linear, among, r, start)
        again = rank_one(without_r, r.score.candidate, tests, start)
        return again, extrapolate(without_r, again.score) if is_certain(again) else None

    kept = list(chosen)
    end_tests = dict[str, Extrapolation | None]()
    all_stayed = True
    for r, judged_at_once in zip(chosen, list(parallel(judged, chosen)), strict=True):
        again, at_ends = judged_at_once if all_stayed else judged(r, kept)
        kept = [other for other in kept if other.name != r.name]
        if not is_certain(again) or again.score.form is not r.score.form:
            # What was tested so far was tested beside this one as it was.
            all_stayed = False
            end_tests = {}
        if is_certain(again):
            kept.append(again)
            end_tests[again.name] = at_ends
    for r in kept:
        if r.name not in end_tests:
            end_tests[r.name] = extrapolate(conditioned_without(linear, kept, r, start), r.score)
    return kept, end_tests


def find_exchange(
    linear: LinearModel,
    candidates: Sequence[Candidate],
    chosen: Sequence[Ranked],
    end_tests: Mapping[str, Extrapolation | None],
) -> tuple[str, str, Ranked] | None:
    """Return the name of an effect to exchange, the reason, and its replacement; None if all chosen effects may stay.

    An effect is exchanged if it errs at some end of a joint's range, and no longer helps there once a rival that
    predicts the ends better is in the model.

    Args:
        candidates: possible replacements.
        chosen: effects in the model together.
        end_tests: by name, the test of each chosen effect at the ends with the others in the model.
    """
    names = {r.name for r in chosen}
    for r in chosen:
        at_ends = end_tests[r.name]
        if at_ends is None or not at_ends.errs_somewhere:
            continue
        without_r = conditioned_without(linear, chosen, r)
        for rival in _better_extrapolating_effects(without_r, [c for c in candidates if c.name not in names], at_ends):
            with_rival = conditioned_on_effects(without_r, [rival])
            beside_rival = extrapolate(with_rival, rank_one(with_rival, r.score.candidate, len(candidates)).score)
            if beside_rival is not None and not beside_rival.helps:
                return r.name, f"{beside_rival.rejection_reason(r.name)}; this beside {rival.name}", rival
    return None


def _better_extrapolating_effects(
    rest: LinearModel, candidates: Sequence[Candidate], at_ends: Extrapolation
) -> list[Ranked]:
    """Return certain effects that likelier predict a further end of a joint's range than a given one, best first.

    Events are left out: one that begins at the second view imitates a lasting effect, and the ends cannot tell the two
    apart.

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
    """Return a set of effects 20 to 1 likelier than the chosen set, without some of its effects; [] if there is none.

    Up to `_MOST_REMOVED` chosen effects are removed, then a forward selection and a backward elimination follow. All
    sets are compared at the variances beside the chosen effects, so that information and vector of all candidates are
    computed once, and a set takes its rows and columns of them.

    Args:
        candidates: possible members; those with time constants or events only if they are chosen.
        chosen: the present effects.
    """
    if not chosen:
        return []
    chosen_forms = {r.name: r.score.form for r in chosen}
    eligible = [c for c in candidates if c.name in chosen_forms or not c.forms[0].term.gridded.any()]
    variances = conditioned_on_effects(linear, chosen).null.variances
    beside_chosen = replace(linear, null=at_variances(linear.mixed, variances))
    forms = [chosen_forms.get(c.name) or c.forms[0] for c in eligible]
    white = [beside_chosen.residual(form.columns) * form.sizes for form in forms]
    bounds = np.cumsum([0, *(columns.shape[1] for columns in white)])
    columns_of = [np.arange(begin, end) for begin, end in pairwise(bounds)]
    stacked = np.hstack(white)
    information = stacked.T @ stacked
    vector = stacked.T @ beside_chosen.white_residual

    def log_posterior(members: Sequence[int]) -> float:
        """Return the log posterior of a set of candidates, by their indices in `eligible`, not yet normalised."""
        columns = np.concatenate([np.zeros(0, np.int64), *(columns_of[k] for k in members)])
        evidence = log_evidence_at_scales(information[np.ix_(columns, columns)], vector[columns], PLAUSIBLE)
        return log_mixture(evidence, PLAUSIBLE) + len(members) * float(np.log(limits.PRIOR_PHYSICAL / len(eligible)))

    present = [k for k, c in enumerate(eligible) if c.name in chosen_forms]
    others = [k for k in range(len(eligible)) if k not in present]
    best = list[int]()
    best_log_posterior = log_posterior(present) + limits.ODDS
    for removed in (some for count in range(1, _MOST_REMOVED + 1) for some in combinations(present, count)):
        rest = [k for k in present if k not in removed]
        members = select_forward(log_posterior, others, rest, limits.MAX_JOINT_EFFECTS)
        members = eliminate_backward(log_posterior, members)
        if (value := log_posterior(members)) > best_log_posterior:
            best, best_log_posterior = members, value
    return [eligible[k] for k in best]


def is_better_set(linear: LinearModel, new: Sequence[Ranked], old: Sequence[Ranked]) -> bool:
    """Return whether a new set of effects is 20 to 1 likelier than an old one, and predicts views left out better.

    The log posteriors are those of fits with all variances.
    """
    likelier = _log_posterior(linear, new) > _log_posterior(linear, old) + limits.ODDS
    shares = [group_share(linear, [r.score for r in effects])[0] for effects in (new, old)]
    return bool(likelier and shares[0] < shares[1])


def _log_posterior(linear: LinearModel, chosen: Sequence[Ranked]) -> float:
    """Return the log posterior of several effects together, not yet normalised, fitted with all variances."""
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
        chosen = list(likeliest_first(filter(is_certain, parallel(partial(beside, rest), rest))))
