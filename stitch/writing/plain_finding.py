"""What a diagnosis found in one sentence that everybody on the shop floor understands.

Terminal, page, recording and review all say it so; the diagnosis' own sentence stands below as evidence.
"""

from stitch.diagnosis.diagnosis import Diagnosis
from stitch.diagnosis.sentences import odds_text
from stitch.diagnosis.thresholds import HELDOUT_FALL, MAX_REMAINING_SHARE
from stitch.diagnosis.validation.cross_validation import CrossValidation
from stitch.diagnosis.validation.group_validation import group_helps, group_share
from stitch.observations.surfaces.field_error import FieldError
from stitch.runs.doubt_headline import doubt_headline
from stitch.units import length_text
from stitch.writing.plain_effects import effect_in_words

# What is left follows a covariate: p-value below which everybody is told, as in the diagnosis' own sentence.
_DEPENDENCE_P_VALUE = 0.01


def plain_finding(found: Diagnosis, length_unit: str) -> str:
    """What is doubted of the session as a whole, what is missing, and how far the error should fall with it."""
    finding = _finding(found, length_unit)
    if not found.doubts:
        return finding
    doubted = " ".join(doubt_headline(doubt) for doubt in found.doubts)
    return f"{doubted} What is found beside that may be no more than its mark. {finding}"


def _finding(found: Diagnosis, length_unit: str) -> str:
    """What is missing, and how far the error should fall with it."""
    named = " or ".join(effect_in_words(name) for name in found.effects)
    doubt = (
        "" if found.certain else f" The odds that it is more than chance are {odds_text(found.log_odds_over_nothing)}."
    )
    match found.verdict:
        case "adequate":
            return f"No effect is found missing: {_remaining_error(found.scanner_error, length_unit)} explain what is left."
        case "cannot_tell":
            something = "Something is" if found.certain else "Something may be"
            return f"{something} missing in the model, and these views cannot tell whether it is {named}.{doubt}"
        case "unknown_effect":
            return f"Something is missing in the model that no effect of the library explains{_error_location(found)}."
    validation = next(c for c in found.candidates if c.name == found.effects[0]).cross_validation
    though = "" if found.likelier_than_not else ", though chance is likelier"
    missing = "Missing in the model" if found.certain else f"Perhaps missing in the model{though}"
    if validation is None:
        return f"{missing}: {named}.{doubt}"
    return f"{missing}: {named}.{doubt} {_expected_gain(found.residual_rms, validation, length_unit)}"


def _expected_gain(residual_rms: float, validation: CrossValidation, length_unit: str) -> str:
    """How far the error should fall, or where else the effect shows: a small one moves poses by less than chance
    moves a residual."""
    share = validation.inside**0.5
    before, after = (length_text(rms, length_unit) for rms in (residual_rms, share * residual_rms))
    if share < HELDOUT_FALL:
        return f"Adding it should bring the error from {before} to {after} (rms)."
    small = f"It is too small for the error to show ({before} now, {after} with it, rms)"
    if validation.poses > MAX_REMAINING_SHARE:
        return f"{small}."
    return (
        f"{small}, but views left out should be predicted about {1 - validation.poses**0.5:.0%} better, in units of "
        "their scatter."
    )


def _remaining_error(smooth: FieldError | None, length_unit: str) -> str:
    """What explains the rest where no effect is missing."""
    if smooth is None:
        return "noise and the arm's scatter"
    size = length_text(smooth.rms_by_view if smooth.by_view else smooth.rms, length_unit, 2)
    own = f"each scan's own error ({size}" if smooth.by_view else f"the scanner's own error ({size} over its field"
    return f"noise, the arm's scatter and {own}, which no pose corrects)"


def _error_location(found: Diagnosis) -> str:
    """The scanner or the joint that errs, or what the rest follows as clearly as in the diagnosis' own sentence."""
    if found.follows_field and found.scanner_error is not None and found.scanner_error.by_view:
        return ": every scan errs in its own way, as if the part bent or the scanner changed"
    if found.follows_field:
        return ": the scanner errs by where in its field a point is seen"
    joints = " or ".join(f"joint {k}" for k in sorted({curve.joint for curve in found.curves}))
    if joints:
        return f": {joints} errs by a law that has no name"
    if found.time_curve is not None:
        return ": the poses err in the course of time, by a law that has no name"
    if found.overlap_misfit:
        return ": the scanner or the part's shape is off, and not the poses alone"
    follows = [x.covariate for x in found.depends_on if x.p_value < _DEPENDENCE_P_VALUE]
    if follows:
        return f": what is left follows {' and '.join(follows[:2])}"
    # The likeliest name, and why it does not hold.
    return f": {found.notes[0]}" if found.notes else ""


def suggested_command(found: Diagnosis, run: str) -> str:
    """The command that most would type now, with what it is for; `run` as it has to be typed."""
    if found.doubts:
        return f"Next: put right what is doubted; it stands in full in: stitch review {run}"
    match found.verdict:
        case "missing_effect" if not found.likelier_than_not:
            return f"Next, what would tell it from chance: stitch next {run}"
        case "missing_effect":
            return f"Next: stitch add {run} --suggested"
        case "cannot_tell" if not _group_helps(found):
            return f"Next, what would tell them apart: stitch next {run}"
        case "cannot_tell":
            return f"Fitted as one, if that helps: stitch add {run} --group"
        case "unknown_effect" if found.curves or found.time_curve is not None:
            return f"A formula for it, if there is one: stitch explain {run} -o mine.py"
        case "unknown_effect":
            return f"Next, to see where it fails: stitch review {run}"
    return f"Next: stitch export {run} --to ros"


def _group_helps(found: Diagnosis) -> bool:
    """False where `stitch add --group` would refuse, or has just refused: together they predict no view left out."""
    share, sigma = group_share(found.linear, [c.ranked.score for c in found.candidates if c.name in found.effects])
    return group_helps(share, sigma)
