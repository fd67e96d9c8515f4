"""The verdict of any run in plain words, and its light: of surfaces that overlap, or of labelled points alone."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from stitch.numerics.units import length_text
from stitch.output.comparison.disagreement_field import DisagreementField
from stitch.output.comparison.model_history import ModelHistory, effect_changes
from stitch.run_data import RunData, doubt_headline

# What a run found in one sentence that everybody on the shop floor understands, and how it stands to a tolerance.

# Expanded uncertainty: a place is within the tolerance if its distance and two standard errors are (ISO 14253-1).
_COVERAGE = 2.0
Light = Literal["good", "check", "bad"]


class ToleranceVerdict(NamedTuple):
    """How the views agree against a tolerance."""

    light: Light  # good: model and stitched cloud; check: the stitched cloud alone; bad: neither
    sentence: str


def plain_verdict(history: ModelHistory, length_unit: str) -> str:
    """Return how far the views disagree on the part, what effects brought, and what the stitched cloud keeps."""
    models = history.models
    told = (length_text(s.field.mean_abs, length_unit, 2) for s in (models[0], models[-1], history.steps[-1]))
    before, now, left = told
    rest = f"In the stitched cloud, where each view has its own correction, {left} remain."
    changes = _added_effects([step.name for step in models[1:]])
    if not changes:
        return f"On average over the part, the views disagree by {now}. {rest}"
    return (
        f"Adding {' and '.join(changes)} brought the views from {before} to {now} of each other, on average over the "
        f"part. {rest}"
    )


def _added_effects(changes: Sequence[str]) -> list[str]:
    """Effects that the steps of a history brought and none of them took away again: + a, then − a, + b brought b."""
    left: list[str] = []
    for change in ", ".join(changes).split(", "):
        name = change[2:]
        if change.startswith("+ "):
            left.append(name)
        elif change.startswith("− ") and name in left:
            left.remove(name)
    return left


def check_tolerance(history: ModelHistory, tolerance: float, length_unit: str) -> ToleranceVerdict:
    """Return whether 95 % of the part agree within a tolerance (length_unit), stitched and under the model."""
    model, cloud = (_field_reach(s.field) for s in (history.models[-1], history.steps[-1]))
    allowed = length_text(tolerance, length_unit, 4)
    told = f"{length_text(model, length_unit)} under the model, {length_text(cloud, length_unit)} in the stitched cloud"
    if cloud > tolerance:
        return ToleranceVerdict("bad", f"Not within {allowed}: 95 % of the part agree to {told}.")
    if model > tolerance:
        return ToleranceVerdict(
            "check",
            f"The stitched cloud is within {allowed}, the model alone is not: 95 % of the part agree to {told}. "
            "Do not use the model for another part yet.",
        )
    return ToleranceVerdict("good", f"Within {allowed}: 95 % of the part agree to {told}.")


def _field_reach(field: DisagreementField) -> float:
    """Distance and expanded uncertainty that 95 % of the part stay below."""
    return field.quantile() + _COVERAGE * float(np.nanmedian(field.sigma))


def run_verdict(run: RunData, history: ModelHistory | None) -> str:
    """Return for everybody what is wrong with the session, how far its views disagree, and what effects brought.

    Args:
        history: of this run; None without clouds.
    """
    return " ".join([*run.doubts, _agreement_sentence(run, history)])


def run_headline(run: RunData, history: ModelHistory | None) -> str:
    """Return the same, of every doubt no more than its first clause: what it means and what to do stands elsewhere."""
    return shorten_doubts(run_verdict(run, history), run.doubts)


def shorten_doubts(verdict: str, doubts: Sequence[str]) -> str:
    """Return a verdict as result.json has it, of every doubt in it no more than its first clause."""
    for doubt in doubts:
        verdict = verdict.replace(doubt, doubt_headline(doubt), 1)
    return verdict


def _agreement_sentence(run: RunData, history: ModelHistory | None) -> str:
    unit = run.session.length_unit
    if history is not None:
        return plain_verdict(history, unit)
    if run.targets is not None and run.targets.uninformative:
        return "Each target is seen in one view alone, so the views cannot disagree."
    now, floor = (length_text(x, unit) for x in (run.residual_rms, run.noise_floor))
    rest = f"rms over all views. The sensor's noise alone would leave {floor}."
    changes = [effect_changes(run.ledger, i) for i in range(1, len(run.ledger))]
    added = [effect for effect in run.effects if f"+ {effect}" in ", ".join(changes).split(", ")]
    if not added:
        return f"The targets lie {now} off their place, {rest}"
    before = length_text(run.ledger[0].residual_rms, unit)
    return f"Adding {' and '.join(added)} brought the targets from {before} to {now} off their place, {rest}"


def run_light(run: RunData, history: ModelHistory | None, tolerance: float) -> ToleranceVerdict | None:
    """Return whether 95 % of the part, or of what was seen of the targets, agree within a tolerance (length_unit).

    None where neither surfaces nor targets say anything of it.
    """
    unit = run.session.length_unit
    if history is not None:
        return check_tolerance(history, tolerance, unit)
    if run.targets is None or run.targets.uninformative:
        return None
    rows = run.targets.rows
    reach = float(np.nanquantile(rows.distances(rows.residual), 0.95))
    allowed, told = length_text(tolerance, unit, 4), length_text(reach, unit)
    words = f"{allowed}: 95 % of what was seen of the targets lies within {told} of their place under the model."
    return (
        ToleranceVerdict("good", f"Within {words}")
        if reach <= tolerance
        else ToleranceVerdict("bad", f"Not within {words}")
    )
