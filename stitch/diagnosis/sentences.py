"""The diagnosis in one plain sentence with its numbers."""

import numpy as np

from stitch.diagnosis.diagnosis import Diagnosis
from stitch.diagnosis.selection.ranking import Ranked
from stitch.diagnosis.smooth_sentences import beside_adequate, beside_poses, smooth_errors
from stitch.diagnosis.unknown.unnamed_errors import to_be_said
from stitch.diagnosis.variance_budget import NOT_REPEATING
from stitch.units import amount, angle_text, length_text


def sentence_of(d: Diagnosis, length_unit: str, pair: tuple[Ranked, Ranked] | None) -> str:
    """One sentence for each verdict.

    Args:
        pair: two effects that are missing, each beside the other; the first is the one that is named.
    """
    now, floor = (length_text(x, length_unit) for x in (d.residual_rms, d.noise_floor))
    scatter = f"{length_text(d.translation, length_unit)} and {angle_text(d.rotation)}"
    if d.verdict == "adequate":
        by = _judged_by(d, length_unit)
        rest = f", and a pose repeatability of {scatter} (standard deviations) explains the rest, {by}"
        return (
            f"The model is adequate: {now} remain where the sensor's noise alone would leave {floor}"
            f"{rest if _scatters(d) else ''}{beside_adequate(d.smooth, length_unit)}{_notes(d)}."
        )
    if d.verdict == "missing_effect":
        return _missing(d, length_unit, now, floor, pair)
    if d.verdict == "cannot_tell":
        return _not_told_apart(d, now, floor)
    return _unknown(d, length_unit, now, floor, scatter)


def _not_told_apart(d: Diagnosis, now: str, floor: str) -> str:
    missing = "is missing" if d.certain else "may be missing"
    start = f"Something {missing} ({now} remain, noise {floor}{_chance(d)})"
    then = f"; {d.next[0].do}." if d.next else "."
    return f"{start}, but these views cannot tell {' or '.join(d.effects)} apart{then}"


def _missing(d: Diagnosis, length_unit: str, now: str, floor: str, pair: tuple[Ranked, Ranked] | None) -> str:
    name = d.effects[0]
    candidate = next(s for s in d.candidates if s.name == name)
    ranked = pair[0] if pair else candidate.ranked
    gain = ""
    if candidate.cross_validation is not None:
        left, out = (length_text(x, length_unit) for x in d.rms_if_added(candidate.cross_validation))
        gain = f"; adding it should leave about {left}, {out} on views left out"
    too = f"{pair[1].name} seems to be there too ({amounts_of(pair[1])})" if pair else ""
    more = f" {too}; each is sized beside the other." if pair else ""
    missing = "is missing" if d.certain else "may be missing"
    return (
        f"{name} {missing} ({amounts_of(ranked)}; p = {ranked.adjusted:.1g}{_chance(d)}): {now} remain where noise "
        f"would leave {floor}{gain}.{more}{_beyond(ranked)}"
    )


def _beyond(ranked: Ranked) -> str:
    """What is larger than anybody would expect."""
    s = ranked.score
    large = [p.name for p, v in zip(s.form.free, s.values, strict=True) if abs(v) > p.limit] if s.fitted else []
    if not large:
        return ""
    are = "is" if len(large) == 1 else "are"
    return f" {' and '.join(large)} {are} beyond what is plausible: is what the session states right?"


def _chance(d: Diagnosis) -> str:
    """How much likelier than chance it is, where that is little."""
    return "" if d.certain else f", {odds_text(d.over_nothing)} that it is more than chance"


def _unknown(d: Diagnosis, length_unit: str, now: str, floor: str, scatter: str) -> str:
    start = f"No effect of the library explains what is left ({now}, noise {floor}): {_within(d, length_unit)}"
    if d.of_field:
        return f"{start}{smooth_errors(d.smooth, length_unit)}{_notes(d)}."
    start += beside_poses(d.smooth, length_unit)
    clear = [x.covariate for x in d.depends_on if x.p_value < 0.01][:3]
    follows = f"it follows {', '.join(clear)}; " if clear else ""
    if said := to_be_said(d.unnamed, d.implausible):
        again = " and ".join(u.words for u in said)
        return (
            f"{start}{follows}the errors of the poses repeat, they {again}{_repeating(d, length_unit)}, and scatter by "
            f"{scatter} otherwise{_notes(d)}{_lack(d)}."
        )
    if not d.implausible:
        otherwise = (
            f"the poses scatter by {scatter} otherwise" if _scatters(d) else "what was seen does not show the poses"
        )
        return f"{start}{follows}{otherwise}{_notes(d)}{_lack(d)}."
    if d.within:
        poses = f"until that is corrected nothing is known of the poses, which scatter by {scatter}"
        return f"{start}{follows}{poses}{_notes(d)}{_lack(d)}."
    than = f"more than {_limits(d, length_unit)} as stated" if d.scatter_limit.stated else "which no sound arm does"
    return (
        f"{start}{follows}the robot's pose errors dominate, they scatter by {scatter}, {than}; such errors repeat at "
        f"the same poses, so that those found on one object correct another{_notes(d)}{_lack(d)}."
    )


def _within(d: Diagnosis, length_unit: str) -> str:
    """What no motion of the views takes away."""
    if not d.within:
        return ""
    return (
        f"{length_text(d.within, length_unit, 2)} remain however each view is moved, so that the scanner or the part's "
        "shape is off and not the poses alone; "
    )


def _repeating(d: Diagnosis, length_unit: str) -> str:
    """How large the errors are that repeat without a name."""
    size = np.sqrt(sum(line.sigma**2 for line in d.budget if line.source not in NOT_REPEATING))
    return f" ({length_text(float(size), length_unit, 2)})" if size > 0 else ""


def _scatters(d: Diagnosis) -> bool:
    """True unless what was seen is the same wherever the poses are."""
    return d.rotation > 0 or d.translation > 0


def _judged_by(d: Diagnosis, length_unit: str) -> str:
    """What "adequate" is measured against."""
    if d.scatter_limit.stated:
        return f"within {_limits(d, length_unit)} as stated"
    usual = _limits(d, length_unit)
    return f"judged by what is usual for an arm (up to {usual}): no repeatability is stated under [robot]"


def _limits(d: Diagnosis, length_unit: str) -> str:
    return f"{length_text(d.scatter_limit.translation, length_unit)} and {angle_text(d.scatter_limit.rotation)}"


def _notes(d: Diagnosis) -> str:
    """Effects that explain much and are not named, and why: an alarm that did not stand is no silence."""
    return "".join(f"; {note}" for note in d.notes)


def _lack(d: Diagnosis) -> str:
    untested = [name for name, needs in d.missing.items() if "joints" in needs or "torque" in needs]
    if not untested:
        return ""
    return f"; without joint angles and the robot's geometry joint effects ({', '.join(untested)}) cannot be tested"


def odds_text(log_odds: float) -> str:
    """3 to 1, or 1 to 3; nobody can vouch for more than a hundred."""
    likelier = f"{np.exp(abs(log_odds)):.2g}" if abs(log_odds) < np.log(99.5) else "more than 100"
    return f"{likelier} to 1" if log_odds >= 0 else f"1 to {likelier}"


def amounts_of(ranked: Ranked, at_most: int = 3) -> str:
    """The clearest parameters: c2 = 0.44 ± 0.04 µrad/(N m)."""
    s = ranked.score
    if not s.fitted:
        return "too small to be worth a fit"
    order = np.argsort(-np.abs(s.values) / np.maximum(s.sigmas, 1e-300))[:at_most]
    clearest = [(s.form.free[i], s.values[i], s.sigmas[i]) for i in sorted(order)]
    fitted = [f"{p.name} = {amount(v, sigma, p.unit)}" for p, v, sigma in clearest]
    tried = [f"{p.name} = {p.told}" for p in s.form.term.parameters if p.grid]
    return ", ".join(tried + fitted)
