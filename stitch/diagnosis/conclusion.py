"""The verdict, held against views left out, halves of the views and what the scanner itself may do wrong."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from stitch.diagnosis.candidates import Candidate
from stitch.diagnosis.plausible_scatter import ScatterLimit
from stitch.diagnosis.scanner_first import scanner_first
from stitch.diagnosis.selection.pairs import both_missing
from stitch.diagnosis.selection.ranking import Ranked, certain
from stitch.diagnosis.selection.upheld import hold_together, validated
from stitch.diagnosis.selection.verdict import Selection, select
from stitch.diagnosis.thresholds import MANY_VIEWS
from stitch.diagnosis.validation.cross_validation import CrossValidation, cross_validate
from stitch.diagnosis.validation.halves import halves
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.field_error import FieldError


def concluded(linear: LinearModel, candidates: Sequence[Candidate], limit: ScatterLimit) -> Selection:
    """The verdict alone: selected, and held against all that may speak against it."""
    selection = select(linear, candidates, limit)
    return upheld(linear, candidates, selection, on_views_left_out(linear, selection))[0]


def on_views_left_out(linear: LinearModel, selection: Selection) -> dict[str, CrossValidation]:
    """What each effect that may be named does on views left out: beside all that it was named beside, or, where pose
    errors have no prior, alone, as it would be added next."""
    alone = {r.name: r.score for r in selection.ranked}
    asked = {r.name: r.score if r.score.beside else alone[r.name] for r in _asked(selection)}
    return {name: cross_validate(linear, score) for name, score in asked.items()}


def upheld(
    linear: LinearModel,
    candidates: Sequence[Candidate],
    selection: Selection,
    left_out: Mapping[str, CrossValidation],
) -> tuple[Selection, FieldError | None]:
    """What may still be named, and the scanner's own error where that is part of the answer.

    Where a name does not stand, a second effect that is missing too may be why.

    Args:
        left_out: of `on_views_left_out`.
    """
    if selection.verdict != "missing_effect":
        return scanner_first(linear, selection)
    found = scanner_first(linear, _held(linear, selection, left_out))
    two = None if found[0].named else _together(linear, candidates, selection)
    with_second = found if two is None else scanner_first(linear, two)
    return with_second if with_second[0].named else found


def _held(linear: LinearModel, selection: Selection, left_out: Mapping[str, CrossValidation]) -> Selection:
    """What holds on views left out and in halves. A second effect that is named without the first is asked alone, and
    is not named where alone it is not certain."""
    held = validated(selection, left_out, {r.name: halves(r.score) for r in _asked(selection)})
    if not held.named or held.named[0] is selection.named[0]:
        return held
    alone = next(r for r in selection.ranked if r.name == held.named[0].name)
    if not certain(alone):
        return replace(held, verdict="unknown_effect", named=())
    again = replace(held, named=(alone,))
    return validated(again, on_views_left_out(linear, again), {alone.name: halves(alone.score)})


def _asked(selection: Selection) -> list[Ranked]:
    return [r for r in (*selection.named, selection.second) if r is not None]


def _together(linear: LinearModel, candidates: Sequence[Candidate], selection: Selection) -> Selection | None:
    """Two effects named where the first, the likeliest of all, does not stand alone: what the second does made it
    another in each half of the views, or looked like a smooth error of the scanner."""
    if linear.measurement.views.count >= MANY_VIEWS:
        return None
    two = both_missing(linear, candidates, selection.named[0])
    if two is None or two[0].name != selection.named[0].name or not hold_together(linear, two):
        return None
    return replace(selection, named=two[:1], second=two[1])
