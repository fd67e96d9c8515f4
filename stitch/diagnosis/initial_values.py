"""Values to begin a fit with: those that the views suggest at first sight."""

from collections.abc import Callable, Sequence

from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.score import score
from stitch.effects.contract import Effect
from stitch.measurement.measurement import Measurement
from stitch.model.term import Term, term_of
from stitch.observations.linear_model import LinearModel


def initial_terms(
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
    return [_suggested(linear, term) if term.gridded.any() else term for term in zero]


def _suggested(linear: LinearModel, zero: Term) -> Term:
    candidate = candidate_of(linear, zero.effect)
    if candidate is None:
        return zero
    best = score(linear, candidate)
    return best.form.at(best.values)
