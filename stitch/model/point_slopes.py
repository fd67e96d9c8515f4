"""How points answer to the parameters of terms, by central differences about a model."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from stitch.frames import Array, Indices
from stitch.measurement.measurement import Measurement
from stitch.model.forward import seen_points, shift_targets, undone
from stitch.model.jacobian import STEP, stepped
from stitch.model.model import Model
from stitch.model.term import Term


@dataclass(frozen=True)
class PointSlopes:
    """What must be added to measured points, per unit of each of P parameters: scanner frame."""

    measurement: Measurement
    steps: tuple["_Step", ...]

    @classmethod
    def of(cls, measurement: Measurement, model: Model, terms: Sequence[Term]) -> "PointSlopes":
        """About a model with each term in place of its own, or added at its values."""
        return cls(measurement, tuple(_step(model, term, i) for term in terms for i in range(len(term.parameters))))

    def at(self, v: int, pose: Array, index: Indices | slice) -> Array:
        """(P, N, 3) for some points of view v, which stands at `pose` (4, 4) T_reference_scanner."""
        points, view = seen_points(self.measurement, v, index)
        return self._differences(lambda terms: undone(terms, points, view, pose, steps=1))

    def at_targets(self, poses: Array) -> Array:
        """(P, V, S, 3) for the labelled points of all views."""
        return self._differences(lambda terms: shift_targets(self.measurement, terms, poses))

    def _differences(self, moved: Callable[[Sequence[Term]], Array]) -> Array:
        if not self.steps:
            return moved(())[None][:0]
        return np.array([(moved(s.up) - moved(s.down)) / s.apart for s in self.steps])


@dataclass(frozen=True)
class _Step:
    """The effects of a model with one parameter larger and smaller, and how far these are apart."""

    up: tuple[Term, ...]
    down: tuple[Term, ...]
    apart: float


def _step(model: Model, term: Term, i: int) -> _Step:
    parameter = term.parameters[i]
    # The view of an event is tried, never fitted: nothing answers to it.
    size = 0.0 if parameter.discrete else STEP * parameter.typical
    up, down = (model.with_term(t).terms for t in stepped(term, i, size))
    return _Step(up, down, 2 * size or 1.0)
