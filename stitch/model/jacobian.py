"""How poses and points answer to the parameters of a term, by central differences about a model."""

from collections.abc import Callable, Sequence

import numpy as np

from stitch import frames
from stitch.frames import Array, Indices
from stitch.measurement.measurement import Measurement
from stitch.model.forward import perturbed_frames, shift, shift_targets
from stitch.model.model import Model
from stitch.model.term import Term

# Step as a share of the plausible size: errors of third order stay far below the noise. A time constant is stepped
# less, since the effect is not linear in it.
_STEP, _STEP_GRIDDED = 0.1, 0.005


def twists(measurement: Measurement, model: Model, term: Term, centre: Array) -> Array:
    """(P, V, 6) left twists of the views about `centre`, reference frame, per unit of each parameter of `term`.

    Central differences about the model with `term` in place of its own, or added at its values.
    """
    to_centre = frames.make(np.eye(3), -centre)
    out = []
    for i, parameter in enumerate(term.parameters):
        if parameter.discrete:
            out.append(np.zeros((measurement.views.count, 6)))
            continue
        size = (_STEP_GRIDDED if parameter.grid else _STEP) * parameter.typical
        both = []
        for stepped in _stepped(term, i, size):
            left, right = perturbed_frames(measurement, model.with_term(stepped).terms)
            both.append(to_centre @ left @ model.T_mount @ right)
        out.append(frames.log(both[0] @ frames.inverse(both[1])) / (2 * size))
    return np.array(out).reshape(len(term.parameters), measurement.views.count, 6)


def shifts(measurement: Measurement, model: Model, term: Term, *, v: int, pose: Array, index: Indices | slice) -> Array:
    """(P, N, 3) slopes of `shift` for each parameter of `term`, scanner frame."""
    return _slopes(model, term, lambda terms: shift(measurement, terms, v, pose, index))


def target_shifts(measurement: Measurement, model: Model, term: Term, poses: Array) -> Array:
    """(P, V, S, 3) slopes of `shift_targets` for each parameter of `term`, sensor frame."""
    return _slopes(model, term, lambda terms: shift_targets(measurement, terms, poses))


def _slopes(model: Model, term: Term, moved: Callable[[Sequence[Term]], Array]) -> Array:
    """Central differences of `moved` in each parameter of `term`."""
    out = []
    for i, parameter in enumerate(term.parameters):
        if parameter.discrete:
            out.append(np.zeros_like(moved(model.with_term(term).terms)))
            continue
        both = [moved(model.with_term(t).terms) for t in _stepped(term, i, _STEP * parameter.typical)]
        out.append((both[0] - both[1]) / (2 * _STEP * parameter.typical))
    return np.array(out)


def _stepped(term: Term, i: int, size: float) -> tuple[Term, Term]:
    """The term with one parameter larger and smaller by a step."""
    step = size * np.eye(len(term.parameters))[i]
    return term.at(term.values + step), term.at(term.values - step)
