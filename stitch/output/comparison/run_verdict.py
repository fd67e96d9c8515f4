"""The verdict of any run in plain words, and its light: of surfaces that overlap, or of labelled points alone."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from stitch.numerics.frames import Array
from stitch.numerics.units import length_text
from stitch.output.comparison.model_history import ModelHistory, ModelStep, effect_changes
from stitch.run_data import RunData, doubt_headline

# Expanded uncertainty: a place is within the tolerance if its distance and two standard errors are (ISO 14253-1).
_COVERAGE = 2.0
# Share of a predicted gain from which on a prediction was another one.
_DIFFERS = 0.1
Light = Literal["good", "check", "bad"]


class ToleranceVerdict(NamedTuple):
    """How the views agree against a tolerance."""

    light: Light  # good: model and stitched cloud; check: the stitched cloud alone, or in doubt; bad: neither
    sentence: str


def run_headline(run: RunData, history: ModelHistory | None) -> str:
    """Return the verdict, of every doubt no more than its first clause: what to do about it stands elsewhere."""
    return shorten_doubts(run_verdict(run, history), run.doubts)


def shorten_doubts(verdict: str, doubts: Sequence[str]) -> str:
    """Return a verdict as result.json has it, of every doubt in it no more than its first clause."""
    for doubt in doubts:
        verdict = verdict.replace(doubt, doubt_headline(doubt), 1)
    return verdict


def run_verdict(run: RunData, history: ModelHistory | None) -> str:
    """Return the verdict on a run in plain sentences: doubts, disagreement of the views, what effects brought.

    Args:
        history: of this run; None without clouds.
    """
    unit = run.session.length_unit
    agreement = _target_agreement(run) if history is None else plain_verdict(history, unit)
    return " ".join(filter(None, [*run.doubts, agreement, prediction_text(run)]))


def prediction_text(run: RunData) -> str:
    """Return a sentence on the error predicted for the last change of the model, and the one that came of it.

    They count as different if they differ by more than a tenth of the predicted gain. "" where nothing was predicted.
    """
    if len(run.ledger) < 2 or not np.isfinite(run.ledger[-1].predicted):
        return ""
    before, predicted, came = run.ledger[-2].heldout_rms, run.ledger[-1].predicted, run.ledger[-1].heldout_rms
    unit = run.session.length_unit
    texts = [length_text(value, unit, 2) for value in (before, predicted, came)]
    tenth = _DIFFERS * abs(before - predicted)
    outcome = ", as predicted"
    if came > predicted + tenth:
        outcome = ": less was gained than predicted"
    elif came < predicted - tenth:
        outcome = ": more was gained than predicted"
    return f"Predicted on held-out views: {texts[0]} to {texts[1]}; it came to {texts[2]}{outcome}."


def plain_verdict(history: ModelHistory, length_unit: str) -> str:
    """Return sentences on the views' mean disagreement: with and without effects, and after register."""

    def mean_text(step: ModelStep) -> str:
        return length_text(step.field.mean_abs, length_unit, 2)

    first, last = history.models[0], history.models[-1]
    remain = mean_text(history.steps[-1])
    rest = f"In the stitched cloud, where each view has its own correction, {remain} remain."
    effects = _added_effects([step.name for step in history.models[1:]])
    if not effects:
        return f"On average over the part, the views disagree by {mean_text(last)}. {rest}"
    return (
        f"Adding {' and '.join(effects)} brought the views from {mean_text(first)} to {mean_text(last)} of each other, "
        f"on average over the part. {rest}"
    )


def _added_effects(changes: Sequence[str]) -> list[str]:
    """Return the effects that were added and not dropped again, by texts of changes: "+ a", "− a, + b" gives b."""
    effects: list[str] = []
    for change in ", ".join(changes).split(", "):
        name = change[2:]
        if change.startswith("+ "):
            effects.append(name)
        elif change.startswith("− ") and name in effects:
            effects.remove(name)
    return effects


def _target_agreement(run: RunData) -> str:
    """Return a sentence on the rms distance of labelled points from their positions, and what effects brought."""
    unit = run.session.length_unit
    if run.targets is not None and run.targets.uninformative:
        return "Each target is seen in one view alone, so the views cannot disagree."
    now = length_text(run.residual_rms, unit)
    noise = length_text(run.noise_floor, unit)
    rest = f"rms over all views. The sensor's noise alone would leave {noise}."
    changes = ", ".join(effect_changes(run.ledger, i) for i in range(1, len(run.ledger))).split(", ")
    added = [effect for effect in run.effects if f"+ {effect}" in changes]
    if not added:
        return f"The targets lie {now} off their place, {rest}"
    before = length_text(run.ledger[0].residual_rms, unit)
    return f"Adding {' and '.join(added)} brought the targets from {before} to {now} off their place, {rest}"


def run_light(run: RunData, history: ModelHistory | None, tolerance: float) -> ToleranceVerdict | None:
    """Return whether 95 % of what several views see of the part, or of the targets, agree within a tolerance.

    None where neither surfaces nor targets are seen by several views. Beside a doubt about the session the light is
    "check" at best: views that are off together, or that hardly overlap, agree as well.

    Args:
        tolerance: length_unit.
    """
    unit = run.session.length_unit
    if history is not None:
        found = check_tolerance(history, tolerance, unit)
    elif run.targets is not None and not run.targets.uninformative:
        found = _check_targets(run.targets.distances, tolerance, unit)
    else:
        return None
    if not run.doubts or found.light == "bad":
        return found
    return ToleranceVerdict("check", f"In doubt, though views agree. {found.sentence}")


def _check_targets(distances: Array, tolerance: float, length_unit: str) -> ToleranceVerdict:
    """Return whether 95 % of the sightings of targets lie within a tolerance of their place: "good" or "bad".

    Args:
        distances: of the sightings from the places of their targets, NaN where there is none; length_unit.
    """
    reach = float(np.nanquantile(distances, 0.95))
    targets = f"95 % of what was seen of the targets lies within {length_text(reach, length_unit)} of their place"
    sentence = f"{length_text(tolerance, length_unit, 4)}: {targets} under the model."
    if reach > tolerance:
        return ToleranceVerdict("bad", f"Not within {sentence}")
    return ToleranceVerdict("good", f"Within {sentence}")


def check_tolerance(history: ModelHistory, tolerance: float, length_unit: str) -> ToleranceVerdict:
    """Return whether 95 % of what views share of the part agree within a tolerance: "good", "check" or "bad".

    good: under the model alone; check: only in the stitched cloud, with a correction of each view; bad: neither.
    """
    model = _reach(history.models[-1])
    cloud = _reach(history.steps[-1])
    allowed = length_text(tolerance, length_unit, 4)
    part = (
        f"95 % of what several views see of the part agree to {length_text(model, length_unit)} under the model, "
        f"{length_text(cloud, length_unit)} in the stitched cloud."
    )
    if cloud > tolerance:
        return ToleranceVerdict("bad", f"Not within {allowed}: {part}")
    if model > tolerance:
        sentence = f"The stitched cloud is within {allowed}, the model alone is not: {part}"
        return ToleranceVerdict("check", f"{sentence} Do not use the model for another part yet.")
    return ToleranceVerdict("good", f"Within {allowed}: {part}")


def _reach(step: ModelStep) -> float:
    """Return the distance and expanded uncertainty that 95 % of the part stay below, where several views see it."""
    return step.field.quantile() + _COVERAGE * float(np.nanmedian(step.field.sigma))
