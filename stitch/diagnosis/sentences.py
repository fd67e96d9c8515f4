"""The diagnosis in plain sentences with its numbers: one fact each, what was found first, what to do last."""

import re
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from stitch.diagnosis.diagnosis import Diagnosis
from stitch.diagnosis.law_ranking import law_size
from stitch.diagnosis.ranking import Ranked, beyond_belief_text
from stitch.diagnosis.residual_structure import NOT_REPEATING
from stitch.diagnosis.systematic_laws import Law, law_of
from stitch.diagnosis.thresholds import ALPHA, CLEAR_DEPENDENCE, ODDS
from stitch.diagnosis.unmodelled_joint_effects import JointCurve
from stitch.diagnosis.unmodelled_time_effects import ROTATION_PART, TRANSLATION_PART, TimeCurve, reportable
from stitch.effects.contract import EFFECTS
from stitch.numerics.units import angle_text, duration_text, format_amount, length_text, listed, rounded
from stitch.observations.surfaces.field_error import FieldError
from stitch.observations.surfaces.scanner_errors import SCALE_SIGMA

_SCALE = "range_scale"
# Curves of joints that are told in words; the page draws one more.
_MAX_CURVES = 2
# Fitted parameters that are told, those with the most sigmas.
_MOST_AMOUNTS = 3
# Share of the expected scatter beyond which an error of the surface that does not show is told (custom).
_LEAST_SHAPE = 0.5
_CAUSES = (
    "Possible causes: a part that bends, an arm still settling during the scan, a scanner that warms up or errs by "
    "range or brightness."
)


def diagnosis_sentence(d: Diagnosis, length_unit: str, pair: tuple[Ranked, Ranked] | None) -> str:
    """Return a diagnosis as sentences in one text: what was found, how much is left, its source, what to do.

    Args:
        pair: two missing effects, each scored with the other in the model, the named one first; None: not two.
    """
    match d.verdict:
        case "adequate":
            sentences = _adequate(d, length_unit)
        case "missing_effect":
            sentences = _missing_effect(d, length_unit, pair)
        case "cannot_tell":
            sentences = _ambiguous_group(d, length_unit)
        case _:
            sentences = _unknown_effect(d, length_unit)
    return " ".join(sentence for sentence in sentences if sentence)


def _adequate(d: Diagnosis, length_unit: str) -> Iterator[str]:
    """Yield the sentences on an adequate model: scatter of the poses, the scanner's error, what could hide."""
    yield f"The model is adequate. {_residual_sentence(d, length_unit)}"
    if d.rotation > 0 or d.translation > 0:
        scatter = _scatter(d.translation, d.rotation, length_unit)
        several = d.linear.measurement.views.scanners
        scales = f", beside scales of scanners that differ by {100 * SCALE_SIGMA:g} % (1 σ)," if several else ""
        yield f"The robot's poses scatter by {scatter} (1 σ), which{scales} explains the rest."
        yield _allowed(d, length_unit)
        if d.translation > d.expected_scatter.translation or d.rotation > d.expected_scatter.rotation:
            yield "What was found lies above that, by no more than chance explains."
    if d.scanner_error is not None:
        calibration = "" if d.scanner_error.by_view else ", but a calibration may"
        yield f"{scanner_error_sentence(d.scanner_error, length_unit)} No pose corrects that{calibration}."
    largest, name = max(((c.shape or 0.0, c.name) for c in d.candidates), default=(0.0, ""))
    if largest > _LEAST_SHAPE * d.expected_scatter.translation:
        size = length_text(largest, length_unit, 2)
        yield "What all scans share becomes the surface, and no overlap shows it."
        yield f"Unseen, {name} could bend the surface by {size} rms: a part of known shape shows that."
    yield from _not_named(d)


def _missing_effect(d: Diagnosis, length_unit: str, pair: tuple[Ranked, Ranked] | None) -> Iterator[str]:
    """Yield the sentences on one missing effect, and on a second one where there is a `pair`."""
    candidate = next(c for c in d.candidates if c.name == d.effects[0])
    ranked = pair[0] if pair else candidate.ranked
    is_missing = "is missing" if d.certain else "may be missing"
    yield f"{candidate.name} {is_missing} ({fitted_amounts(ranked)}; p = {ranked.adjusted:.1g})."
    yield _what_looks_the_same(d, candidate.name)
    yield from _why_not_the_likeliest(d)
    yield _odds_over_chance(d)
    yield _residual_sentence(d, length_unit)
    if candidate.cross_validation is not None:
        inside, heldout = (length_text(x, length_unit) for x in d.rms_if_added(candidate.cross_validation))
        yield f"With the effect it should be {inside}, and on views left out {heldout}."
    if pair:
        yield f"{pair[1].name} seems to be missing too ({fitted_amounts(pair[1])})."
        yield "Both sizes hold for a model with both effects."
    if _SCALE in (candidate.name.partition("@")[0], pair[1].name.partition("@")[0] if pair else ""):
        # Scans, hand-eye and ways of the arm, all longer by the same share, fit each other as before.
        yield "These views cannot tell it from arm lengths that are all off by the same share; a known length can."
    if d.beyond_belief:
        yield f"{beyond_belief_text(d.beyond_belief)}: check session.toml."


def _what_looks_the_same(d: Diagnosis, name: str) -> str:
    """Return a sentence that a moving base of the robot looks the same as the named effect; "" where it does not.

    The base cannot be told from whatever stands still beside it: the scanner's stand (eye_to_hand) or the part's
    fixture (eye_in_hand).

    Args:
        name: of the effect; of one scanner of several it ends in @SCANNER.
    """
    of_all = name.partition("@")[0]
    place = EFFECTS[of_all].place if of_all in EFFECTS else ""
    if place not in ("mount", "part") or d.linear.measurement.eye_to_hand != (place == "mount"):
        return ""
    stands = "the scanner's stand" if place == "mount" else "what holds the part"
    return f"A base of the robot that moves so looks the same to these views as {stands}."


def _why_not_the_likeliest(d: Diagnosis) -> Iterator[str]:
    """Yield why the named effect is not the one that explains most alone; nothing where it is that one.

    `candidates` are ordered by what each explains alone. `effects` are named, `together` are missing side by side.
    """
    first = d.candidates[0]
    named = d.effects[0]
    if first.name == named:
        return
    yield f"Alone, {first.name} would explain more (posterior {first.ranked.posterior:.2f})."
    objection = next((note for note in d.notes if first.name in note), None)
    if objection is not None:
        yield f"But {objection}."
    elif first.name in d.together:
        yield f"It is missing too; beside it, most stays unexplained without {named}."
    else:
        yield f"Beside {' and '.join(d.together or d.effects)} it is not needed."


def _ambiguous_group(d: Diagnosis, length_unit: str) -> Iterator[str]:
    """Yield the sentences on effects that these views cannot tell apart."""
    is_missing = "is missing" if d.certain else "may be missing"
    yield f"Something {is_missing}: {' or '.join([*d.effects, *unnamed_in_words(d)])}. These views cannot tell which."
    yield _step_like_what_lasts(d)
    if d.coincidence:
        yield f"{d.coincidence}. To tell, drive a few of these poses again from the first side."
    yield _odds_over_chance(d)
    yield _residual_sentence(d, length_unit)


def _step_like_what_lasts(d: Diagnosis) -> str:
    """Return a sentence on an event of the group that looks like a lasting effect of it; "" where there is none.

    An event early in the session, such as a slip, displaces nearly all views as a constant error would.
    """
    group = [c for c in d.candidates if c.name in d.effects]
    for begins in group:
        view = next((p.view for p in begins.ranked.score.form.term.parameters if p.discrete), None)
        lasting = [c for c in group if begins.name in c.aliases and not c.ranked.score.form.term.gridded.any()]
        if view is not None and lasting:
            return f"{begins.name} from view {view} on looks the same in these views as {lasting[0].name} in all."
    return ""


def _unknown_effect(d: Diagnosis, length_unit: str) -> Iterator[str]:
    """Yield the sentences on an error without a name: laws, scanner, covariates, places, poses, untested effects."""
    yield f"Something is missing: {why_without_a_name(d)}. {_residual_sentence(d, length_unit)}"
    if (nearest := _nearest(d)) is not None:
        yield f"{nearest.name} comes nearest (p = {nearest.adjusted:.1g})."
    yield from _laws_found(d)
    if d.overlap_misfit:
        size = length_text(d.overlap_misfit, length_unit, 2)
        yield f"However each view is moved, the overlaps keep a misfit of {size}."
        yield "So the scanner or the part's shape is off, and not only the poses."
    if d.follows_field:
        yield from scanner_advice(d.scanner_error, length_unit)
        yield from _not_named(d)
        return
    if d.scanner_error is not None:
        yield scanner_error_sentence(d.scanner_error, length_unit)
        if d.scanner_error.by_view:
            yield f"Poses found from such scans scatter too. {_CAUSES}"
    clear = [x.covariate for x in d.depends_on if x.p_value < CLEAR_DEPENDENCE][:3]
    if clear and not d.laws:
        yield f"What is left follows {listed(clear, 'and')}."
    if d.places:
        yield f"Whatever it follows, it acts at {listed(d.places, 'or')}: laws elsewhere are less likely by 20 to 1."
    yield from _poses_of_unknown(d, length_unit)
    yield from _not_named(d)
    untested = [name for name, needs in d.missing.items() if "joints" in needs or "torque" in needs]
    if untested:
        yield f"Joint effects were not tested ({', '.join(untested)}): they need joint angles and the robot's geometry."


def why_without_a_name(d: Diagnosis) -> str:
    """Return as a clause why no effect is named: these views test none, none is clear enough, or none explains it."""
    if not any(c.ranked.score.observable for c in d.candidates):
        return "these views can test no known effect"
    return "no known effect is clear enough to be named" if _nearest(d) else "no known effect explains it"


def _nearest(d: Diagnosis) -> Ranked | None:
    """Return the effect of the least p, where that is less than chance allows; None: there is none."""
    likely = [c.ranked for c in d.candidates if c.ranked.score.observable and c.ranked.adjusted < ALPHA]
    return min(likely, key=lambda ranked: ranked.adjusted, default=None)


def _poses_of_unknown(d: Diagnosis, length_unit: str) -> Iterator[str]:
    """Yield sentences on the pose errors where nothing is named: whether they repeat, and how much they scatter."""
    scatter = _scatter(d.translation, d.rotation, length_unit)
    if errors := reportable(d.repeating_errors, d.implausible):
        size = np.sqrt(sum(line.sigma**2 for line in d.budget if line.source not in NOT_REPEATING))
        amount = f" ({length_text(float(size), length_unit, 2)})" if size > 0 else ""
        beside = "Beside that the" if d.laws else "The"
        yield f"{beside} pose errors repeat{amount}: they {' and '.join(error.words for error in errors)}."
        yield f"Apart from that the poses scatter by {scatter}."
    elif not d.implausible:
        scatters = d.rotation > 0 or d.translation > 0
        yield f"The poses scatter by {scatter}." if scatters else "The measured points do not show the poses."
        if d.beyond_expected:
            yield f"{_allowed(d, length_unit)} So more is left than scatter explains."
    elif d.overlap_misfit:
        yield f"The poses scatter by {scatter}; how much of that is the robot's shows once the misfit is corrected."
    else:
        limits = _scatter(d.scatter_limit.translation, d.scatter_limit.rotation, length_unit)
        limit = f"{'stated' if d.scatter_limit.stated else 'usual'}: up to {limits}"
        yield f"The robot's pose errors dominate: they scatter by {scatter} ({limit})."
        yield "If they repeat at the same poses, a correction found on one object holds for another: drive some twice."


def _allowed(d: Diagnosis, length_unit: str) -> str:
    """Return a sentence on the expected scatter of the poses: as stated, or else that of ordinary arms."""
    limits = _scatter(d.expected_scatter.translation, d.expected_scatter.rotation, length_unit)
    if d.expected_scatter.stated:
        return f"The stated repeatability allows {limits}."
    return f"No repeatability is stated under [robot]; ordinary arms stay below {limits}."


def unnamed_in_words(d: Diagnosis) -> list[str]:
    """Return what has no name of its own and explains the views as well as what is named, or what is found instead."""
    laws = dict.fromkeys(law_in_words(law_of(r)) for r in d.laws)
    return [*laws, *([d.rival_trend] if d.rival_trend else [])]


def law_in_words(law: Law) -> str:
    """Return a law in words: joint 5 follows ambient_c (a line).

    Where the joint's range is too short for one whole period, no number of periods per turn is stated.
    """
    joint = re.fullmatch(r"j(\d+)_deg", law.driver.covariate)
    if joint is None:
        return law.words
    angle = "its angle" if law.place.name == f"joint {joint[1]}" else f"the angle of joint {joint[1]}"
    if not law.in_part_of_a_wave:
        return f"{law.place.name} follows {angle} ({law.shape})"
    driven = float(np.ptp(law.driver.values))
    return f"the error of {law.place.name} changes with {angle}, over the {driven:.0f}° driven"


def _laws_found(d: Diagnosis) -> Iterator[str]:
    """Yield sentences on the laws of the dictionary that explain the rest, with sizes and advice; nothing without."""
    if not d.laws:
        return
    laws = [f"{law_in_words(law_of(r))}, by {format_amount(*law_size(d.linear, r))}" for r in d.laws]
    among = "A law does" if len(laws) == 1 else "One of these laws does, and these views cannot tell which"
    yield f"{among}: {listed(laws, 'or')} (p = {d.laws[0].adjusted:.1g})."
    yield "Keep what it follows steady, or describe it by an effect of your own (stitch explain writes one)."


def _residual_sentence(d: Diagnosis, length_unit: str) -> str:
    now, floor = (length_text(x, length_unit) for x in (d.residual_rms, d.noise_floor))
    return f"The residual is {now}; the sensor's noise alone would leave {floor}."


def _odds_over_chance(d: Diagnosis) -> str:
    """Say how much likelier than chance it is, where that is little."""
    if d.log_odds_over_nothing > ODDS:
        return ""
    return f"The odds that it is more than chance are {odds_text(d.log_odds_over_nothing)}."


def _scatter(translation: float, rotation: float, length_unit: str) -> str:
    return f"{length_text(translation, length_unit)} and {angle_text(rotation)}"


def _not_named(d: Diagnosis) -> Iterator[str]:
    """Say which effects explain much and are not named, and why: an alarm that did not stand is no silence."""
    yield from (f"Not named: {note}." for note in d.notes)


def scanner_error_sentence(error: FieldError, length_unit: str) -> str:
    """Return a sentence on the scanner's smooth error with its rms, by its kind.

    It is the same in every view, or each scan's own, whichever is clearer. If it is the former, that views also differ
    is said without a size, which is uncertain.
    """
    drift = ", larger as the session goes on" if error.with_time else ""
    if error.by_view:
        return f"Each scan has a smooth error of its own{drift}: {length_text(error.rms_by_view, length_unit, 2)} rms."
    size = length_text(error.rms, length_unit, 2)
    common = f"The scanner errs over its field, the same in every view: {size} rms."
    return f"{common} In part each view errs by itself{drift}." if error.rms_by_view else common


def scanner_advice(error: FieldError | None, length_unit: str) -> Iterable[str]:
    """Return sentences on the scanner's error where nothing else is named, and what to do about it.

    Args:
        error: of the scanner; None: it is inferred from the poses alone, and has no size.
    """
    if error is not None and error.by_view:
        return (
            scanner_error_sentence(error, length_unit),
            _CAUSES,
            "Scan the first pose again at the end: what differs then comes from the part or from time.",
        )
    where = "What is left depends on where in the scanner's field a point is seen, the same in every view."
    size = "" if error is None else scanner_error_sentence(error, length_unit)
    return where, size, "Have the scanner calibrated, or describe its error by an effect of your own."


def curve_sentences(d: Diagnosis, length_unit: str) -> list[str]:
    """Return sentences on trends without a name: of up to `_MAX_CURVES` joints, what these follow, and in time."""
    curves = d.curves[:_MAX_CURVES]
    sentences = [joint_curve_sentence(curve) for curve in curves]
    undecided = {curve.joint: curve.may_follow for curve in curves if len(curve.may_follow) > 1}
    sentences += [
        f"These views do not tell whether joint {joint} follows {listed(others, 'or')}."
        for joint, others in undecided.items()
    ]
    return sentences if d.time_curve is None else [*sentences, time_curve_sentence(d.time_curve, length_unit)]


def joint_curve_sentence(curve: JointCurve) -> str:
    """Return a sentence with the least and the largest error of a joint, and where in its range they are."""
    low, high = (
        f"{rounded(1e3 * curve.error[i], 1e3 * curve.sigma[i])} ± {1e3 * curve.sigma[i]:.1g} mrad "
        f"{_place_in_words(curve, i)}"
        for i in curve.extremes
    )
    place = curve.place[:1].upper() + curve.place[1:]
    return f"{place} is off by {low}, and by {high}. That is {curve.share:.0%} of its error without a name."


def _place_in_words(curve: JointCurve, k: int) -> str:
    """Return point k of a curve in words by the kind of its covariate: at j4 = -48°, after a move of 12°, at view 7."""
    place = curve.at[k]
    name = curve.covariate
    match name.split("_", 1)[-1]:
        case "move_deg":
            return f"after a move of {place:.0f}°"
        case "deg":
            return f"at {name.removesuffix('_deg')} = {place:.0f}°"
        case "s":
            return f"{duration_text(place - curve.view_values.min())} into the session"
        case "view":
            return f"at view {place:.0f}"
    load = rounded(place, 0.1 * (curve.at[-1] - curve.at[0]))
    return f"under {load} N m" + (" of each kg" if name.endswith("_per_kg") else "")


def time_curve_sentence(curve: TimeCurve, length_unit: str) -> str:
    """Return sentences on the largest motion and turn of the flange in time, and how to find the cause."""

    def when(k: int) -> str:
        steps = curve.steps[k] - curve.steps[0]
        return f"{duration_text(steps * curve.seconds)} into the session" if curve.seconds else f"at view {steps:.0f}"

    moved_at, moved, moved_sigma = curve.largest(TRANSLATION_PART)
    turned_at, turned, turned_sigma = curve.largest(ROTATION_PART)
    return (
        f"The flange seems off by up to {format_amount(moved, moved_sigma, length_unit)} "
        f"{when(moved_at)}, and turned by up to {format_amount(turned, turned_sigma, 'rad')} "
        f"{when(turned_at)}. If something in the cell varies like that (a temperature, a machine "
        "nearby), add it to views.csv as a column."
    )


def odds_text(log_odds: float) -> str:
    """Return 3 to 1, or 1 to 3; nobody can vouch for more than a hundred."""
    likelier = f"{np.exp(abs(log_odds)):.2g}" if abs(log_odds) < np.log(99.5) else "more than 100"
    return f"{likelier} to 1" if log_odds >= 0 else f"1 to {likelier}"


def posterior_text(verdict: str, named: Sequence[str], posteriors: dict[str, float], effect: str) -> str:
    """Return the posterior of an effect as text; for a member of an undecided group that of the whole group.

    Within a group only the prior of how common each effect is would divide it, and that did not decide.

    Args:
        verdict: of the diagnosis.
        named: the effects that it names.
        posteriors: by effect.
    """
    if verdict != "cannot_tell" or effect not in named:
        return f"{posteriors[effect]:.2f}"
    together = sum(posteriors.get(name, 0.0) for name in named)
    return "cannot tell" if len(named) == 1 else f"{together:.2f} together"


def fitted_amounts(ranked: Ranked) -> str:
    """Return the parameters of the best form as text, c2 = 0.44 ± 0.04 µrad/(N m): gridded first, then the clearest."""
    scored = ranked.score
    if not scored.fitted:
        return "too small to be worth a fit"
    clearest = np.argsort(-np.abs(scored.values) / np.maximum(scored.sigmas, 1e-300))[:_MOST_AMOUNTS]
    tried = [f"{p.name} = {p.formatted}" for p in scored.form.term.parameters if p.grid]
    fitted = []
    for i in sorted(clearest):
        parameter = scored.form.free[i]
        fitted.append(f"{parameter.name} = {format_amount(scored.values[i], scored.sigmas[i], parameter.unit)}")
    return ", ".join(tried + fitted)
