"""How points answer to the parameters of terms, by central differences about a model."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from stitch.frames import Array, Indices
from stitch.measurement.measurement import Measurement
from stitch.model.forward import point_correction, scan_points, target_correction
from stitch.model.jacobian import STEP, step_parameter
from stitch.model.model import Model
from stitch.model.term import Term


@dataclass(frozen=True)
class PointSlopes:
    """What must be added to measured points, per unit of each of P parameters: scanner frame."""

    measurement: Measurement
    steps: tuple["_ParameterStep", ...]

    @classmethod
    def about_model(cls, measurement: Measurement, model: Model, terms: Sequence[Term]) -> "PointSlopes":
        """About a model with each term in place of its own, or added at its values."""
        return cls(
            measurement, tuple(_parameter_step(model, term, i) for term in terms for i in range(len(term.parameters)))
        )

    def at(self, v: int, pose: Array, index: Indices | slice) -> Array:
        """(P, N, 3) for some points of view v, which stands at `pose` (4, 4) T_reference_scanner."""
        points, view = scan_points(self.measurement, v, index)
        return self._differences(lambda terms: point_correction(terms, points, view, pose, steps=1))

    def at_targets(self, poses: Array) -> Array:
        """(P, V, S, 3) for the labelled points of all views."""
        return self._differences(lambda terms: target_correction(self.measurement, terms, poses))

    def _differences(self, moved: Callable[[Sequence[Term]], Array]) -> Array:
        if not self.steps:
            return moved(())[None][:0]
        return np.array([(moved(s.up) - moved(s.down)) / s.width for s in self.steps])


@dataclass(frozen=True)
class _ParameterStep:
    """The effects of a model with one parameter larger and smaller, and how far these are apart."""

    up: tuple[Term, ...]
    down: tuple[Term, ...]
    width: float


def _parameter_step(model: Model, term: Term, i: int) -> _ParameterStep:
    parameter = term.parameters[i]
    # The view of an event is tried, never fitted: nothing answers to it.
    size = 0.0 if parameter.discrete else STEP * parameter.typical
    up, down = (model.with_term(t).terms for t in step_parameter(term, i, size))
    return _ParameterStep(up, down, 2 * size or 1.0)
