"""What joints and links of any arm do a little wrong: effects of the library, and the twists of the views by them."""

from collections.abc import Sequence

import numpy as np

from stitch.effects.contract import EFFECTS, Effect
from stitch.effects.in_session import missing_need
from stitch.frames import Array
from stitch.measurement.measurement import Measurement
from stitch.model.jacobian import pose_derivatives
from stitch.model.model import Model
from stitch.model.term import Term, term_of

# What every joint does anew in every view, and how much of it is usual, as a share of a plausible offset: as much as
# the flange turns.
JOINT_SCATTER, USUAL_JOINT_SCATTER = "joint scatter", 0.02
_OFFSET = "joint_offset"
# What every arm does wrong: numbers for every joint that its angles or its torques alone decide.
_ARM_COVARIATES = ("joints", "torque")
EFFECT_FAMILY = {"gear_eccentricity": "gears", "gear_harmonic": "gears", "backlash": "play", "settling": "play"}


def arm_effects(measurements: Sequence[Measurement]) -> list[Effect]:
    """What the library knows of every joint and link, as far as all sessions can have it."""
    possible = [
        e
        for e in EFFECTS.values()
        if e.tier == "physical" and e.place in ("robot", "links") and e.needs and set(e.needs) <= set(_ARM_COVARIATES)
    ]
    per_joint = [e for e in possible if all(spec.kind in ("joint", "torque") for spec in e.specs.values())]
    return [e for e in per_joint if not any(missing_need(m, e) for m in measurements)]


def group_by_family(effects: Sequence[Effect]) -> dict[str, list[Effect]]:
    """Effects of one cause share a size."""
    out: dict[str, list[Effect]] = {}
    for e in effects:
        out.setdefault(EFFECT_FAMILY.get(e.name, e.name), []).append(e)
    return out


def effect_twists(measurement: Measurement, model: Model, centre: Array, effects: Sequence[Effect]) -> Array:
    """(6V, P) twists of the views for plausible sizes of all parameters of some effects."""
    in_use: dict[str, Term] = {term.name: term for term in model.terms}
    terms = [in_use.get(effect.name) or term_of(measurement, effect) for effect in effects]
    found = zip(terms, pose_derivatives(measurement, model, terms, centre), strict=True)
    return np.hstack([moved.reshape(len(moved), -1).T * term.typical for term, moved in found])


def joint_offset_twists(measurement: Measurement, model: Model, centre: Array) -> Array | None:
    """(6V, n) twists of the views for a plausible offset of every joint; None where no joints are known."""
    if not measurement.views.has("joints") or _OFFSET not in EFFECTS:
        return None
    return effect_twists(measurement, model, centre, [EFFECTS[_OFFSET]])
