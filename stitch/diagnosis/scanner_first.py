"""Scans that err smoothly, more clearly than anything else: it is said first, and no name is given beside it.

Poses found from such scans are off too, and an effect that explains some of that is not thereby there.
"""

from dataclasses import replace

from stitch.diagnosis.selection.verdict import Selection
from stitch.diagnosis.within_overlaps import find_scanner_error
from stitch.model.forward import moves_points
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.field_error import FieldError


def check_scanner_errors(linear: LinearModel, selection: Selection) -> tuple[Selection, FieldError | None]:
    """A verdict held against what the overlaps show of smooth errors, and those where they are part of the answer.

    Where nothing is missing it stays beside the verdict, as long as it is smaller than the noise. A name is not given
    where the data want smooth errors, beside it, more than the effect itself.
    """
    unknown = replace(selection, verdict="unknown_effect", named=(), second=None)
    if selection.verdict == "adequate":
        found = find_scanner_error(linear)
        return (unknown if found is not None and found.over_noise else selection), found
    if selection.verdict != "missing_effect":
        return selection, None
    named = selection.named[0]
    said = [r.score.form.term for r in (named, selection.second) if r is not None]
    found = find_scanner_error(linear, other_terms=[term for term in said if moves_points([term])])
    if found is None or found.gain < named.score.log_bayes_factor:
        return selection, None
    return replace(unknown, notes=(f"{named.name} is less clear than that", *selection.notes)), found
