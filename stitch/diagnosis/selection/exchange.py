"""An effect that errs at some end gives way to one that does the same and is likelier to hold beyond.

Two effects may each leave nothing to the other among the measured poses. What an imitation gains is no measure then: it
has the more parameters, gains more, and is far off where nothing was measured. Ends that were left out tell the two
apart as far as these poses can.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from stitch.diagnosis.candidates import Candidate
from stitch.diagnosis.score import promising
from stitch.diagnosis.selection.ranking import Ranked, conditioned_on_effects, conditioned_without, is_certain, rank_one
from stitch.diagnosis.thresholds import CANDIDATES_TRIED
from stitch.diagnosis.validation.extrapolation import Extrapolation, extrapolate
from stitch.observations.linear_model import LinearModel


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
