"""A scanner that errs over its field more clearly than anything else: it is said first, and no name is given beside it.

Poses found by such a scanner are off too, and an effect that explains some of that is not thereby there.
"""

from dataclasses import replace

from stitch.diagnosis.selection.verdict import Selection
from stitch.diagnosis.within_overlaps import scanner_error
from stitch.model.forward import moves_points
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.scanner_field import FieldError


def scanner_first(linear: LinearModel, selection: Selection) -> tuple[Selection, FieldError | None]:
    """A verdict held against what the overlaps show of the scanner's field, and that where it is part of the answer.

    Where nothing is missing it stays beside the verdict, as long as it is smaller than the noise. A name is not given
    where the data want the scanner's error, beside it, more than the effect itself.
    """
    unknown = replace(selection, verdict="unknown_effect", named=(), second=None)
    if selection.verdict == "adequate":
        found = scanner_error(linear)
        return (unknown if found is not None and found.over_noise else selection), found
    if selection.verdict != "missing_effect":
        return selection, None
    named = selection.named[0]
    terms = [named.score.form.term]
    found = scanner_error(linear, beside=terms if moves_points(terms) else ())
    if found is None or found.gain < named.score.log_bayes_factor:
        return selection, None
    return replace(unknown, notes=(f"{named.name} is less clear than that", *selection.notes)), found
