"""What errs by no known law in words: where in the range of a joint, when in the session."""

from collections.abc import Sequence

from stitch.diagnosis.diagnosis import Diagnosis
from stitch.diagnosis.unknown.joint_curves import JointCurve
from stitch.diagnosis.unknown.time_curve import ROTATION_PART, TRANSLATION_PART, TimeCurve
from stitch.units import duration_text, format_amount, rounded

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
        f"{rounded(1e3 * curve.error[i], 1e3 * curve.sigma[i])} ± {1e3 * curve.sigma[i]:.1g} mrad {_place_in_words(curve, i)}"
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
        f"{_time_in_words(curve, then)}. What goes that way in the cell (a temperature, a machine nearby) could name it, as a "
        "column of views.csv."
    )


def _time_in_words(curve: TimeCurve, k: int) -> str:
    steps = curve.steps[k] - curve.steps[0]
    return f"{duration_text(steps * curve.seconds)} into the session" if curve.seconds else f"at view {steps:.0f}"
