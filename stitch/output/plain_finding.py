"""What a diagnosis found in sentences that everybody on the shop floor understands.

Terminal, page, recording and review all say it so: what is missing, what would end it at the machine, the command that
most would type next, and where the error of whole views comes from.
"""

import math
from collections.abc import Sequence

from stitch.diagnosis.diagnosis import Diagnosis
from stitch.diagnosis.residual_structure import BudgetLine
from stitch.diagnosis.sentences import odds_text, unnamed_in_words, why_without_a_name
from stitch.diagnosis.systematic_laws import law_of
from stitch.diagnosis.thresholds import CLEAR_DEPENDENCE, HELDOUT_FALL, MAX_REMAINING_SHARE, ODDS
from stitch.diagnosis.validation import CrossValidation, group_helps, group_share
from stitch.numerics.units import length_text
from stitch.observations.surfaces.field_error import FieldError
from stitch.output.plain_words import REMEDIES, effect_in_words, plain_covariate
from stitch.run_data import doubt_headline, effect_cure

# Sources of the error below this share of the variance stand in one line.
_MIN_SHARE = 0.01
OTHER_SOURCES = "others"
# These scans are saved by the model; what is mended at the machine serves the next ones.
_AFTER_ADDING = ", after adding it"


def plain_finding(diagnosis: Diagnosis, length_unit: str) -> str:
    """Return the finding of a diagnosis in plain sentences, open doubts about the session first.

    A doubt, such as a moved part, may itself be the cause of what the diagnosis finds.
    """
    finding = _finding(diagnosis, length_unit)
    doubts = open_doubts(diagnosis)
    if not doubts:
        return finding
    headlines = " ".join(doubt_headline(doubt) for doubt in doubts)
    return f"{headlines} The findings below may only be consequences of this problem. {finding}"


def open_doubts(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Return the doubts about the session, without one that the effect named by the diagnosis would explain."""
    return tuple(doubt for doubt in diagnosis.doubts if doubt != _doubt_with_same_cure(diagnosis))


def _doubt_with_same_cure(diagnosis: Diagnosis) -> str | None:
    """Return the doubt about the session whose text proposes to fit the effect that is missing; None where none does.

    None also where several doubts propose that effect: then it cannot be told which of them it explains.
    """
    if not diagnosis.doubts or diagnosis.verdict != "missing_effect" or not diagnosis.likelier_than_not:
        return None
    same = [doubt for doubt in diagnosis.doubts if effect_cure(diagnosis.effects[0]) in doubt]
    return same[0] if len(same) == 1 else None


def _finding(diagnosis: Diagnosis, length_unit: str) -> str:
    """Return what is missing in plain sentences, by the verdict, and how far the error should fall with it."""
    named = " or ".join([*map(effect_in_words, diagnosis.effects), *unnamed_in_words(diagnosis)])
    sure = diagnosis.certain or diagnosis.log_odds_over_nothing > ODDS
    odds = "" if sure else f" The odds against chance are {odds_text(diagnosis.log_odds_over_nothing)}."
    match diagnosis.verdict:
        case "adequate":
            return (
                f"No missing effect was found: {_remaining_error(diagnosis.scanner_error, length_unit)} explain the "
                "remaining error."
            )
        case "cannot_tell":
            something = "Something is" if diagnosis.certain else "Something may be"
            return f"{something} missing in the model: {named}. These views cannot tell which.{odds}"
        case "unknown_effect":
            return unnamed_finding(diagnosis)
    validation = next(c for c in diagnosis.candidates if c.name == diagnosis.effects[0]).cross_validation
    though = "" if diagnosis.likelier_than_not else ", though chance is more likely"
    missing = "Missing in the model" if diagnosis.certain else f"Perhaps missing in the model{though}"
    if (doubt := _doubt_with_same_cure(diagnosis)) is not None:
        headline = doubt_headline(doubt).removesuffix(".")
        named = f"{diagnosis.effects[0]} ({headline[0].lower()}{headline[1:]})"
    if diagnosis.dropped_before is not None:
        return f"{missing}: {named}.{odds} It was tried in this run and dropped: {diagnosis.dropped_before}."
    if validation is None:
        return f"{missing}: {named}.{odds}"
    return f"{missing}: {named}.{odds} {_expected_gain(diagnosis.residual_rms, validation, length_unit)}"


def unnamed_finding(diagnosis: Diagnosis) -> str:
    """Return a sentence on an error without a name: why it has none, and what it follows or where it is."""
    return f"Something is missing in the model, and {why_without_a_name(diagnosis)}{_error_location(diagnosis)}."


def _expected_gain(residual_rms: float, validation: CrossValidation, length_unit: str) -> str:
    """Return a sentence on what adding an effect should bring, by cross-validation.

    That is the fall of the rms residual. Where this is too small to see, it is the better prediction of the poses of
    views left out, if there is any.

    Args:
        residual_rms: of the run, length_unit.
        validation: `inside` and `poses` are the shares of the mean square error that the effect leaves.
    """
    share = validation.inside**0.5
    before = length_text(residual_rms, length_unit)
    after = length_text(share * residual_rms, length_unit)
    if share < HELDOUT_FALL:
        return f"Adding it should reduce the error from {before} to {after} (rms)."
    small = f"The effect is too small to change the error visibly ({before} now, {after} with it, rms)"
    if validation.poses > MAX_REMAINING_SHARE:
        return f"{small}."
    better = f"about {1 - validation.poses**0.5:.0%} better, in units of their scatter"
    return f"{small}. Views left out should be predicted {better}."


def _remaining_error(scanner_error: FieldError | None, length_unit: str) -> str:
    """Return what explains the remaining error where no effect is missing, as a part of a sentence.

    Args:
        scanner_error: smooth error of the scanner, by view or over its field; None: none was found.
    """
    if scanner_error is None:
        return "noise and the arm's scatter"
    if scanner_error.by_view:
        source = f"each scan's own error ({length_text(scanner_error.rms_by_view, length_unit, 2)}"
    else:
        source = f"the scanner's own error ({length_text(scanner_error.rms, length_unit, 2)} over its field"
    return f"noise, the arm's scatter and {source}, which no pose corrects)"


def _error_location(diagnosis: Diagnosis) -> str:
    """Return the end of the sentence on an unknown effect: what the error follows, or where it is; may be empty.

    The most specific statement comes first: scanner, law, joint, time, shape of the part, then single covariates.
    """
    if errs_by_view(diagnosis):
        return ": each scan has its own error, as if the part bent or the scanner changed"
    if diagnosis.follows_field:
        return ": the scanner's error depends on the position in its field of view"
    if diagnosis.laws:
        return f": {' or '.join(unnamed_in_words(diagnosis))}"
    if diagnosis.curves:
        joints = " or ".join(dict.fromkeys(c.place for c in sorted(diagnosis.curves, key=lambda c: c.joint)))
        return f": the error follows {joints}, but no known formula"
    if diagnosis.time_curve is not None:
        return ": the pose errors change over time, but follow no known formula"
    if diagnosis.overlap_misfit:
        return ": the scanner or the part's shape is wrong, not only the poses"
    if follows := _clear_covariates(diagnosis):
        where = f", at {' or '.join(diagnosis.places)}" if diagnosis.places else ""
        return f": the remaining error follows {' and '.join(follows[:2])}{where}"
    # The likeliest name, and why it does not hold.
    return f": {diagnosis.notes[0]}" if diagnosis.notes else ""


def errs_by_view(diagnosis: Diagnosis) -> bool:
    """Return whether the scanner's error explains the finding and is another one in each scan."""
    return diagnosis.follows_field and diagnosis.scanner_error is not None and diagnosis.scanner_error.by_view


def _clear_covariates(diagnosis: Diagnosis) -> list[str]:
    """Return in words, each once, the covariates that the error follows clearly."""
    clear = (x.covariate for x in diagnosis.depends_on if x.p_value < CLEAR_DEPENDENCE)
    return [*dict.fromkeys(map(plain_covariate, clear))]


def remedy_at_machine(diagnosis: Diagnosis) -> str:
    """Return a sentence on what to do at the machine: how to end the effect that is named, or where to look.

    Empty where the effect is not certain, or where there is no place to look.
    """
    remedy, when = "", ""
    match diagnosis.verdict:
        case "unknown_effect":
            remedy = _where_to_look(diagnosis)
        case "missing_effect" if diagnosis.certain:
            remedy, when = REMEDIES.get(diagnosis.effects[0], ""), _AFTER_ADDING
        case "cannot_tell" if diagnosis.certain and not unnamed_in_words(diagnosis):
            remedies = {REMEDIES.get(effect, "") for effect in diagnosis.effects}
            remedy = remedies.pop() if len(remedies) == 1 else "change nothing until it is known which"
        case "adequate":
            added = dict.fromkeys(REMEDIES.get(effect, "") for effect in diagnosis.linear.model.effects)
            remedy = "; ".join(filter(None, added))
            if not remedy:
                return "Nothing to do at the machine."
    return f"At the machine{when}: {remedy}." if remedy else ""


def _where_to_look(diagnosis: Diagnosis) -> str:
    """Return what to check where no known effect explains the error, by what it follows; "" where that is unknown."""
    if diagnosis.follows_field:
        return "" if errs_by_view(diagnosis) else "have the scanner calibrated"
    if diagnosis.laws:
        law = law_of(diagnosis.laws[0])
        if law.driver.covariate == f"j{law.place.joint}_deg":
            return f"have joint {law.place.joint} checked: gear, bearing, and what hangs on it"
        return f"look for what changes with {plain_covariate(law.driver.covariate)} at {law.place.name}"
    if diagnosis.curves:
        curve = diagnosis.curves[0]
        base = ", and what the base stands on" if "base" in curve.place else ""
        return f"have joint {curve.joint} checked: gear, bearing, and what hangs on it{base}"
    follows = _clear_covariates(diagnosis)
    return f"look for what changes with {follows[0]}" if follows else ""


def next_step_line(diagnosis: Diagnosis, run: str) -> str:
    """Return the line that says what to do next, and ends in the command to type: "Next…: stitch …".

    Args:
        run: path of the run as it has to be typed in a shell.
    """
    if open_doubts(diagnosis):
        return f"Next: fix the problem above; for details: stitch review {run}"
    if any(proposal.probability is not None for proposal in diagnosis.next):
        return f"Next, for the view that decides best: stitch next {run} -o next.src"
    return next_step_without_a_view(diagnosis, run)


def next_step_without_a_view(diagnosis: Diagnosis, run: str) -> str:
    """Return the same line for a reader who takes no view now; where only views help, the command that plans them.

    Args:
        run: path of the run as it has to be typed in a shell.
    """
    match diagnosis.verdict:
        case "missing_effect" if not diagnosis.likelier_than_not:
            return f"Next, for views that would separate it from chance: stitch next {run}"
        case "missing_effect" if diagnosis.dropped_before is not None:
            return f"Next, to see where the model fails: stitch review {run}"
        case "missing_effect":
            return f"Next: stitch add {run} --suggested"
        case "cannot_tell" if unnamed_in_words(diagnosis) or not _group_helps(diagnosis):
            return f"Next, for views that would separate them: stitch next {run}"
        case "cannot_tell":
            return f"Next, to fit them as one group: stitch add {run} --group"
        case "unknown_effect" if not diagnosis.follows_field and (
            diagnosis.laws or diagnosis.curves or diagnosis.time_curve
        ):
            return f"Next, to look for a formula: stitch explain {run} -o mine.py"
        case "unknown_effect":
            return f"Next, to see where the model fails: stitch review {run}"
    return f"Next: stitch export {run} --to ros"


def _group_helps(diagnosis: Diagnosis) -> bool:
    """Return whether the effects that cannot be told apart predict views left out better when fitted together.

    Where they do not, `stitch add --group` refuses.
    """
    members = [c.ranked.score for c in diagnosis.candidates if c.name in diagnosis.effects]
    return group_helps(*group_share(diagnosis.linear, members))


def largest_error_sources(budget: Sequence[BudgetLine]) -> list[BudgetLine]:
    """Return sources of at least 1 % of the variance, largest first, then all others as one line.

    The shares add up to 1. Empty where the budget is.
    """
    sources = sorted((line for line in budget if line.variance_share > 0), key=lambda line: -line.variance_share)
    large = [line for line in sources if line.variance_share >= _MIN_SHARE]
    small = sources[len(large) :]
    if not small:
        return large
    share = sum(line.variance_share for line in small)
    sigma = math.sqrt(sum(line.sigma**2 for line in small))
    return [*large, BudgetLine(OTHER_SOURCES, share, sigma, small[0].unit)]


def share_text(line: BudgetLine) -> str:
    """Return a share of the variance in per cent."""
    return "< 1 %" if line.variance_share < _MIN_SHARE else f"{line.variance_share:.0%}".replace("%", " %")
