"""diagnosis.json from a diagnosis."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from stitch.diagnosis.diagnosis import CandidateEffect, Diagnosis
from stitch.diagnosis.residual_structure import BudgetLine
from stitch.diagnosis.sentences import odds_text
from stitch.diagnosis.thresholds import CLEAR_DEPENDENCE, HELDOUT_FALL, MAX_REMAINING_SHARE
from stitch.diagnosis.unnamed_joint_laws import JointCurve
from stitch.diagnosis.unnamed_time_laws import TimeCurve
from stitch.diagnosis.validation import CrossValidation, group_helps, group_share
from stitch.numerics.units import length_text
from stitch.observations.surfaces.scanner_errors import FieldError
from stitch.output.finding_screen import finding_screen, plain_covariate
from stitch.output.json_file import rows_of_fields
from stitch.run_data import doubt_headline, effect_cure

# The variance budget for people: the largest sources by name, those below this share as one line.
_MIN_SHARE = 0.01
OTHER_SOURCES = "others"


def largest_error_sources(budget: Sequence[BudgetLine]) -> list[BudgetLine]:
    """Return sources of at least 1 % of the variance, largest first, then all others as one line; shares add up to 1.

    Empty where there is no budget, or nothing in it.
    """
    there = sorted((line for line in budget if line.variance_share > 0), key=lambda line: -line.variance_share)
    small = [line for line in there if line.variance_share < _MIN_SHARE]
    lines = there[: len(there) - len(small)]
    if small:
        share = sum(line.variance_share for line in small)
        sigma = float(np.sqrt(sum(line.sigma**2 for line in small)))
        lines.append(BudgetLine(OTHER_SOURCES, share, sigma, small[0].unit))
    return lines


def share_text(line: BudgetLine) -> str:
    """Return a share of the variance in per cent."""
    return "< 1 %" if line.variance_share < _MIN_SHARE else f"{line.variance_share:.0%}".replace("%", " %")


# What every effect of the library is on the shop floor, in a few words; the formula stands in its docstring.

_WORDS = {
    "latency": "scan and pose are not taken at the same time",
    "joint_offset": "a joint counts its angle from a wrong zero",
    "link_geometry": "the arm's links are not as long or as square as stated",
    "joint_compliance": "joints give way under load",
    "gear_eccentricity": "a gear runs out of true, once a turn",
    "gear_harmonic": "a gear runs out of true, twice a turn",
    "backlash": "a joint has play",
    "settling": "the arm is measured before it has come to rest",
    "robot_thermal_growth": "the arm grows with its warmth",
    "mount_drift": "the scanner's mount creeps",
    "mount_warmup": "the scanner's mount moves while it warms up",
    "mount_droop": "the scanner's mount gives way under its weight",
    "fixture_drift": "the part's fixture creeps",
    "fixture_droop": "the part's fixture gives way under its weight",
    "part_slip": "the part slipped between two views",
    "part_growth": "the part grows with its warmth",
    "part_sag": "the part bends under its own weight",
    "range_scale": "the scanner measures all distances too long or too short by one factor",
    "range_nonlinearity": "the scanner errs nearer or farther than its working distance",
    "incidence_bias": "the scanner is off where it looks along the surface",
    "intensity_bias": "the scanner is off on dark or shiny places",
    "field_curvature": "the scanner sees a flat surface bent",
    "lens_distortion": "the scanner's lens distorts",
    "scanner_thermal_scale": "the scanner's scale changes with its warmth",
}


# What ends an effect at the machine; these scans are saved by adding it to the model.
_AT_THE_MACHINE = {
    "latency": "stop the arm for every scan, or trigger both together",
    "joint_offset": "set the zero of the joint anew, or write the corrected arm back into the controller",
    "link_geometry": "write the corrected arm back into the controller",
    "joint_compliance": "state the payload in the controller, or keep the effect in the model",
    "gear_eccentricity": "have the joint's gear checked at the next service; until then keep the effect in the model",
    "gear_harmonic": "have the joint's gear checked at the next service; until then keep the effect in the model",
    "backlash": "approach every pose from the same side, or have the joint's gear adjusted",
    "settling": "wait longer at each pose before the scan",
    "robot_thermal_growth": "warm the arm up before scanning",
    "mount_drift": "fasten the scanner's mount",
    "mount_warmup": "let the scanner warm up before scanning",
    "mount_droop": "stiffen the scanner's mount",
    "fixture_drift": "fasten the part's fixture",
    "fixture_droop": "stiffen the part's fixture",
    "part_slip": "clamp the part firmly",
    "part_growth": "let the part reach the temperature of the room",
    "part_sag": "support the part where it bends",
    "range_scale": "have the scanner calibrated",
    "range_nonlinearity": "scan at the working distance, or have the scanner calibrated",
    "incidence_bias": "look at every surface more squarely",
    "intensity_bias": "coat dark and shiny places",
    "field_curvature": "have the scanner calibrated, or use the middle of its field",
    "lens_distortion": "have the scanner calibrated, or use the middle of its field",
    "scanner_thermal_scale": "let the scanner warm up before scanning",
}


def remedy_at_machine(found: Diagnosis) -> str:
    """Return what would end the effect that is named, or where to look for one without a name, as a sentence; empty
    where nothing is named, or only perhaps."""
    if found.verdict == "unknown_effect" and found.follows_field:
        by_view = found.scanner_error is not None and found.scanner_error.by_view
        return "" if by_view else "At the machine: have the scanner calibrated."
    if found.verdict == "unknown_effect":
        follows = [plain_covariate(x.covariate) for x in found.depends_on if x.p_value < CLEAR_DEPENDENCE]
        if found.curves:
            return f"At the machine: have joint {found.curves[0].joint} checked: gear, bearing, and what hangs on it."
        return f"At the machine: look for what changes with {follows[0]}." if follows else ""
    named = found.effects[0] if found.verdict == "missing_effect" and found.certain else ""
    return f"At the machine: {_AT_THE_MACHINE[named]}." if named in _AT_THE_MACHINE else ""


def effect_description(name: str) -> str:
    """Return an effect in a few words; empty for a user's own."""
    return _WORDS.get(name, "")


def effect_in_words(name: str) -> str:
    """Return an effect's name with a description; the name alone for a user's own."""
    return f"{name} ({effect_description(name)})" if effect_description(name) else name


# What a diagnosis found in one sentence that everybody on the shop floor understands.
#
# Terminal, page, recording and review all say it so; the diagnosis' own sentence stands below as evidence.


def plain_finding(found: Diagnosis, length_unit: str) -> str:
    """Return the doubts about the session, what is missing, and how far the error should fall with it."""
    finding = _finding(found, length_unit)
    left = open_doubts(found)
    if not left:
        return finding
    doubted = " ".join(doubt_headline(doubt) for doubt in left)
    return f"{doubted} The findings below may only be consequences of this problem. {finding}"


def open_doubts(found: Diagnosis) -> tuple[str, ...]:
    """Return the doubts about the session that are something else than the effect which is missing."""
    return tuple(doubt for doubt in found.doubts if doubt != _same_as_finding(found))


def _same_as_finding(found: Diagnosis) -> str | None:
    """Return the doubt that the effect which is missing would hold; None where there is none, or several."""
    if not found.doubts or found.verdict != "missing_effect" or not found.likelier_than_not:
        return None
    same = [doubt for doubt in found.doubts if effect_cure(found.effects[0]) in doubt]
    return same[0] if len(same) == 1 else None


def _finding(found: Diagnosis, length_unit: str) -> str:
    """Return what is missing, and how far the error should fall with it."""
    named = " or ".join(effect_in_words(name) for name in found.effects)
    doubt = "" if found.certain else f" The odds against chance are {odds_text(found.log_odds_over_nothing)}."
    match found.verdict:
        case "adequate":
            return (
                f"No missing effect was found: {_remaining_error(found.scanner_error, length_unit)} explain the "
                "remaining error."
            )
        case "cannot_tell":
            something = "Something is" if found.certain else "Something may be"
            return f"{something} missing in the model: {named}. These views cannot tell which.{doubt}"
        case "unknown_effect":
            return f"Something is missing in the model, and no known effect explains it{_error_location(found)}."
    validation = next(c for c in found.candidates if c.name == found.effects[0]).cross_validation
    though = "" if found.likelier_than_not else ", though chance is more likely"
    missing = "Missing in the model" if found.certain else f"Perhaps missing in the model{though}"
    if (same := _same_as_finding(found)) is not None:
        seen = doubt_headline(same).removesuffix(".")
        named = f"{found.effects[0]} ({seen[0].lower()}{seen[1:]})"
    if found.dropped_before is not None:
        return f"{missing}: {named}.{doubt} It was tried in this run and dropped: {found.dropped_before}."
    if validation is None:
        return f"{missing}: {named}.{doubt}"
    return f"{missing}: {named}.{doubt} {_expected_gain(found.residual_rms, validation, length_unit)}"


def _expected_gain(residual_rms: float, validation: CrossValidation, length_unit: str) -> str:
    """How far the error should fall, or where else the effect shows: a small one moves poses by less than chance
    moves a residual."""
    share = validation.inside**0.5
    before, after = (length_text(rms, length_unit) for rms in (residual_rms, share * residual_rms))
    if share < HELDOUT_FALL:
        return f"Adding it should reduce the error from {before} to {after} (rms)."
    small = f"The effect is too small to change the error visibly ({before} now, {after} with it, rms)"
    if validation.poses > MAX_REMAINING_SHARE:
        return f"{small}."
    return (
        f"{small}. Views left out should be predicted about {1 - validation.poses**0.5:.0%} better, in units of "
        "their scatter."
    )


def _remaining_error(smooth: FieldError | None, length_unit: str) -> str:
    """Return what explains the remaining error where no effect is missing."""
    if smooth is None:
        return "noise and the arm's scatter"
    size = length_text(smooth.rms_by_view if smooth.by_view else smooth.rms, length_unit, 2)
    own = f"each scan's own error ({size}" if smooth.by_view else f"the scanner's own error ({size} over its field"
    return f"noise, the arm's scatter and {own}, which no pose corrects)"


def _error_location(found: Diagnosis) -> str:
    """The scanner or the joint that errs, or what the rest follows as clearly as in the diagnosis' own sentence."""
    if found.follows_field and found.scanner_error is not None and found.scanner_error.by_view:
        return ": each scan has its own error, as if the part bent or the scanner changed"
    if found.follows_field:
        return ": the scanner's error depends on the position in its field of view"
    joints = " or ".join(f"joint {k}" for k in sorted({curve.joint for curve in found.curves}))
    if joints:
        return f": the error follows {joints}, but no known formula"
    if found.time_curve is not None:
        return ": the pose errors change over time, but follow no known formula"
    if found.overlap_misfit:
        return ": the scanner or the part's shape is wrong, not only the poses"
    follows = [x.covariate for x in found.depends_on if x.p_value < CLEAR_DEPENDENCE]
    if follows:
        return f": the remaining error follows {' and '.join(follows[:2])}"
    # The likeliest name, and why it does not hold.
    return f": {found.notes[0]}" if found.notes else ""


def suggested_command(found: Diagnosis, run: str) -> str:
    """The command that most would type now, with what it is for; `run` as it has to be typed."""
    if open_doubts(found):
        return f"Next: fix the problem above; for details: stitch review {run}"
    match found.verdict:
        case "missing_effect" if not found.likelier_than_not:
            return f"Next, for views that would separate it from chance: stitch next {run}"
        case "missing_effect" if found.dropped_before is not None:
            return f"Next, to see where the model fails: stitch review {run}"
        case "missing_effect":
            return f"Next: stitch add {run} --suggested"
        case "cannot_tell" if not _group_helps(found):
            return f"Next, for views that would separate them: stitch next {run}"
        case "cannot_tell":
            return f"Next, to fit them as one group: stitch add {run} --group"
        case "unknown_effect" if (found.curves or found.time_curve is not None) and not found.follows_field:
            return f"Next, to look for a formula: stitch explain {run} -o mine.py"
        case "unknown_effect":
            return f"Next, to see where the model fails: stitch review {run}"
    return f"Next: stitch export {run} --to ros"


def _group_helps(found: Diagnosis) -> bool:
    """False where `stitch add --group` would refuse, or has just refused: together they predict no view left out."""
    share, sigma = group_share(found.linear, [c.ranked.score for c in found.candidates if c.name in found.effects])
    return group_helps(share, sigma)


FORMAT = "stitch-diagnosis/1"


def diagnosis_document(d: Diagnosis) -> dict[str, Any]:
    """diagnosis.json as a dictionary; candidates best first, those that the data cannot see last."""
    return {
        "format": FORMAT,
        "verdict": d.verdict,
        "effects": list(d.effects),
        "plain": plain_finding(d, d.linear.measurement.length_unit),
        "sentence": d.sentence,
        "residual_rms": d.residual_rms,
        "noise_floor": d.noise_floor,
        "repeatability": {"rotation": d.rotation, "translation": d.translation},
        "candidates": [
            *(_candidate(d, c) for c in d.candidates),
            *(_untested(name, needs) for name, needs in d.missing.items()),
        ],
        "depends_on": rows_of_fields(d.depends_on, "covariate score p_value bins mean sigma shape"),
        "joint_laws": [_curve(curve) for curve in d.curves],
        "time_law": None if d.time_curve is None else _time_curve(d.time_curve),
        "next": rows_of_fields(d.next, "do separates joints_deg views"),
        "next_command": suggested_command(d, "RUN"),
        "alias_matrix": {"effects": [c.name for c in d.candidates], "correlation": np.round(d.matrix, 4).tolist()},
        "log_odds_over_nothing": d.log_odds_over_nothing if np.isfinite(d.log_odds_over_nothing) else None,
        "notes": list(d.notes),
        "doubts": list(d.doubts),
        "together": list(d.together),
        "tried": [{"effect": name, "dropped": why} for name, why in d.tried.items()],
        "budget": rows_of_fields(d.budget, "source variance_share sigma unit"),
        "field_map": _field_map(d.scanner_error),
        "views": d.linear.measurement.views.count,
        "evidence": d.linear.mixed.size,
        "screen": diagnosis_screen(d),
    }


def diagnosis_screen(found: Diagnosis) -> dict[str, Any]:
    """Return what one screen shows of a diagnosis."""
    return finding_screen(found, _WORDS, open_doubts(found))


def _curve(curve: JointCurve) -> dict[str, Any]:
    """Along what a joint errs by no known law, in the unit of its covariate; errors in rad."""
    return {
        "joint": curve.joint,
        "covariate": curve.covariate,
        "share": curve.share,
        "at": curve.at.tolist(),
        "error": curve.error.tolist(),
        "sigma": curve.sigma.tolist(),
        "may_follow": list(curve.may_follow),
    }


def _time_curve(curve: TimeCurve) -> dict[str, Any]:
    """When in the session a flange errs by no known law, in its own frame; rotation in rad, then translation."""
    return {
        "steps": curve.steps.tolist(),
        "seconds_a_step": curve.seconds or None,
        "error": curve.error.tolist(),
        "sigma": curve.sigma.tolist(),
    }


def _field_map(smooth: FieldError | None) -> dict[str, Any] | None:
    """Where in its field the scanner errs along the ray, in length_unit; null where too few points were seen."""
    if smooth is None or smooth.map is None:
        return None
    drawn = {"error": smooth.map.error, "sigma": smooth.map.sigma}
    rows = {name: [[x if np.isfinite(x) else None for x in row] for row in at.tolist()] for name, at in drawn.items()}
    return {"x_over_z": smooth.map.x.tolist(), "y_over_z": smooth.map.y.tolist()} | rows


def _untested(name: str, needs: tuple[str, ...]) -> dict[str, Any]:
    """An effect that lacks what it needs."""
    unknown = ("p_value", "rms_if_added", "heldout_rms_if_added", "left_out", "minimum_detectable")
    return {
        "effect": name,
        "posterior": 0.0,
        "observable": False,
        "parameters": {},
        "aliases": [],
        "needs": list(needs),
        **dict.fromkeys(unknown),
    }


# Of a cross-validation, what its verdict on a fitted effect needs.
_LEFT_OUT = ("inside", "heldout", "heldout_sigma", "poses", "poses_sigma", "steadiness")


def _candidate(d: Diagnosis, candidate: CandidateEffect) -> dict[str, Any]:
    r, s, left_out = candidate.ranked, candidate.ranked.score, candidate.cross_validation
    parameters: dict[str, Any] = {
        p.name: {"value": p.value, "sigma": None, "unit": p.unit} | ({"view": p.view} if p.view else {})
        for p in s.form.term.parameters
        if p.grid
    }
    if s.observable and s.fitted:
        parameters |= {
            p.name: {"value": float(v), "sigma": float(x), "unit": p.unit}
            for p, v, x in zip(s.form.free, s.values, s.sigmas, strict=True)
        }
    inside, heldout = (None, None) if left_out is None else d.rms_if_added(left_out)
    detectable = {name: x for name, x in candidate.detectable.items() if np.isfinite(x)}
    return {
        "effect": s.name,
        "p_value": r.adjusted if s.observable else None,
        "posterior": r.posterior if s.observable else 0.0,
        "observable": s.observable,
        "parameters": parameters,
        "rms_if_added": inside,
        "heldout_rms_if_added": heldout,
        "left_out": None if left_out is None else {name: getattr(left_out, name) for name in _LEFT_OUT},
        # Of the parameter that these views know best against its plausible size; all below.
        "minimum_detectable": detectable.get(_clearest_parameters(candidate) or ""),
        "minimum_detectable_of": _clearest_parameters(candidate),
        "minimum_detectable_each": detectable,
        "hand_eye_if_missed": candidate.hand_eye,
        "aliases": [{"effect": a.name, "correlation": a.correlation} for a in candidate.aliases],
        "tier": s.candidate.effect.tier,
    }


def _clearest_parameters(candidate: CandidateEffect) -> str | None:
    sizes = {p.name: p.typical for p in candidate.ranked.score.candidate.parameters}
    found = candidate.detectable
    return min(found, key=lambda name: found[name] / sizes[name]) if found else None
