"""What a run found in one sentence that everybody on the shop floor understands, and how it stands to a tolerance."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from stitch.comparison.disagreement_field import DisagreementField
from stitch.comparison.model_history import ModelHistory
from stitch.units import length_text

# Expanded uncertainty: a place is within the tolerance if its distance and two standard errors are (ISO 14253-1).
_COVERAGE = 2.0
Light = Literal["good", "check", "bad"]


class ToleranceVerdict(NamedTuple):
    """How the views agree against a tolerance."""

    light: Light  # good: model and stitched cloud; check: the stitched cloud alone; bad: neither
    sentence: str


def plain_verdict(history: ModelHistory, length_unit: str) -> str:
    """How far the views disagree on the part, what the effects in use brought, what is left in the stitched cloud."""
    models = history.models
    told = (length_text(s.field.mean_abs, length_unit) for s in (models[0], models[-1], history.steps[-1]))
    before, now, left = told
    rest = f"with each view moved by its own correction, {left} remain in the stitched cloud."
    changes = _added_effects([step.name for step in models[1:]])
    if not changes:
        return f"On average over the part, the views disagree by {now}; {rest}"
    return (
        f"Adding {' and '.join(changes)} brought the views from {before} to {now} of each other, on average over the "
        f"part; {rest}"
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
    """Whether 95 % of the part agree within a tolerance (length_unit), in the stitched cloud and under the model."""
    model, cloud = (_field_reach(s.field) for s in (history.models[-1], history.steps[-1]))
    allowed = length_text(tolerance, length_unit, 4)
    told = f"{length_text(model, length_unit)} under the model, {length_text(cloud, length_unit)} in the stitched cloud"
    if cloud > tolerance:
        return ToleranceVerdict("bad", f"Not within {allowed}: 95 % of the part agree to {told}.")
    if model > tolerance:
        return ToleranceVerdict(
            "check",
            f"The stitched cloud is within {allowed}, the model alone is not: 95 % of the part agree to {told}; "
            "do not carry the model to another part yet.",
        )
    return ToleranceVerdict("good", f"Within {allowed}: 95 % of the part agree to {told}.")


def _field_reach(field: DisagreementField) -> float:
    """Distance and expanded uncertainty that 95 % of the part stay below."""
    return field.quantile() + _COVERAGE * float(np.nanmedian(field.sigma))
