"""Effects that are missing at once: found one by one, each asked to hold its place beside all the others."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from stitch.diagnosis.candidates import Candidate, candidate_as_fitted, candidates_of
from stitch.diagnosis.exchanged_sets import exchanged_set, is_better_set
from stitch.diagnosis.ranking import Ranked, conditioned_on_effects, conditioned_without, is_certain, rank, rank_one
from stitch.diagnosis.regime import regime_of
from stitch.diagnosis.score import promising, score
from stitch.diagnosis.thresholds import CANDIDATES_TRIED, MANY_POSES, MAX_JOINT_EFFECTS, NEAR_BEST_GAIN
from stitch.diagnosis.validation import Extrapolation, cross_validate, extrapolate, untested_ends_reason
from stitch.fit.pipelines import linearise
from stitch.model.model import Term
from stitch.observations.linear_model import LinearModel
from stitch.run_data import RunData
from stitch.system.threads import parallel

# Whether the effects of a model still hold their place beside each other.


def find_effect_to_drop(state: RunData, names: Collection[str]) -> tuple[str, str] | None:
    """The weakest effect of labelled points that does not hold its place beside all others, and why; None if all do.

    Effects are asked at once, of many poses one after the other. Scans, whose overlaps are found by all cores already,
    do not allow it.

    Args:
        names: effects of the model that may go.
    """
    asked = [term for term in state.model.terms if term.name in names]
    each = parallel if state.measurement.views.count < MANY_POSES else map
    found = zip(asked, each(partial(_test_effect, state), asked), strict=True)
    failing = [(factor, term.name, reason) for term, (factor, reason) in found if reason is not None]
    if not failing:
        return None
    _, name, reason = min(failing)
    return name, reason


def _test_effect(state: RunData, term: Term) -> tuple[float, str | None]:
    """Log Bayes factor of an effect beside the others, and why it should go, if it should."""
    name = term.name
    linear = linearise(state.session, state.measurement, state.model.without(name), state.gate)
    candidate = candidate_as_fitted(linear, term)
    if not candidate.forms[0].keep.any():
        return 0.0, f"{name} is not seen beside the others"
    own = rank_one(linear, candidate, tests=1)
    factor = own.score.log_bayes_factor
    if not is_certain(own):
        return factor, f"{name} explains too little beside the others"
    return factor, cross_validate(linear, own.score).rejection_reason(name)


# An effect that errs at some end gives way to one that does the same and is likelier to hold beyond.
#
# Two effects may each leave nothing to the other among the measured poses. What an imitation gains is no measure then:
# it has the more parameters, gains more, and is far off where nothing was measured. Ends that were left out tell the
# two apart as far as these poses can.


@dataclass(frozen=True)
class Exchange:
    """One effect for another."""

    name: str  # that gives way
    rejection_reason: str
    replacement: Ranked


def find_exchange(
    linear: LinearModel,
    candidates: Sequence[Candidate],
    chosen: Sequence[Ranked],
    beyond: Mapping[str, Extrapolation | None],
) -> Exchange | None:
    """The first effect that has to give way; None if all may stay.

    Args:
        candidates: that may take a place.
        chosen: effects beside each other.
        beyond: what each of them does at the ends, beside the others.
    """
    for r in chosen:
        found = beyond[r.name]
        if found is None or not found.errs_somewhere:
            continue
        rest = conditioned_without(linear, chosen, r)
        rivals = _better_extrapolating_effects(
            rest, [c for c in candidates if c.name not in {own.name for own in chosen}], found
        )
        for rival in rivals:
            beside = conditioned_on_effects(rest, [rival])
            left = extrapolate(beside, rank_one(beside, r.score.candidate, len(candidates)).score)
            if left is not None and not left.helps:
                return Exchange(r.name, f"{left.rejection_reason(r.name)}; this beside {rival.name}", rival)
    return None


def _better_extrapolating_effects(
    rest: LinearModel, candidates: Sequence[Candidate], found: Extrapolation
) -> list[Ranked]:
    """Effects that are likelier to hold at a further end than one that was found, the likeliest first."""
    out = list[tuple[float, Ranked]]()
    for candidate, _ in promising(rest, candidates, CANDIDATES_TRIED):
        other = rank_one(rest, candidate, len(candidates))
        own = extrapolate(rest, other.score) if is_certain(other) else None
        if own is not None and own.helps and own.likely > found.likely:
            out.append((own.likely, other))
    return [other for _, other in sorted(out, key=lambda item: -item[0])]


@dataclass(frozen=True)
class ForwardSelection:
    """Effects beside each other; first the one without which most would stay unexplained."""

    effects: tuple[Ranked, ...]
    explained: float  # log posterior of what was found one by one
    refused: dict[str, str]  # effects that explain much and are not among them, and why


def forward_selection(linear: LinearModel, candidates: Sequence[Candidate], best: Ranked) -> ForwardSelection:
    """Effects that are missing at once.

    One effect alone may explain more than each of two that are there, because it imitates a part of both. So
    effects are added one by one as long as one can be named beside those before; then each must hold its
    place beside all the others. What was found first may still stand in the way of others that together do more: they
    take its place where they also predict views left out better (`exchanged_set`).
    """
    every = [c for c in candidates if not c.empirical]
    found = _stable_selection(linear, every, _add_effects(linear, every, [best]))
    while (other := _better_selection(linear, every, found)) is not None:
        found = other
    return found


def find_better_effects(state: RunData, added: Collection[str]) -> list[str]:
    """Effects that together do better than those that were added to a model, some of which they do without; else none.

    Args:
        added: effects of the model that may go.
    """
    terms = [term for term in state.model.terms if term.name not in added]
    linear = linearise(state.session, state.measurement, state.model.with_terms(terms), state.gate)
    every = [c for c in candidates_of(linear, empirical=False)[0] if c.name not in state.tried]
    chosen = tuple(rank_one(linear, c, len(every)) for c in every if c.name in added)
    found = _better_selection(linear, every, ForwardSelection(chosen, 0.0, {}))
    return [] if found is None else [r.name for r in found.effects]


def _better_selection(
    linear: LinearModel, every: Sequence[Candidate], found: ForwardSelection
) -> ForwardSelection | None:
    """Other effects that hold their place, and together do better; None where there are none.

    What was refused, as it errs beyond the measured poses, is not tried again.
    """
    instead = exchanged_set(linear, [c for c in every if c.name not in found.refused], found.effects)
    if not instead:
        return None
    other = _stable_selection(linear, every, [rank_one(linear, c, len(every)) for c in instead])
    return other if is_better_set(linear, other.effects, found.effects) else None


def _stable_selection(linear: LinearModel, every: Sequence[Candidate], chosen: Sequence[Ranked]) -> ForwardSelection:
    """Effects of those chosen that hold their place, with others that then can be named.

    Of those that err beyond the measured poses the one that errs most is left out, and the search goes on: what it
    imitated others may explain. At last one that errs at some end gives way to another that does the same and is
    likelier to hold beyond.
    """
    candidates, gone, unseen, refused = list(every), set[str](), set[str](), dict[str, str]()
    explained = sum(r.log_posterior for r in chosen)
    while True:
        chosen, beyond = _eliminate_backward(linear, chosen, len(candidates))
        erring = {name: found for name, found in beyond.items() if found is not None and not found.helps}
        if erring:
            name = max(erring, key=lambda name: erring[name].share)
            refused[name], instead = erring[name].rejection_reason(name), list[Ranked]()
            (unseen.add if erring[name].unseen else unseen.discard)(name)
        elif (exchange := find_exchange(linear, [c for c in every if c.name not in gone], chosen, beyond)) is not None:
            name, instead = exchange.name, [exchange.replacement]
            refused.pop(exchange.replacement.name, None)  # it erred beside the one that gives way
            refused[name] = exchange.rejection_reason
            gone.add(name)
            unseen -= {name, exchange.replacement.name}
        else:
            if len(unseen) > 1:
                refused |= dict.fromkeys(unseen, untested_ends_reason(sorted(unseen)))
            likeliest_first = tuple(sorted(chosen, key=lambda r: -r.log_posterior))
            return ForwardSelection(likeliest_first, explained, refused)
        candidates = [c for c in candidates if c.name != name]
        chosen = _add_effects(linear, candidates, [*(r for r in chosen if r.name != name), *instead])


def keep_worth_adding(linear: LinearModel, chosen: Sequence[Ranked], tests: int) -> tuple[list[Ranked], dict[str, str]]:
    """Effects beside each other that all help on views left out; and what is idle, the weakest first.

    What would be dropped again as soon as it is in the model is neither named nor added: of hundreds of poses an effect
    is seen that moves hardly anything, and that anything else may do as well.

    Args:
        tests: candidates among which they were chosen.
    """
    chosen, idle = list(chosen), dict[str, str]()
    while True:
        objections = (
            (r, cross_validate(conditioned_without(linear, chosen, r), r.score).rejection_reason(r.name))
            for r in reversed(chosen)
        )
        first = next(((r, why) for r, why in objections if why is not None), None)
        if first is None:
            return chosen, idle
        gone, idle[first[0].name] = first
        rest = [r for r in chosen if r.name != gone.name]
        again = parallel(partial(_rank_given_others, linear, rest, tests), rest)
        chosen = sorted(filter(is_certain, again), key=lambda r: -r.log_posterior)


def _rank_given_others(linear: LinearModel, chosen: Sequence[Ranked], tests: int, r: Ranked) -> Ranked:
    """One of the effects chosen, asked beside the others of them."""
    return rank_one(conditioned_without(linear, chosen, r), r.score.candidate, tests, r.score.variances)


def _add_effects(linear: LinearModel, candidates: Sequence[Candidate], chosen: Sequence[Ranked]) -> list[Ranked]:
    """Further effects, one by one, as long as one can be named beside those before."""
    chosen = list(chosen)
    while len(chosen) < MAX_JOINT_EFFECTS:
        following = _next_effect(
            conditioned_on_effects(linear, chosen), [c for c in candidates if c.name not in {r.name for r in chosen}]
        )
        if following is None:
            break
        chosen.append(following)
    return chosen


def _next_effect(base: LinearModel, others: Sequence[Candidate]) -> Ranked | None:
    """The effect that explains most of what is left, if it can be named.

    What seems to gain less than half of the best is fitted only where nothing else can be named: beside that one it
    has its turn again.
    """
    likely = promising(base, others, CANDIDATES_TRIED)
    near = [c for c, gain in likely if gain >= NEAR_BEST_GAIN * likely[0][1]]
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
    """The effects that can still be named beside all the others, and what each does beyond the measured poses."""

    near = conditioned_on_effects(linear, chosen).null.variances if not regime_of(linear).prior else None

    def extrapolated(r: Ranked, among: Sequence[Ranked] = chosen) -> tuple[Ranked, Extrapolation | None]:
        beside = conditioned_without(linear, among, r, near)
        own = rank_one(beside, r.score.candidate, tests, near)
        return own, extrapolate(beside, own.score) if is_certain(own) else None

    # Mostly all hold their place: then none was asked beside one that goes, and the order is of no account.
    kept, beyond, as_asked = list(chosen), dict[str, Extrapolation | None](), True
    for r, at_once in zip(chosen, list(parallel(extrapolated, chosen)), strict=True):
        own, found = at_once if as_asked else extrapolated(r, kept)
        others = [other for other in kept if other.name != r.name]
        if not (is_certain(own) and own.score.form is r.score.form):
            beyond, as_asked = {}, False  # what was asked of the others was asked beside this one
        kept = [*others, own] if is_certain(own) else others
        if is_certain(own):
            beyond[own.name] = found
    for r in kept:
        if r.name not in beyond:
            beyond[r.name] = extrapolate(conditioned_without(linear, kept, r, near), r.score)
    return kept, {r.name: beyond[r.name] for r in kept}
