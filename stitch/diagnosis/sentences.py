"""The diagnosis in one plain sentence with its numbers."""

import numpy as np

from stitch.diagnosis.diagnosis import Diagnosis
from stitch.diagnosis.selection.ranking import Ranked
from stitch.diagnosis.smooth_sentences import (
    scanner_clause_before_poses,
    scanner_clause_if_adequate,
    scanner_error_sentence,
)
from stitch.diagnosis.unknown.unnamed_errors import reportable
from stitch.diagnosis.variance_budget import NOT_REPEATING
from stitch.units import angle_text, format_amount, length_text


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
            f"{rest if _poses_scatter(d) else ''}{scanner_clause_if_adequate(d.scanner_error, length_unit)}{_rejected_effects(d)}."
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
        f"{name} {missing} ({fitted_amounts(ranked)}; p = {ranked.adjusted:.1g}{_odds_over_chance(d)}): {now} remain where noise "
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
    start = f"No effect of the library explains what is left ({now}, noise {floor}): {_overlap_misfit_clause(d, length_unit)}"
    if d.follows_field:
        return f"{start}{scanner_error_sentence(d.scanner_error, length_unit)}{_rejected_effects(d)}."
    start += scanner_clause_before_poses(d.scanner_error, length_unit)
    clear = [x.covariate for x in d.depends_on if x.p_value < 0.01][:3]
    follows = f"it follows {', '.join(clear)}; " if clear else ""
    if said := reportable(d.repeating_errors, d.implausible):
        again = " and ".join(u.words for u in said)
        return (
            f"{start}{follows}the errors of the poses repeat, they {again}{_repeating_error_size(d, length_unit)}, and scatter by "
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
        f"the same poses, so that those found on one object correct another{_rejected_effects(d)}{_untested_effects(d)}."
    )


def _overlap_misfit_clause(d: Diagnosis, length_unit: str) -> str:
    """What no motion of the views takes away."""
    if not d.overlap_misfit:
        return ""
    return (
        f"{length_text(d.overlap_misfit, length_unit, 2)} remain however each view is moved, so that the scanner or the part's "
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
