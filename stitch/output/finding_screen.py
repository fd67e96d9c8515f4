"""What one screen shows of a diagnosis: the cause in words, its proof, what each candidate would leave, and why.

The page of a run, its review and the first tab of its recording draw from this part of diagnosis.json alone.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from operator import itemgetter
from typing import Any

import numpy as np

from stitch.diagnosis.diagnosis import CandidateEffect, Diagnosis
from stitch.diagnosis.effect_trend import (
    expected_in_view,
    trend_in_model,
    trend_of_curve,
    trend_of_dependence,
    trend_of_law,
    trends_of_candidates,
)
from stitch.diagnosis.fitted_effect import EffectTrend
from stitch.diagnosis.residual_structure import NOT_REPEATING, predicted_distances
from stitch.diagnosis.sentences import fitted_amounts, odds_text, unnamed_in_words, why_without_a_name
from stitch.diagnosis.thresholds import CLEAR_DEPENDENCE, ODDS
from stitch.diagnosis.unmodelled_time_effects import reportable
from stitch.effects.contract import describe_need
from stitch.numerics.frames import Array
from stitch.numerics.least_squares import project_out
from stitch.numerics.units import angle_text, display_unit, length_text, listed
from stitch.output.comparison.disagreement_field import DisagreementField, Patches
from stitch.output.comparison.model_history import model_history
from stitch.output.plain_finding import open_doubts, unnamed_finding
from stitch.output.plain_words import DESCRIPTIONS, EVENTS, JOINT_DESCRIPTIONS, effect_description, plain_covariate
from stitch.system.threads import remembered

# Candidate effects that a screen compares: so many, and those that take 3 % of the rms on views left out (mean square).
_BEST = 3
_HELPS = 0.94
# Digits of a field in length_unit: thousandths of its largest value are finer than any colour.
_FINE = 1e-3
# An effect that leaves so much more of the error on views left out fits less well.
_WORSE = 0.03
# What an effect changes over the views by less than this share of its size is the same in all.
_FLAT = 0.02
# An effect of which the plot shows less than this share is told with what the hand-eye takes of it.
_MOSTLY = 0.9
# A parameter of so many sigmas is clear, and so many links are told by their numbers.
_CLEAR, _MOST_LINKS = 5.0, 2
# A chance that needs no number.
_PLAIN_CHANCE = 0.5
_VERDICTS_WITH_NAMES = ("missing_effect", "cannot_tell")
# A source of less of the error than this share of its square has no place in a strip.
_SEEN_SHARE = 1e-4


@remembered
def finding_screen(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the screen of a diagnosis as JSON, the entry `screen` of diagnosis.json; length_unit and rad."""
    candidates = compared(diagnosis)
    patches, present, if_added = _fields(diagnosis, candidates)
    trends = trends_of_candidates(diagnosis.linear, [c.ranked.score for c in candidates])
    why = _trend_behind_finding(diagnosis, trends)
    return {
        "headline": _headline(diagnosis, trends),
        "proof": _proof(diagnosis, candidates, trends, present, if_added),
        "certainty": certainty(diagnosis),
        "now": {"heldout": diagnosis.heldout_rms} | _on_part(present),
        "noise": diagnosis.noise_floor,
        "sources": error_sources(diagnosis),
        "unseen": unseen_text(diagnosis),
        "untested": untested_text(diagnosis),
        "formula": _formula(diagnosis),
        "why": _trend_row(why),
        "candidates": [_candidate_row(diagnosis, c, if_added.get(c.name), trends.get(c.name)) for c in candidates],
        "deciding_view": _deciding_view(diagnosis, trends),
        "places": None if patches is None else np.round(patches.points, 2).tolist(),
        "doubts": list(open_doubts(diagnosis)),
    }


def _fields(
    diagnosis: Diagnosis, candidates: Sequence[CandidateEffect]
) -> tuple[Patches | None, DisagreementField | None, dict[str, DisagreementField]]:
    """Return patches of the part's surface, the views' disagreement on them now, and that with each candidate added.

    Disagreement is the signed distance between the surfaces of two views, length_unit. Without clouds: None, None, {}.
    """
    history, registered = model_history(diagnosis.run), diagnosis.run.registered
    if history is None or registered is None:
        return None, None, {}
    patches, present = history.patches, history.models[-1].field
    before, if_added = predicted_distances(diagnosis.linear, matches=registered.matches), {}
    for candidate in candidates:
        after = predicted_distances(diagnosis.linear, candidate.ranked.score, registered.matches)
        assert before is not None and after is not None
        # Only the change is predicted: it is added to the field that was measured.
        change = patches.field(after - before)
        if_added[candidate.name] = replace(present, values=present.values + change.values)
    return patches, present, if_added


def compared(diagnosis: Diagnosis) -> list[CandidateEffect]:
    """Return up to `_BEST` fitted effects that a screen compares: first those named by the diagnosis, then the best.

    The best are those that leave the smallest share of the mean square error on views left out.
    """
    named = diagnosis.effects
    ranks = {name: i for i, name in enumerate(named)}
    ordered = list[tuple[int, float, CandidateEffect]]()  # by place among the named effects, then by the share
    for candidate in diagnosis.candidates:
        score, validation = candidate.ranked.score, candidate.cross_validation
        share = validation.heldout if validation else 0.0
        if score.observable and score.fitted and (candidate.name in ranks or (validation and share < _HELPS)):
            ordered.append((ranks.get(candidate.name, len(named)), share, candidate))
    ordered.sort(key=itemgetter(0, 1))
    return [candidate for *_, candidate in ordered[:_BEST]]


def _trend_behind_finding(diagnosis: Diagnosis, trends: dict[str, EffectTrend]) -> EffectTrend | None:
    """Return the trend that is drawn as the reason for a finding; None where there is none.

    It is that of the effect which is missing; where nothing is, that of the model's last effect. For an unknown effect
    it is the law, the joint's curve or the covariate that the error follows most clearly.
    """
    linear = diagnosis.linear
    if diagnosis.verdict in _VERDICTS_WITH_NAMES:
        return trends.get(diagnosis.effects[0])
    if diagnosis.verdict == "adequate":
        return trend_in_model(linear, linear.model.terms[-1]) if linear.model.effects else None
    law = trend_of_law(linear, diagnosis.laws[0]) if diagnosis.laws else None
    if law is not None:
        return law
    if diagnosis.curves:
        return trend_of_curve(linear, diagnosis.curves[0])
    return trend_of_dependence(linear, diagnosis.depends_on[0]) if diagnosis.depends_on else None


def _candidate_row(
    diagnosis: Diagnosis, candidate: CandidateEffect, field: DisagreementField | None, trend: EffectTrend | None
) -> dict[str, Any]:
    """Return a candidate as a screen lists it; `field` is the disagreement on the part that it would leave."""
    validation = candidate.cross_validation
    return {
        "effect": candidate.name,
        "words": _cause(candidate, trend),
        "heldout": None if validation is None else diagnosis.rms_if_added(validation)[1],
        **_on_part(field),
        "fits": _fits(diagnosis, candidate),
        "place": _place(candidate, trend),
        "why": _trend_row(trend),
    }


def _place(candidate: CandidateEffect, trend: EffectTrend | None) -> str:
    """Return what errs where a candidate is the cause: joint 2, link 4, the scanner's mount; empty where unknown."""
    links = _clear_links(candidate) if candidate.name == "link_geometry" else []
    return " and ".join(f"link {link}" for link in links) or ("" if trend is None else trend.moves)


def _fits(diagnosis: Diagnosis, candidate: CandidateEffect) -> str:
    """Return "yes", "no" or "not needed" for a candidate, followed by the reason where there is one.

    Reasons in order: it leaves more error than the effect named; it is rarer; a note objects; the evidence.
    """
    if diagnosis.verdict == "adequate":
        return "not needed"
    unit = diagnosis.linear.measurement.length_unit
    validation = candidate.cross_validation
    left = diagnosis.heldout_rms if validation is None else diagnosis.rms_if_added(validation)[1]
    if diagnosis.verdict == "unknown_effect":
        return f"no: it leaves {length_text(left, unit, 2)}"
    named = next(c for c in diagnosis.candidates if c.name == diagnosis.effects[0])
    is_named = candidate.name in diagnosis.effects
    if named.cross_validation is not None and validation is not None:
        more = left - diagnosis.rms_if_added(named.cross_validation)[1]
        if more > _WORSE * left:
            its, least = (length_text(value, unit, 2) for value in (left, left - more))
            return f"{'yes, though' if is_named else 'no:'} it leaves {its} instead of {least}"
    if is_named:
        rarer = candidate.ranked.log_belief < named.ranked.log_belief
        return "yes, though met more rarely (a judgement)" if rarer else "yes"
    against = named.ranked.score.log_bayes_factor - candidate.ranked.score.log_bayes_factor
    objection = next((note for note in diagnosis.notes if note.startswith(f"{candidate.name} explains")), "")
    if objection and against < ODDS:
        return f"no: it{objection.removeprefix(candidate.name)}"
    return f"no: the evidence is {odds_text(max(against, 0.0))} against it"


def _deciding_view(diagnosis: Diagnosis, trends: dict[str, EffectTrend]) -> dict[str, Any] | None:
    """Return what each undecided effect predicts for the first proposed view, and how likely the views decide.

    None where nothing is undecided, or where no pose is proposed; joints in degrees, `wait_s` in s.
    """
    rivals = [c.ranked.score for c in compared(diagnosis) if c.name in diagnosis.effects and c.name in trends]
    pose = next((proposal for proposal in diagnosis.next if proposal.joints_deg is not None), None)
    if diagnosis.verdict != "cannot_tell" or len(rivals) < 2 or pose is None or pose.joints_deg is None:
        return None
    view = expected_in_view(diagnosis.linear, rivals, np.radians(pose.joints_deg), pose.wait_s)
    if view is None:
        return None
    at, scatter, heights = view
    expected = [{"effect": name, "value": value, "sigma": sigma} for name, (value, sigma) in heights.items()]
    trend = trends[rivals[0].name]
    return {
        "joints_deg": pose.joints_deg,
        "wait_s": pose.wait_s,
        "views": sum(proposal.joints_deg is not None for proposal in diagnosis.next),
        "probability": pose.probability,
        "at": at,
        "of": trend.of,
        "value_unit": trend.value_unit,
        "sigma": scatter,
        "expected": expected,
    }


def _on_part(field: DisagreementField | None) -> dict[str, Any]:
    """Return mean and worst disagreement on the part, and that of every patch, length_unit; null where unknown."""
    if field is None:
        return {"mean": None, "worst": None, "field": None}
    worst = float(np.nanmax(field.overall, initial=0.0))
    digits = max(0, int(np.ceil(-np.log10(_FINE * max(worst, 1e-12)))))
    values = [round(x, digits) if np.isfinite(x) else None for x in field.overall.tolist()]
    return {"mean": field.mean_abs, "worst": worst, "field": values}


def _formula(diagnosis: Diagnosis) -> str:
    """Return the formula of the effect that is named with its fitted numbers, as a sentence; empty without a name.

    Undecided effects get a sentence each; where nothing is missing, it is that of the model's last effect.
    """
    if diagnosis.verdict in _VERDICTS_WITH_NAMES:
        laws = [f"{r.score.candidate.effect.formula}; {fitted_amounts(r)}" for r in diagnosis.named]
        if diagnosis.verdict == "missing_effect":
            return f"The law: {laws[0]}."
        shown = zip(diagnosis.effects, laws[:_BEST], strict=False)
        return " ".join(f"If it is {effect}: {law}." for effect, law in shown)
    if diagnosis.verdict != "adequate" or not diagnosis.linear.model.effects:
        return ""
    term = diagnosis.linear.model.terms[-1]
    amounts = [f"{p.name} = {p.formatted}" for p in term.parameters if p.fitted or p.grid]
    return f"The law: {term.effect.formula}; {', '.join(amounts)}."


def _trend_row(trend: EffectTrend | None) -> dict[str, Any] | None:
    """Return a trend as a screen draws it, its dots as lists of numbers; None for None."""
    if trend is None:
        return None
    words = {key: getattr(trend, key) for key in ("follows", "unit", "of", "value_unit")}
    numbers = ("at", "measured", "sigma", "predicted", "predicted_sigma")
    dots = {key: _rounded(getattr(trend, key)) for key in numbers}
    after = None if trend.after is None else _rounded(trend.after)
    return words | {"views": trend.views.tolist(), "after": after} | dots


def _rounded(values: Array) -> list[float]:
    return [float(f"{x:.4g}") for x in values]


def _headline(diagnosis: Diagnosis, trends: dict[str, EffectTrend]) -> str:
    """Return the headline of the screen by the verdict: what is missing, in one or two sentences."""
    match diagnosis.verdict:
        case "adequate":
            in_model = [effect_description(name) or name for name in diagnosis.linear.model.effects]
            if not in_model:
                return _tested(diagnosis, "missing")
            return f"In the model: {'; '.join(in_model)}. {_tested(diagnosis, 'further')}"
        case "unknown_effect":
            return unnamed_finding(diagnosis)
    named = [c for c in compared(diagnosis) if c.name in diagnosis.effects]
    if diagnosis.verdict == "cannot_tell":
        return _rivals(named, trends, unnamed_in_words(diagnosis))
    return f"{'' if diagnosis.certain else 'Perhaps: '}{_cause(named[0], trends.get(named[0].name))}."


def _tested(diagnosis: Diagnosis, which: str) -> str:
    """Return the sentence that none of the tested effects was found, and how many could not be tested.

    Args:
        which: "missing" or "further", the adjective before "effect".
    """
    tried = effects_tried(diagnosis)
    untested = len(diagnosis.candidates) - tried + len(diagnosis.missing)
    others = f"; {untested} could not be tested" if untested else ""
    return f"No {which} effect was found among {tried}{others}."


def effects_tried(diagnosis: Diagnosis) -> int:
    """Return how many effects were tried: those that these views could show."""
    return sum(c.ranked.score.observable for c in diagnosis.candidates)


def untested_text(diagnosis: Diagnosis) -> str:
    """Return which effects could not be tested and what they need, a sentence for each need; empty where all were.

    Effects lack other poses (not observable), or data of the session, such as joint angles.
    """
    unseen = [c.name for c in diagnosis.candidates if not c.ranked.score.observable]
    lines = [f"These views cannot show {listed(unseen, 'and')}: other poses are needed."] if unseen else []
    for needs in dict.fromkeys(diagnosis.missing.values()):
        names = [name for name, lacks in diagnosis.missing.items() if lacks == needs]
        were, they = ("was", "it needs") if len(names) == 1 else ("were", "they need")
        what = listed([describe_need(need) for need in needs], "and")
        lines.append(f"{listed(names, 'and').capitalize()} {were} not tested: {they} {what}.")
    return " ".join(lines)


def error_sources(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Return the sources of the error on views left out: kind, words and rms (length_unit) of each.

    Their squares add up to the square of that error, but for negligible ones. First comes what the named effect would
    take away, then the scanner's noise, then the misfit that no motion of the views removes. The remainder is split as
    the budget of the views' poses is: into errors new in every view (the arm's scatter) and repeating ones.
    """
    total = diagnosis.heldout_rms**2
    if not np.isfinite(total):
        return []
    sources = []
    named = next((c for c in diagnosis.candidates if c.name in diagnosis.effects[:1]), None)
    explained = 0.0
    if named is not None and named.cross_validation is not None:
        explained = max(total * (1 - named.cross_validation.heldout), 0.0)
        sources.append(("effect", named.name if len(diagnosis.effects) == 1 else "one of these", explained))
    scanner = min(diagnosis.noise_floor**2, total - explained)
    misfit = min(diagnosis.overlap_misfit**2, total - explained - scanner)
    left = max(total - explained - scanner - misfit, 0.0)
    # These sources are counted above already, or are corrected by the model.
    counted = {*diagnosis.effects, *diagnosis.linear.model.effects, "sensor noise", "scanner field"}
    shares = [(line.source, line.variance_share) for line in diagnosis.budget if line.source not in counted]
    whole = sum(share for _, share in shares)
    scatter = sum(share for source, share in shares if source in NOT_REPEATING) / whole if whole > 0 else 1.0
    sources += [("arm", "arm's scatter", left * scatter), ("scanner", "scanner's noise", scanner)]
    sources.append(("unexplained", "without a name", left * (1 - scatter) + misfit))
    return [
        {"kind": kind, "words": words, "rms": float(np.sqrt(square))}
        for kind, words, square in sources
        if square > _SEEN_SHARE * total
    ]


def unseen_text(diagnosis: Diagnosis) -> str:
    """Return a sentence on what could hide in these views: the smallest size of an effect that would show in them.

    Of each effect it is that of the parameter which shows best. Told are the three effects that would move the views
    most (rms of the reduced observations), hand-eye fitted anew. Empty unless nothing is missing and a size is known.
    """
    if diagnosis.verdict != "adequate":
        return ""
    linear = diagnosis.linear
    length_unit = linear.measurement.length_unit
    hand_eye = linear.reduce(linear.design[:, :6])
    hidden = list[tuple[float, str]]()  # by how much an effect moves the views, and its text
    for candidate in diagnosis.candidates:
        name = clearest_parameter(candidate)
        smallest = candidate.detectable.get(name or "", np.inf)
        if not np.isfinite(smallest):
            continue
        form = candidate.ranked.score.candidate.forms[0]
        k = next(k for k, p in enumerate(form.term.parameters) if p.name == name)
        # What the parameter does to the views per unit, without what the hand-eye does as well.
        per_unit = project_out(hand_eye, form.reduced[:, k : k + 1])
        moved = smallest * float(np.linalg.norm(per_unit)) / np.sqrt(max(linear.mixed.size, 1))
        factor, shown_unit = display_unit(form.term.parameters[k].unit)
        amount = f"{name} = {factor * smallest:.2g} {shown_unit}".rstrip()
        hidden.append((moved, f"{candidate.name} below {amount} (moves views by {length_text(moved, length_unit, 2)})"))
    largest = [text for _, text in sorted(hidden, reverse=True)[:_BEST]]
    return f"Too small to show here: {'; '.join(largest)}." if largest else ""


def clearest_parameter(candidate: CandidateEffect) -> str | None:
    """Return the parameter with the smallest ratio of detectable to plausible size; None where none is detectable."""
    plausible = {p.name: p.typical for p in candidate.ranked.score.candidate.parameters}
    detectable = candidate.detectable
    return min(detectable, key=lambda name: detectable[name] / plausible[name]) if detectable else None


def _rivals(named: Sequence[CandidateEffect], trends: dict[str, EffectTrend], unnamed: Sequence[str]) -> str:
    """Return the headline where the views cannot decide between several causes; shorter where all are of one joint.

    Args:
        named: the effects that explain the views equally well.
        unnamed: laws without the name of an effect that do so too, in words.
    """
    joints = {trends[c.name].moves if c.name in trends else "" for c in named}
    joint = joints.pop() if len(joints) == 1 else ""
    names = [c.name for c in named]
    if joint.startswith("joint") and not unnamed and all(name in JOINT_DESCRIPTIONS for name in names):
        if set(names) == {"gear_eccentricity", "gear_harmonic"}:
            which = "it errs once or twice a turn"
            return f"{joint.capitalize()} has an uneven gear. These views cannot tell whether {which}."
        which = " or ".join(JOINT_DESCRIPTIONS[name] for name in names)
        return f"{joint.capitalize()} errs. These views cannot tell whether it {which}."
    causes = [*(_cause(c, trends.get(c.name)) for c in named), *unnamed]
    if len(causes) == 1:
        return f"Perhaps: {causes[0]}. These views cannot tell."
    which = ", or ".join(cause[:1].lower() + cause[1:] for cause in causes)
    return f"{which[:1].upper()}{which[1:]}: these views cannot tell which."


def _decided_by(diagnosis: Diagnosis) -> str:
    """Return how probably the proposed views will decide, as a sentence; empty where no pose is proposed."""
    # Each probability is that of deciding with this view and those before it.
    odds = [proposal.probability for proposal in diagnosis.next if proposal.probability is not None]
    if not odds:
        return ""
    several = f", {len(odds)} with {odds[-1]:.0%}" if len(odds) > 1 else ""
    return f" One more view decides with a probability of {odds[0]:.0%}{several}."


def _cause(candidate: CandidateEffect, trend: EffectTrend | None) -> str:
    """Return an effect as a sentence without its full stop: with the joint, link or view at which it acts, if known."""
    name = candidate.name
    term = candidate.ranked.score.form.at(candidate.ranked.score.values)
    # A discrete parameter is the view before which an event took place.
    view = next((p.view for p in term.parameters if p.discrete), "")
    when = f" before view {view}" if view else ""
    if trend is not None and name in JOINT_DESCRIPTIONS and trend.moves.startswith("joint"):
        return f"{trend.moves.capitalize()} {JOINT_DESCRIPTIONS[name]}{when}"
    if view and name not in EVENTS:
        return f"{name} at {view}"
    if name == "link_geometry" and (links := _clear_links(candidate)):
        return f"Link {' and '.join(links)} of the arm {'is' if len(links) == 1 else 'are'} not as stated"
    description = EVENTS[name] + when if view else DESCRIPTIONS.get(name, name)
    return description[:1].upper() + description[1:]


def _clear_links(candidate: CandidateEffect) -> list[str]:
    """Return the numbers of the links with a parameter beyond `_CLEAR` sigmas; none if more than `_MOST_LINKS`."""
    scored = candidate.ranked.score
    sized = zip(scored.form.free, scored.values, scored.sigmas, strict=True)
    clear = {re.sub(r"\D", "", p.name) for p, value, sigma in sized if abs(value) > _CLEAR * sigma}
    return sorted(clear) if len(clear) <= _MOST_LINKS else []


def _proof(
    diagnosis: Diagnosis,
    candidates: Sequence[CandidateEffect],
    trends: dict[str, EffectTrend],
    present: DisagreementField | None,
    if_added: dict[str, DisagreementField],
) -> str:
    """Return sentences that back a finding: size of the effect, error on views left out now and with it, noise.

    The size is given only where a single effect is named.

    Args:
        candidates: effects on the screen.
        trends: by effect, what it does over the views.
        present: disagreement of the views on the part now; None without clouds.
        if_added: by effect, that disagreement with it in the model.
    """
    unit = diagnosis.linear.measurement.length_unit
    now = length_text(diagnosis.heldout_rms, unit, 2)
    noise = length_text(diagnosis.noise_floor, unit, 2)
    error = f"The error on held-out views is {now}; the scanner's noise alone would leave {noise}."
    if diagnosis.verdict not in _VERDICTS_WITH_NAMES:
        return error
    named = [c for c in candidates if c.name in diagnosis.effects]
    is_one = diagnosis.verdict == "missing_effect"
    why = trends.get(diagnosis.effects[0])
    size = f"{_size(why, unit)} " if is_one and why is not None else ""
    left = [diagnosis.rms_if_added(c.cross_validation)[1] for c in named if c.cross_validation is not None]
    if not left:
        return f"{size}{error}"
    which = "this effect" if is_one else "one of these"
    then = " or ".join(dict.fromkeys(length_text(x, unit, 2) for x in left))
    worse = _worse_place(named[0].name, present, if_added.get(named[0].name), unit)
    return (
        f"{size}Adding {which} to the model should take the error on held-out views from {now} to {then}{worse}. "
        f"The scanner's noise alone would leave {noise}."
    )


def _worse_place(effect: str, present: DisagreementField | None, then: DisagreementField | None, unit: str) -> str:
    """Return a clause that the worst disagreement on the part would grow with an effect; empty if it would not.

    Args:
        present, then: disagreement now, and with the effect in the model; None without clouds.
    """
    if present is None or then is None:
        return ""
    before, after = (length_text(float(np.nanmax(field.overall)), unit, 2) for field in (present, then))
    grows = np.nanmax(then.overall) > np.nanmax(present.overall) and before != after
    return f", though {effect} takes the worst place of the part from {before} to {after}" if grows else ""


def _size(why: EffectTrend, unit: str) -> str:
    """Return the largest error that an effect makes, and how much of it the hand-eye imitates, as a sentence.

    Args:
        why: trend of the effect: `effect` as nature has it, `predicted` what remains beside the hand-eye.
        unit: length unit.
    """

    def in_words(value: float) -> str:
        return angle_text(value, 2) if why.value_unit == "rad" else length_text(value, unit, 2)

    largest, drawn = (float(np.abs(values).max()) for values in (why.effect, why.predicted))
    size = in_words(largest)
    # An event such as a slip displaces some views alike: these are counted.
    away = int(np.sum(np.abs(why.effect) > largest / 2))
    if why.follows == "view order" and away <= len(why.views) / 2:
        return f"{away} of {len(why.views)} views sit {size} away from the others."
    # What the plot shows is what the hand-eye leaves.
    taken = f", of which the hand-eye takes all but {in_words(drawn)}" if drawn < _MOSTLY * largest else ""
    follows = plain_covariate(why.follows).partition(":")[0]
    article = "" if follows == "time" or follows.startswith("the ") else "the "
    if np.ptp(why.effect) < _FLAT * largest:
        return f"{why.of.capitalize()} is off by {size}{taken}, whatever {article}{follows} is."
    goes_with = "" if follows == "view order" else f"; it goes with {article}{follows}"
    return f"{why.of.capitalize()} is off by up to {size}{taken}{goes_with}."


def certainty(diagnosis: Diagnosis) -> str:
    """Return in sentences how sure the finding is, by the verdict: chance, and the share of the other effects."""
    match diagnosis.verdict:
        case "missing_effect" | "cannot_tell" if not diagnosis.certain:
            odds = odds_text(diagnosis.log_odds_over_nothing)
            return f"Not very sure: the odds that it is more than chance are {odds}."
        case "missing_effect":
            named = next(c.ranked for c in diagnosis.candidates if c.name == diagnosis.effects[0])
            among = named.posterior / sum(c.ranked.posterior for c in diagnosis.candidates)
            share = "more than 99%" if among > 0.99 else f"{among:.0%}"
            evidence = f"Of {effects_tried(diagnosis)} known effects tried, it holds {share} of the evidence."
            nameless = " Its cause is less sure: a curve without a name would explain as much."
            return f"{chance_text(named.adjusted)} {evidence}{nameless if named.posterior <= 0.5 else ''}"
        case "cannot_tell":
            # Of the weaker one: which of them is the true one nobody knows.
            chance = chance_text(max(c.ranked.adjusted for c in diagnosis.candidates if c.name in diagnosis.effects))
            coincidence = f" {diagnosis.coincidence}." if diagnosis.coincidence else ""
            return f"{chance}{coincidence}{_decided_by(diagnosis)}"
        case "unknown_effect":
            clear = [x.p_value for x in diagnosis.depends_on if x.p_value < CLEAR_DEPENDENCE]
            if clear:
                return chance_text(min(clear))
            if repeating := reportable(diagnosis.repeating_errors, diagnosis.implausible):
                odds = odds_text(max(error.log_bayes_factor for error in repeating))
                return f"The odds that these errors repeat, and are no scatter, are {odds}."
            if diagnosis.notes:
                # An effect that was refuted is not said to come nearest.
                why = why_without_a_name(diagnosis)
                return f"{why[0].upper()}{why[1:]}: {diagnosis.notes[0]}."
    likeliest = next((c.ranked for c in diagnosis.candidates if c.ranked.score.observable), None)
    if likeliest is None:
        return "No known effect can be tested with these views."
    if likeliest.adjusted > _PLAIN_CHANCE:
        return "None of the effects tried shows."
    return f"Of the effects tried, {likeliest.name} comes nearest. {chance_text(likeliest.adjusted)}"


def chance_text(p: float) -> str:
    """Return a p-value as a sentence: in how many sessions chance alone would show as much."""
    if p < 1e-6:
        often = "less than one of a million sessions"
    elif p < 0.01:
        often = f"one of {float(f'{1 / p:.2g}'):,.0f} sessions"
    else:
        often = f"{p:.0%} of such sessions"
    return f"Chance alone would show as much in {often} (p = {p:.1g})."
