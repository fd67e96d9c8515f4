"""How poses and points answer to parameters of effects, by central differences."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from stitch import frames
from stitch.frames import Array, Indices
from stitch.measurement.measurement import Measurement, Term
from stitch.model.forward import placed, shift, shift_targets


def twists(measurement: Measurement, terms: Sequence[Term], term: Term, T_mount: Array, centre: Array) -> Array:
    """(P, V, 6) left twists of the views about `centre`, reference frame, per unit of each parameter of `term`.

    Central differences about `terms` with the values of `term` in place of its own, or added at its values.
    """
    others = [t for t in terms if t.effect.name != term.effect.name]
    to_centre = frames.make(np.eye(3), -centre)
    out = []
    for i, parameter in enumerate(measurement.parameters(term.effect)):
        if parameter.discrete:
            out.append(np.zeros((measurement.views.count, 6)))
            continue
        size = (0.005 if parameter.grid else 0.1) * parameter.typical
        step = size * np.eye(len(term.values))[i]
        both = []
        for sign in (1, -1):
            left, right = placed(measurement, [*others, replace(term, values=term.values + sign * step)])
            both.append(to_centre @ left @ T_mount @ right)
        out.append(frames.log(both[0] @ frames.inverse(both[1])) / (2 * size))
    return np.array(out).reshape(len(term.values), measurement.views.count, 6)


def shifts(
    measurement: Measurement, terms: Sequence[Term], term: Term, v: int, pose: Array, index: Indices | slice
) -> Array:
    """(P, N, 3) slopes of `shift` for each parameter of `term`, scanner frame."""
    return _slopes(measurement, terms, term, lambda with_step: shift(measurement, with_step, v, pose, index))


def target_shifts(measurement: Measurement, terms: Sequence[Term], term: Term, poses: Array) -> Array:
    """(P, V, S, 3) slopes of `shift_targets` for each parameter of `term`, sensor frame."""
    return _slopes(measurement, terms, term, lambda with_step: shift_targets(measurement, with_step, poses))


def _slopes(
    measurement: Measurement, terms: Sequence[Term], term: Term, moved: Callable[[Sequence[Term]], Array]
) -> Array:
    """Central differences of `moved` in each parameter of `term`."""
    others = [t for t in terms if t.effect.name != term.effect.name]
    out = []
    for i, parameter in enumerate(measurement.parameters(term.effect)):
        if parameter.discrete:
            out.append(np.zeros_like(moved([*others, term])))
            continue
        step = 0.1 * parameter.typical * np.eye(len(term.values))[i]
        both = [moved([*others, replace(term, values=term.values + s * step)]) for s in (1, -1)]
        out.append((both[0] - both[1]) / (0.2 * parameter.typical))
    return np.array(out)
