"""Whether a name stands before the views that took no part in choosing it."""

from collections.abc import Mapping
from dataclasses import replace

from stitch.diagnosis.selection.ranking import Ranked, conditioned_on_effects
from stitch.diagnosis.selection.verdict import Selection
from stitch.diagnosis.thresholds import MIN_STEADINESS
from stitch.diagnosis.validation.cross_validation import CrossValidation, cross_validate
from stitch.diagnosis.validation.halves import Halves, validate_in_halves
from stitch.observations.linear_model import LinearModel


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
