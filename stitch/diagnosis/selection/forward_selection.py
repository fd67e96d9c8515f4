"""Effects that are missing at once: found one by one, each asked to hold its place beside all the others."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from stitch.diagnosis.candidates import Candidate
from stitch.diagnosis.score import promising, score
from stitch.diagnosis.selection.exchange import find_exchange
from stitch.diagnosis.selection.ranking import (
    Ranked,
    conditioned_on_effects,
    conditioned_without,
    is_certain,
    rank,
    rank_one,
)
from stitch.diagnosis.thresholds import CANDIDATES_TRIED, MAX_JOINT_EFFECTS
from stitch.diagnosis.validation.cross_validation import cross_validate
from stitch.diagnosis.validation.extrapolation import Extrapolation, extrapolate, untested_ends_reason
from stitch.observations.linear_model import LinearModel
from stitch.system.threads import parallel


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
    place beside all the others. Of those that err beyond the measured poses the one that errs most is left out, and
    the search goes on: what it imitated others may explain. At last one that errs at some end gives way to another that
    does the same and is likelier to hold beyond.
    """
    every, gone = [c for c in candidates if not c.empirical], set[str]()
    candidates, unseen = every, set[str]()
    chosen, refused = _add_effects(linear, candidates, [best]), dict[str, str]()
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
            return ForwardSelection(tuple(sorted(chosen, key=lambda r: -r.log_posterior)), explained, refused)
        candidates = [c for c in candidates if c.name != name]
        chosen = _add_effects(linear, candidates, [*(r for r in chosen if r.name != name), *instead])


def keep_worth_adding(linear: LinearModel, chosen: Sequence[Ranked], tests: int) -> tuple[list[Ranked], dict[str, str]]:
    """Effects beside each other of which the first two, those that are told, help on views left out; and what is idle.

    What would be dropped again as soon as it is in the model is not named: of hundreds of poses an effect is seen that
    moves hardly anything, and that anything else may do as well.

    Args:
        tests: candidates among which they were chosen.
    """
    chosen, idle = list(chosen), dict[str, str]()
    while True:
        objections = (
            (r, cross_validate(conditioned_without(linear, chosen, r), r.score).rejection_reason(r.name))
            for r in chosen[:2]
        )
        first = next(((r, why) for r, why in objections if why is not None), None)
        if first is None:
            return chosen, idle
        gone, idle[first[0].name] = first
        rest = [r for r in chosen if r.name != gone.name]
        again = [rank_one(conditioned_without(linear, rest, r), r.score.candidate, tests) for r in rest]
        chosen = sorted(filter(is_certain, again), key=lambda r: -r.log_posterior)


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
    near = [c for c, gain in likely if gain >= 0.5 * likely[0][1]]
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

    near = conditioned_on_effects(linear, chosen) if linear.pose_errors is None else None

    def asked(r: Ranked, among: Sequence[Ranked] = chosen) -> tuple[Ranked, Extrapolation | None]:
        beside = conditioned_without(linear, among, r, near)
        own = rank_one(beside, r.score.candidate, tests)
        return own, extrapolate(beside, own.score) if is_certain(own) else None

    # Mostly all hold their place: then none was asked beside one that goes, and the order is of no account.
    kept, beyond, as_asked = list(chosen), dict[str, Extrapolation | None](), True
    for r, at_once in zip(chosen, list(parallel(asked, chosen)), strict=True):
        own, found = at_once if as_asked else asked(r, kept)
        others = [other for other in kept if other.name != r.name]
        if not _certain_in_same_form(r, own):
            beyond, as_asked = {}, False  # what was asked of the others was asked beside this one
        kept = [*others, own] if is_certain(own) else others
        if is_certain(own):
            beyond[own.name] = found
    for r in kept:
        if r.name not in beyond:
            beyond[r.name] = extrapolate(conditioned_without(linear, kept, r, near), r.score)
    return kept, {r.name: beyond[r.name] for r in kept}


def _certain_in_same_form(r: Ranked, again: Ranked) -> bool:
    """True if an effect is certain again, in the same form."""
    return is_certain(again) and again.score.form is r.score.form
