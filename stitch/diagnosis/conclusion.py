"""The verdict, held against views left out, halves of the views and what the scanner itself may do wrong."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from stitch.diagnosis.candidates import Candidate
from stitch.diagnosis.plausible_scatter import ScatterLimit
from stitch.diagnosis.scanner_first import scanner_first
from stitch.diagnosis.selection.pairs import both_missing
from stitch.diagnosis.selection.ranking import Ranked
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
    """What each effect that may be named does on views left out, beside all that it was named beside."""
    return {r.name: cross_validate(linear, r.score) for r in _asked(selection)}


def upheld(
    linear: LinearModel,
    candidates: Sequence[Candidate],
    selection: Selection,
    left_out: Mapping[str, CrossValidation],
) -> tuple[Selection, FieldError | None]:
    """What may still be named, and the scanner's own error where that is part of the answer.

    Args:
        left_out: of `on_views_left_out`.
    """
    if selection.verdict == "missing_effect":
        held = validated(selection, left_out, {r.name: halves(r.score) for r in _asked(selection)})
        selection = held if held.named else _together(linear, candidates, selection) or held
    return scanner_first(linear, selection)


def _asked(selection: Selection) -> list[Ranked]:
    return [r for r in (*selection.named, selection.second) if r is not None]


def _together(linear: LinearModel, candidates: Sequence[Candidate], selection: Selection) -> Selection | None:
    """Two effects named where the first, the likeliest of all, does not hold alone: what the second does made it
    another in each half."""
    if linear.measurement.views.count >= MANY_VIEWS:
        return None
    two = both_missing(linear, candidates, selection.named[0])
    if two is None or two[0].name != selection.named[0].name or not hold_together(linear, two):
        return None
    return replace(selection, named=two[:1], second=two[1])
