"""The diagnosis in one plain sentence with its numbers."""

from collections.abc import Sequence

import numpy as np

from stitch.diagnosis.diagnosis import Diagnosis
from stitch.diagnosis.ranking import Ranked
from stitch.diagnosis.residual_structure import NOT_REPEATING
from stitch.diagnosis.unnamed_joint_laws import JointCurve
from stitch.diagnosis.unnamed_time_laws import ROTATION_PART, TRANSLATION_PART, TimeCurve, reportable
from stitch.observations.surfaces.scanner_errors import FieldError
from stitch.units import angle_text, duration_text, format_amount, length_text, rounded

# What errs by no known law in words: where in the range of a joint, when in the session.

# Curves of joints that are told in words; the page draws one more.
_MAX_CURVES = 2


def curve_sentences(found: Diagnosis, length_unit: str) -> list[str]:
    """A sentence for every course that is clear enough to be said, of joints and in time."""
    shown = found.curves[:_MAX_CURVES]
    told = [*map(joint_curve_sentence, shown), *_ambiguous_covariates(shown)]
    in_time = found.time_curve
    return told if in_time is None else [*told, time_curve_sentence(in_time, length_unit)]


def joint_curve_sentence(curve: JointCurve) -> str:
    """Where in the range a joint errs: Joint 3 is off by -0.25 ± 0.03 mrad at j4 = -48°, and by …"""
    low, high = (
        f"{rounded(1e3 * curve.error[i], 1e3 * curve.sigma[i])} ± {1e3 * curve.sigma[i]:.1g} mrad "
        f"{_place_in_words(curve, i)}"
        for i in curve.extremes
    )
    of_it = f"{curve.share:.0%} of what it does without a name"
    return f"Joint {curve.joint} is off by {low}, and by {high}, beside its mean: {of_it}."


def _ambiguous_covariates(curves: Sequence[JointCurve]) -> list[str]:
    """What each joint may follow as well as what its course is drawn along."""
    open_ones = {c.joint: c.may_follow for c in curves if len(c.may_follow) > 1}
    return [
        f"These views do not tell whether joint {joint} follows {', '.join(others[:-1])} or {others[-1]}."
        for joint, others in open_ones.items()
    ]


def _place_in_words(curve: JointCurve, k: int) -> str:
    """At j4 = -48°, after a move of 12°, 12 min into the session, at view 7, under 31 N m, under 0.3 N m of each kg."""
    there, name = curve.at[k], curve.covariate
    match name.split("_", 1)[-1]:
        case "move_deg":
            return f"after a move of {there:.0f}°"
        case "deg":
            return f"at {name.removesuffix('_deg')} = {there:.0f}°"
        case "s":
            return f"{duration_text(there - curve.view_values.min())} into the session"
        case "view":
            return f"at view {there:.0f}"
    load = rounded(there, 0.1 * (curve.at[-1] - curve.at[0]))
    return f"under {load} N m" + (" of each kg" if name.endswith("_per_kg") else "")


def time_curve_sentence(curve: TimeCurve, length_unit: str) -> str:
    """How far a flange seems to be off in time: It is as if the flange were off by as much as 0.12 ± 0.01 mm …"""
    there, moved, its_sigma = curve.largest(TRANSLATION_PART)
    then, turned, sigma = curve.largest(ROTATION_PART)
    far, turn = format_amount(moved, its_sigma, length_unit), format_amount(turned, sigma, "rad")
    return (
        f"It is as if the flange were off by as much as {far} {_time_in_words(curve, there)} and turned by {turn} "
        f"{_time_in_words(curve, then)}. What goes that way in the cell (a temperature, a machine nearby) could "
        "name it, as a "
        "column of views.csv."
    )


def _time_in_words(curve: TimeCurve, k: int) -> str:
    steps = curve.steps[k] - curve.steps[0]
    return f"{duration_text(steps * curve.seconds)} into the session" if curve.seconds else f"at view {steps:.0f}"


# Smooth errors of the scans themselves in words: the same in every view, or every view's own.


def scanner_clause_if_adequate(found: FieldError | None, length_unit: str) -> str:
    """What stands beside a model to which nothing is missing; empty where nothing is unusual."""
    if found is None:
        return ""
    calibration = "" if found.by_view else ", but a calibration may"
    return f"; {_scanner_error_clause(found, length_unit)}, which no pose corrects{calibration}"


def scanner_clause_before_poses(found: FieldError | None, length_unit: str) -> str:
    """What is said of the scans before what poses do that has no name; empty where nothing is unusual."""
    if found is None:
        return ""
    follows = f" ({_CAUSES}), so that poses found from them scatter too" if found.by_view else ""
    return f"{_scanner_error_clause(found, length_unit)}{follows}; "


def scanner_error_sentence(found: FieldError | None, length_unit: str) -> str:
    """Where nothing is named, what the scans err by, and what to do; None: as the views' poses show it."""
    if found is not None and found.by_view:
        size = length_text(found.rms_by_view, length_unit, 2)
        return (
            f"the scans err smoothly, every view by itself ({size} rms{_drift_clause(found)}): {_CAUSES}; scan "
            "the first "
            "pose again at the end: what differs then is of the part or of the time"
        )
    size = f" ({length_text(found.rms, length_unit, 2)} rms)" if found is not None else ""
    more = "" if found is None else _per_view_clause(found)
    return (
        f"the scanner errs by where in its field a point is seen, the same in every view{size}{more}; have it "
        "calibrated, or describe how it errs by an effect of your own"
    )


_CAUSES = (
    "a part that bends or moves, an arm that still settles while a scan is read, a scanner that warms up or errs by "
    "range, brightness or a finer law"
)


def _scanner_error_clause(found: FieldError, length_unit: str) -> str:
    """The clearer of the two kinds, with its size."""
    if found.by_view:
        size = length_text(found.rms_by_view, length_unit, 2)
        return f"the scans err by {size} rms, smoothly and every view by itself{_drift_clause(found)}"
    size = length_text(found.rms, length_unit, 2)
    return f"the scanner errs by {size} rms over its field, the same in every view{_per_view_clause(found)}"


def _per_view_clause(found: FieldError) -> str:
    """What views have for themselves besides; how much is uncertain beside what they have in common."""
    return f", and in part every view by itself{_drift_clause(found)}" if found.rms_by_view else ""


def _drift_clause(found: FieldError) -> str:
    return ", as the session goes on" if found.with_time else ""


def diagnosis_sentence(d: Diagnosis, length_unit: str, pair: tuple[Ranked, Ranked] | None) -> str:
    """One sentence for each verdict.

    Args:
        pair: two effects that are missing, each beside the other; the first is the one that is named.
    """
    now, floor = (length_text(x, length_unit) for x in (d.residual_rms, d.noise_floor))
    scatter = f"{length_text(d.translation, length_unit)} and {angle_text(d.rotation)}"
    if d.verdict == "adequate":
        by = _scatter_limit_clause(d, length_unit)
        rest = f", and a pose repeatability of {scatter} (standard deviations) explains the rest, {by}"
        return (
            f"The model is adequate: {now} remain where the sensor's noise alone would leave {floor}"
            f"{rest if _poses_scatter(d) else ''}{scanner_clause_if_adequate(d.scanner_error, length_unit)}"
            f"{_rejected_effects(d)}."
        )
    if d.verdict == "missing_effect":
        return _missing_effect_sentence(d, length_unit, now, floor, pair)
    if d.verdict == "cannot_tell":
        return _ambiguous_group_sentence(d, now, floor)
    return _unknown_effect_sentence(d, length_unit, now, floor, scatter)


def _ambiguous_group_sentence(d: Diagnosis, now: str, floor: str) -> str:
    missing = "is missing" if d.certain else "may be missing"
    start = f"Something {missing} ({now} remain, noise {floor}{_odds_over_chance(d)})"
    then = f"; {d.next[0].do}." if d.next else "."
    return f"{start}, but these views cannot tell {' or '.join(d.effects)} apart{then}"


def _missing_effect_sentence(
    d: Diagnosis, length_unit: str, now: str, floor: str, pair: tuple[Ranked, Ranked] | None
) -> str:
    name = d.effects[0]
    candidate = next(s for s in d.candidates if s.name == name)
    ranked = pair[0] if pair else candidate.ranked
    gain = ""
    if candidate.cross_validation is not None:
        left, out = (length_text(x, length_unit) for x in d.rms_if_added(candidate.cross_validation))
        gain = f"; adding it should leave about {left}, {out} on views left out"
    too = f"{pair[1].name} seems to be there too ({fitted_amounts(pair[1])})" if pair else ""
    more = f" {too}; each is sized beside the other." if pair else ""
    missing = "is missing" if d.certain else "may be missing"
    return (
        f"{name} {missing} ({fitted_amounts(ranked)}; p = {ranked.adjusted:.1g}{_odds_over_chance(d)}): {now} "
        "remain where noise "
        f"would leave {floor}{gain}.{more}{_implausible_sizes(ranked)}"
    )


def _implausible_sizes(ranked: Ranked) -> str:
    """What is larger than anybody would expect."""
    s = ranked.score
    large = [p.name for p, v in zip(s.form.free, s.values, strict=True) if abs(v) > p.limit] if s.fitted else []
    if not large:
        return ""
    are = "is" if len(large) == 1 else "are"
    return f" {' and '.join(large)} {are} beyond what is plausible: is what the session states right?"


def _odds_over_chance(d: Diagnosis) -> str:
    """How much likelier than chance it is, where that is little."""
    return "" if d.certain else f", {odds_text(d.log_odds_over_nothing)} that it is more than chance"


def _unknown_effect_sentence(d: Diagnosis, length_unit: str, now: str, floor: str, scatter: str) -> str:
    start = (
        f"No effect of the library explains what is left ({now}, noise {floor}): "
        f"{_overlap_misfit_clause(d, length_unit)}"
    )
    if d.follows_field:
        return f"{start}{scanner_error_sentence(d.scanner_error, length_unit)}{_rejected_effects(d)}."
    start += scanner_clause_before_poses(d.scanner_error, length_unit)
    clear = [x.covariate for x in d.depends_on if x.p_value < 0.01][:3]
    follows = f"it follows {', '.join(clear)}; " if clear else ""
    if said := reportable(d.repeating_errors, d.implausible):
        again = " and ".join(u.words for u in said)
        return (
            f"{start}{follows}the errors of the poses repeat, they "
            f"{again}{_repeating_error_size(d, length_unit)}, and scatter by "
            f"{scatter} otherwise{_rejected_effects(d)}{_untested_effects(d)}."
        )
    if not d.implausible:
        otherwise = (
            f"the poses scatter by {scatter} otherwise"
            if _poses_scatter(d)
            else "what was seen does not show the poses"
        )
        return f"{start}{follows}{otherwise}{_rejected_effects(d)}{_untested_effects(d)}."
    if d.overlap_misfit:
        poses = f"until that is corrected nothing is known of the poses, which scatter by {scatter}"
        return f"{start}{follows}{poses}{_rejected_effects(d)}{_untested_effects(d)}."
    than = (
        f"more than {_scatter_limits(d, length_unit)} as stated"
        if d.scatter_limit.stated
        else "which no sound arm does"
    )
    return (
        f"{start}{follows}the robot's pose errors dominate, they scatter by {scatter}, {than}; such errors repeat at "
        "the same poses, so that those found on one object correct "
        f"another{_rejected_effects(d)}{_untested_effects(d)}."
    )


def _overlap_misfit_clause(d: Diagnosis, length_unit: str) -> str:
    """What no motion of the views takes away."""
    if not d.overlap_misfit:
        return ""
    return (
        f"{length_text(d.overlap_misfit, length_unit, 2)} remain however each view is moved, so that the scanner "
        "or the part's "
        "shape is off and not the poses alone; "
    )


def _repeating_error_size(d: Diagnosis, length_unit: str) -> str:
    """How large the errors are that repeat without a name."""
    size = np.sqrt(sum(line.sigma**2 for line in d.budget if line.source not in NOT_REPEATING))
    return f" ({length_text(float(size), length_unit, 2)})" if size > 0 else ""


def _poses_scatter(d: Diagnosis) -> bool:
    """True unless what was seen is the same wherever the poses are."""
    return d.rotation > 0 or d.translation > 0


def _scatter_limit_clause(d: Diagnosis, length_unit: str) -> str:
    """What "adequate" is measured against."""
    if d.scatter_limit.stated:
        return f"within {_scatter_limits(d, length_unit)} as stated"
    usual = _scatter_limits(d, length_unit)
    return f"judged by what is usual for an arm (up to {usual}): no repeatability is stated under [robot]"


def _scatter_limits(d: Diagnosis, length_unit: str) -> str:
    return f"{length_text(d.scatter_limit.translation, length_unit)} and {angle_text(d.scatter_limit.rotation)}"


def _rejected_effects(d: Diagnosis) -> str:
    """Effects that explain much and are not named, and why: an alarm that did not stand is no silence."""
    return "".join(f"; {note}" for note in d.notes)


def _untested_effects(d: Diagnosis) -> str:
    untested = [name for name, needs in d.missing.items() if "joints" in needs or "torque" in needs]
    if not untested:
        return ""
    return f"; without joint angles and the robot's geometry joint effects ({', '.join(untested)}) cannot be tested"


def odds_text(log_odds: float) -> str:
    """3 to 1, or 1 to 3; nobody can vouch for more than a hundred."""
    likelier = f"{np.exp(abs(log_odds)):.2g}" if abs(log_odds) < np.log(99.5) else "more than 100"
    return f"{likelier} to 1" if log_odds >= 0 else f"1 to {likelier}"


def fitted_amounts(ranked: Ranked, at_most: int = 3) -> str:
    """The clearest parameters: c2 = 0.44 ± 0.04 µrad/(N m)."""
    s = ranked.score
    if not s.fitted:
        return "too small to be worth a fit"
    order = np.argsort(-np.abs(s.values) / np.maximum(s.sigmas, 1e-300))[:at_most]
    clearest = [(s.form.free[i], s.values[i], s.sigmas[i]) for i in sorted(order)]
    fitted = [f"{p.name} = {format_amount(v, sigma, p.unit)}" for p, v, sigma in clearest]
    tried = [f"{p.name} = {p.formatted}" for p in s.form.term.parameters if p.grid]
    return ", ".join(tried + fitted)
