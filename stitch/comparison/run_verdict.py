"""The verdict of any run in plain words, and its light: of surfaces that overlap, or of labelled points alone."""

from collections.abc import Sequence

import numpy as np

from stitch.comparison.model_history import ModelHistory, effect_changes
from stitch.comparison.plain_verdict import ToleranceVerdict, check_tolerance, plain_verdict
from stitch.runs.doubt_headline import doubt_headline
from stitch.runs.run import Run
from stitch.units import length_text


def run_verdict(run: Run, history: ModelHistory | None) -> str:
    """For everybody: what is wrong with the session, how far its views disagree, and what the effects in use brought.

    Args:
        history: of this run; None without clouds.
    """
    return " ".join([*run.doubts, _agreement_sentence(run, history)])


def run_headline(run: Run, history: ModelHistory | None) -> str:
    """The same, of every doubt no more than its first clause: what it means and what to do stands elsewhere."""
    return shorten_doubts(run_verdict(run, history), run.doubts)


def shorten_doubts(verdict: str, doubts: Sequence[str]) -> str:
    """A verdict as result.json has it, of every doubt in it no more than its first clause."""
    for doubt in doubts:
        verdict = verdict.replace(doubt, doubt_headline(doubt), 1)
    return verdict


def _agreement_sentence(run: Run, history: ModelHistory | None) -> str:
    unit = run.session.length_unit
    if history is not None:
        return plain_verdict(history, unit)
    if run.targets is not None and run.targets.uninformative:
        return "Every target is seen in one view alone, so that the views cannot disagree."
    now, floor = (length_text(x, unit) for x in (run.residual_rms, run.noise_floor))
    rest = f"rms over all views; the sensor's noise alone would leave {floor}."
    changes = [effect_changes(run.ledger, i) for i in range(1, len(run.ledger))]
    added = [effect for effect in run.effects if f"+ {effect}" in ", ".join(changes).split(", ")]
    if not added:
        return f"The views see the targets {now} off their place, {rest}"
    before = length_text(run.ledger[0].residual_rms, unit)
    return f"Adding {' and '.join(added)} brought the targets from {before} to {now} off their place, {rest}"


def run_light(run: Run, history: ModelHistory | None, tolerance: float) -> ToleranceVerdict | None:
    """Whether 95 % of the part, or of what was seen of the targets, agree within a tolerance (length_unit).

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
