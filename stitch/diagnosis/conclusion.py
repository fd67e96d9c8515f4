"""The verdict, held against views left out, halves of the views and what the scanner itself may do wrong."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from stitch.diagnosis.candidates import Candidate
from stitch.diagnosis.plausible_scatter import ScatterLimit
from stitch.diagnosis.scanner_first import check_scanner_errors
from stitch.diagnosis.selection.pairs import find_missing_pair
from stitch.diagnosis.selection.ranking import Ranked, is_certain
from stitch.diagnosis.selection.upheld import pair_is_validated, validate_named
from stitch.diagnosis.selection.verdict import Selection, select
from stitch.diagnosis.thresholds import MANY_VIEWS
from stitch.diagnosis.validation.cross_validation import CrossValidation, cross_validate
from stitch.diagnosis.validation.halves import validate_in_halves
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.field_error import FieldError


def decide(linear: LinearModel, candidates: Sequence[Candidate], limit: ScatterLimit) -> Selection:
    """The verdict alone: selected, and held against all that may speak against it."""
    selection = select(linear, candidates, limit)
    return check_verdict(linear, candidates, selection, cross_validate_named(linear, selection))[0]


def cross_validate_named(linear: LinearModel, selection: Selection) -> dict[str, CrossValidation]:
    """What each effect that may be named does on views left out: beside all that it was named beside, or, where pose
    errors have no prior, alone, as it would be added next."""
    alone = {r.name: r.score for r in selection.ranked}
    asked = {r.name: r.score if r.score.base_model else alone[r.name] for r in _named_effects(selection)}
    return {name: cross_validate(linear, score) for name, score in asked.items()}


def check_verdict(
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
        return check_scanner_errors(linear, selection)
    found = check_scanner_errors(linear, _keep_validated(linear, selection, left_out))
    two = None if found[0].named else _name_pair(linear, candidates, selection)
    with_second = found if two is None else check_scanner_errors(linear, two)
    return with_second if with_second[0].named else found


def _keep_validated(linear: LinearModel, selection: Selection, left_out: Mapping[str, CrossValidation]) -> Selection:
    """What holds on views left out and in halves. A second effect that is named without the first is asked alone, and
    is not named where alone it is not certain."""
    held = validate_named(selection, left_out, {r.name: validate_in_halves(r.score) for r in _named_effects(selection)})
    if not held.named or held.named[0] is selection.named[0]:
        return held
    alone = next(r for r in selection.ranked if r.name == held.named[0].name)
    if not is_certain(alone):
        return replace(held, verdict="unknown_effect", named=())
    again = replace(held, named=(alone,))
    return validate_named(again, cross_validate_named(linear, again), {alone.name: validate_in_halves(alone.score)})


def _named_effects(selection: Selection) -> list[Ranked]:
    return [r for r in (*selection.named, selection.second) if r is not None]


def _name_pair(linear: LinearModel, candidates: Sequence[Candidate], selection: Selection) -> Selection | None:
    """Two effects named where the first, the likeliest of all, does not stand alone: what the second does made it
    another in each half of the views, or looked like a smooth error of the scanner."""
    if linear.measurement.views.count >= MANY_VIEWS:
        return None
    two = find_missing_pair(linear, candidates, selection.named[0])
    if two is None or two[0].name != selection.named[0].name or not pair_is_validated(linear, two):
        return None
    return replace(selection, named=two[:1], second=two[1])
