"""What one screen shows of a diagnosis: the cause in words, its proof, what each candidate would leave, and why.

The page of a run, its review and the first tab of its recording draw from this part of diagnosis.json alone.
"""

import re
import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stitch.diagnosis.diagnosis import CandidateEffect, Diagnosis
from stitch.diagnosis.effect_course import (
    EffectCourse,
    course_in_model,
    course_of_candidate,
    course_of_curve,
    course_of_dependence,
)
from stitch.diagnosis.residual_structure import predicted_distances
from stitch.diagnosis.sentences import odds_text
from stitch.diagnosis.thresholds import CLEAR_DEPENDENCE
from stitch.diagnosis.unnamed_time_laws import reportable
from stitch.numerics.frames import Array
from stitch.numerics.units import angle_text, covariate_text, length_text
from stitch.observations.surfaces.surface_model import surfaces_of
from stitch.output.comparison.disagreement_field import DisagreementField, Patches, patches_of

# What each of the best candidate effects would leave of the field of disagreement.

# Candidate effects that a screen compares: so many, and those that take 3 % of the rms on views left out (mean square).
_BEST = 3
_HELPS = 0.94
# Digits of a field in length_unit: thousandths of its largest value are finer than any colour.
_FINE = 1e-3


@dataclass(frozen=True)
class CandidateFields:
    """The field as it is, and as it would be with each of the best candidate effects."""

    patches: Patches
    present: DisagreementField
    if_added: dict[str, DisagreementField]


_last_fields: tuple[weakref.ref[Diagnosis], CandidateFields | None] | None = None


def candidate_fields(found: Diagnosis) -> CandidateFields | None:
    """Return the fields of the diagnosis that was asked for last; None without clouds."""
    global _last_fields
    if _last_fields is None or _last_fields[0]() is not found:
        _last_fields = weakref.ref(found), _fields(found)
    return _last_fields[1]


def _fields(found: Diagnosis) -> CandidateFields | None:
    linear = found.linear
    present = predicted_distances(linear)
    surfaces = surfaces_of(linear)
    if present is None or surfaces is None:
        return None
    overlaps = surfaces.unconstrained.overlaps
    patches = patches_of(overlaps.matches, linear.measurement.views.count, overlaps.gram.scale, model_distances=present)
    added = {}
    for candidate in compared(found):
        distances = predicted_distances(linear, candidate.ranked.score)
        assert distances is not None
        added[candidate.name] = patches.field(distances)
    return CandidateFields(patches, patches.field(present), added)


def compared(found: Diagnosis) -> list[CandidateEffect]:
    """Return the candidate effects that a screen compares, those that are named first, then those that help most."""
    worth = [c for c in found.candidates if c.ranked.score.observable and c.ranked.score.fitted]
    named = found.effects
    helping = [c for c in worth if c.name in named or (c.cross_validation and c.cross_validation.heldout < _HELPS)]
    left = {c.name: c.cross_validation.heldout if c.cross_validation else 0.0 for c in helping}
    helping.sort(key=lambda c: (named.index(c.name) if c.name in named else len(named), left[c.name]))
    return helping[:_BEST]


# The screen as a dictionary.


_last_screen: tuple[weakref.ref[Diagnosis], dict[str, Any]] | None = None


def finding_screen(found: Diagnosis, descriptions: dict[str, str], doubts: Sequence[str]) -> dict[str, Any]:
    """Return the screen of the diagnosis that was asked for last; lengths in length_unit, angles in rad.

    Args:
        descriptions: effects in a few words.
        doubts: about the session, beside what was found.
    """
    global _last_screen
    if _last_screen is None or _last_screen[0]() is not found:
        _last_screen = weakref.ref(found), _screen(found, descriptions) | {"doubts": list(doubts)}
    return _last_screen[1]


def _screen(found: Diagnosis, descriptions: dict[str, str]) -> dict[str, Any]:
    fields = candidate_fields(found)
    courses = {c.name: course_of_candidate(found.linear, c.ranked.score) for c in compared(found)}
    why = _why(found, courses)
    return {
        "headline": _headline(found, why, descriptions),
        "proof": _proof(found, why),
        "certainty": certainty(found),
        "now": {"heldout": found.heldout_rms} | _on_part(None if fields is None else fields.present),
        "noise": found.noise_floor,
        "why": None if why is None else _course(why),
        "candidates": [
            _candidate(found, c, None if fields is None else fields.if_added[c.name], courses[c.name], descriptions)
            for c in compared(found)
        ],
        "places": None if fields is None else np.round(fields.patches.points, 2).tolist(),
    }


def _candidate(
    found: Diagnosis,
    candidate: CandidateEffect,
    field: DisagreementField | None,
    course: EffectCourse | None,
    descriptions: dict[str, str],
) -> dict[str, Any]:
    left_out = candidate.cross_validation
    return {
        "effect": candidate.name,
        "words": _cause(candidate, course, descriptions),
        "heldout": None if left_out is None else found.rms_if_added(left_out)[1],
        **_on_part(field),
        "why": None if course is None else _course(course),
    }


def _on_part(field: DisagreementField | None) -> dict[str, Any]:
    """Mean and worst disagreement on the part, and the value of every place; null where nothing compares."""
    if field is None:
        return {"mean": None, "worst": None, "field": None}
    seen = field.overall[np.isfinite(field.overall)]
    digits = max(0, int(np.ceil(-np.log10(_FINE * max(float(seen.max(initial=0.0)), 1e-12)))))
    values = [round(x, digits) if np.isfinite(x) else None for x in field.overall.tolist()]
    return {"mean": field.mean_abs, "worst": float(seen.max(initial=0.0)), "field": values}


def _course(course: EffectCourse) -> dict[str, Any]:
    return {
        "follows": course.follows,
        "unit": course.unit,
        "of": course.of,
        "value_unit": course.value_unit,
        "views": course.views.tolist(),
        "at": _rounded(course.at),
        "measured": _rounded(course.measured),
        "sigma": _rounded(course.sigma),
        "predicted": _rounded(course.predicted),
        "law": [_rounded(row) for row in course.law],
    }


def _rounded(values: Array) -> list[float]:
    return [float(f"{x:.4g}") for x in values]


def _why(found: Diagnosis, courses: dict[str, EffectCourse | None]) -> EffectCourse | None:
    """Return the course of what is named, of the last effect in a model that lacks nothing, or of what has no name."""
    if found.verdict in ("missing_effect", "cannot_tell"):
        return courses.get(found.effects[0])
    terms = found.linear.model.terms
    if found.verdict == "adequate":
        return course_in_model(found.linear, terms[-1]) if terms else None
    if found.curves:
        return course_of_curve(found.linear, found.curves[0])
    return course_of_dependence(found.linear, found.depends_on[0]) if found.depends_on else None


# The cause and its proof in words.

# What an effect changes over the views by less than this share of its size is the same in all.
_FLAT = 0.02

_OF_A_JOINT = {
    "joint_offset": "counts its angle from a wrong zero",
    "joint_compliance": "gives way under load",
    "gear_eccentricity": "has a gear that runs out of true once a turn",
    "gear_harmonic": "has a gear that runs out of true twice a turn",
    "backlash": "has play",
    "settling": "is measured before it has come to rest",
}


def _cause(candidate: CandidateEffect, course: EffectCourse | None, descriptions: dict[str, str]) -> str:
    """Return the cause as a sentence without its full stop."""
    term = candidate.ranked.score.form.at(candidate.ranked.score.values)
    view = next((p.view for p in term.parameters if p.discrete), "")
    if view:
        return (
            f"The part slipped before view {view}" if candidate.name == "part_slip" else f"{candidate.name} at {view}"
        )
    if course is not None and candidate.name in _OF_A_JOINT and course.of.startswith("joint"):
        return f"{course.of.capitalize()} {_OF_A_JOINT[candidate.name]}"
    words = descriptions.get(candidate.name, candidate.name)
    return words[:1].upper() + words[1:]


def _headline(found: Diagnosis, why: EffectCourse | None, descriptions: dict[str, str]) -> str:
    """Return what is missing, in one sentence."""
    match found.verdict:
        case "adequate":
            named = " and ".join(found.linear.model.effects)
            return f"With {named} in the model, nothing more is missing." if named else "Nothing is missing."
        case "unknown_effect":
            follows = ""
            if found.follows_field:
                by_view = found.scanner_error is not None and found.scanner_error.by_view
                follows = ": each scan errs by itself" if by_view else ": the scanner errs over its field of view"
            elif found.curves:
                follows = f": the error follows joint {found.curves[0].joint}"
            elif found.depends_on and found.depends_on[0].p_value < CLEAR_DEPENDENCE:
                follows = f": the error follows {plain_covariate(found.depends_on[0].covariate)}"
            return f"Something is missing that no known effect explains{follows}."
    causes = [_cause(c, why, descriptions) for c in compared(found) if c.name in found.effects]
    if len(causes) > 1:
        told = " or ".join([causes[0], *(cause[:1].lower() + cause[1:] for cause in causes[1:])])
        return f"{told}: these views cannot tell which."
    return f"{'' if found.certain else 'Perhaps: '}{causes[0]}."


def plain_covariate(name: str) -> str:
    """Return a covariate as people call it: j2_deg is the angle of joint 2."""
    joint = re.fullmatch(r"j(\d+)_deg", name)
    return f"the angle of joint {joint[1]}" if joint else covariate_text(name).partition(" (")[0]


def _proof(found: Diagnosis, why: EffectCourse | None) -> str:
    """Return how large it is, and what it does to the error on views left out."""
    unit = found.linear.measurement.length_unit
    now, noise = length_text(found.heldout_rms, unit, 2), length_text(found.noise_floor, unit, 2)
    error = f"The error on held-out views is {now}; the scanner's noise alone would leave {noise}."
    if found.verdict not in ("missing_effect", "cannot_tell"):
        return error
    named = next(c for c in found.candidates if c.name == found.effects[0])
    size = "" if why is None else f"{_size(why, unit)} "
    if named.cross_validation is None:
        return f"{size}{error}"
    then = length_text(found.rms_if_added(named.cross_validation)[1], unit, 2)
    return (
        f"{size}Adding this effect to the model should take the error on held-out views from {now} to {then}. "
        f"The scanner's noise alone would leave {noise}."
    )


def certainty(found: Diagnosis) -> str:
    """Return how sure the finding is: what chance alone would do, and what the other effects would explain."""
    odds = f"the odds that it is more than chance are {odds_text(found.log_odds_over_nothing)}"
    match found.verdict:
        case "missing_effect" | "cannot_tell" if not found.certain:
            return f"Not very sure: {odds}."
        case "missing_effect":
            named = next(c.ranked for c in found.candidates if c.name == found.effects[0])
            among = named.posterior / sum(c.ranked.posterior for c in found.candidates)
            share = "more than 99%" if among > 0.99 else f"{among:.0%}"
            held = f"Of {named.tests} known effects tried, it holds {share} of the evidence."
            nameless = " Its cause is less sure: a curve without a name would explain as much."
            return f"{chance_text(named.adjusted)} {held}{nameless if named.posterior <= 0.5 else ''}"
        case "cannot_tell":
            return chance_text(min(c.ranked.adjusted for c in found.candidates if c.name in found.effects))
        case "unknown_effect":
            clear = [x.p_value for x in found.depends_on if x.p_value < CLEAR_DEPENDENCE]
            said = reportable(found.repeating_errors, found.implausible)
            if clear:
                return chance_text(min(clear))
            if said:
                factor = max(error.log_bayes_factor for error in said)
                return f"The odds that these errors repeat, and are no scatter, are {odds_text(factor)}."
            return "Neither chance nor a known effect explains it; the cause has no name."
    likeliest = next((c.ranked for c in found.candidates if c.ranked.score.observable), None)
    if likeliest is None:
        return "No known effect can be tested with these views."
    nearest = f"Of {likeliest.tests} known effects tried, {likeliest.name} comes nearest."
    return f"{nearest} {chance_text(likeliest.adjusted)}"


def chance_text(p: float) -> str:
    """Return how often chance alone would show as much, as a sentence."""
    if p < 1e-6:
        often = "less than one of a million sessions"
    else:
        often = f"one of {float(f'{1 / p:.2g}'):,.0f} sessions" if p < 0.01 else f"{p:.0%} of such sessions"
    return f"Chance alone would show as much in {often} (p = {p:.1g})."


def _size(why: EffectCourse, unit: str) -> str:
    """Return how far off an effect puts things, as a sentence."""
    largest = float(np.abs(why.predicted).max())
    size = angle_text(largest, 2) if why.value_unit == "rad" else length_text(largest, unit, 2)
    if why.follows == "view order" and len(why.views):
        away = int(np.sum(np.abs(why.predicted) > largest / 2))
        return f"{away} of {len(why.views)} views sit {size} away from the others."
    follows = plain_covariate(why.follows).partition(":")[0]
    article = "" if follows == "time" or follows.startswith("the ") else "the "
    if np.ptp(why.predicted) < _FLAT * largest:
        return f"{why.of.capitalize()} is off by {size}, whatever {article}{follows} is."
    goes_with = "" if follows == "view order" else f"; it goes with {article}{follows}"
    return f"{why.of.capitalize()} is off by up to {size}{goes_with}."
