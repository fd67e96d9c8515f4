"""Values to begin a fit with: those that the views suggest at first sight."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.score import score
from stitch.effects.contract import Effect
from stitch.effects.in_session import find_effect
from stitch.measurement.measurement import Measurement
from stitch.measurement.session import Session
from stitch.model.bound import bind_to_session
from stitch.model.model import Model
from stitch.model.model_toml import ModelFile
from stitch.model.term import Term, term_of
from stitch.observations.linear_model import LinearModel
from stitch.stages.course import linearise


def start_with_effects(
    session: Session, effects: Sequence[str], arm: ModelFile | None, measurement: Measurement, model: Model, gate: float
) -> Model:
    """The model with another run's arm in place of its effects, if any, and with further effects by name.

    Args:
        gate: largest distance between partners where the session has scans, length_unit.
    """
    if arm:
        known_arm = bind_to_session(arm, measurement)
        model = replace(model, terms=known_arm.terms, effects_covariance=known_arm.effects_covariance)
    linear = partial(linearise, session, measurement, model, gate)
    return model.with_terms(
        [*model.terms, *_initial_terms(measurement, [find_effect(name) for name in effects], linear)]
    )


def _initial_terms(
    measurement: Measurement, effects: Sequence[Effect], linear_now: Callable[[], LinearModel]
) -> list[Term]:
    """A term for each effect; events and time constants at the value that explains most.

    Args:
        linear_now: the linear model before these effects, asked only where one has an event or a time constant.
    """
    zero = [term_of(measurement, effect) for effect in effects]
    if not any(term.gridded.any() for term in zero):
        return zero
    linear = linear_now()
    return [_suggest_values(linear, term) if term.gridded.any() else term for term in zero]


def _suggest_values(linear: LinearModel, zero: Term) -> Term:
    candidate = candidate_of(linear, zero.effect)
    if candidate is None:
        return zero
    best = score(linear, candidate)
    return best.form.at(best.values)
