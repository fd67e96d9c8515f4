"""When in a session the flange errs that follows a course of time without a name: what it does then, with bands."""

from dataclasses import dataclass

import numpy as np

from stitch.diagnosis.unknown.time_laws import TimeLaw
from stitch.frames import Array
from stitch.observations.flange_errors import time_in_steps, usual_time_step, usual_twist
from stitch.statistics.variance_components import at_variances

_PLACES = 6  # from one view to the next
# Turning and moving have one size in the law, and that of the other would shrink what is said of either: a prior of so
# many sizes is as good as none, and keeps the unseen finite.
_FREE = 30.0
ROTATION_PART, TRANSLATION_PART = slice(3), slice(3, 6)


@dataclass(frozen=True)
class TimeCurve:
    """How far the flange turns and moves in time, in its own frame, beside where it stands otherwise."""

    steps: Array  # (G,) times in usual steps from one view to the next
    seconds: float  # that a step takes; 0 where no time is stated
    error: Array  # (G, 6) rotation (rad), then translation (length_unit)
    sigma: Array  # (G, 6)

    def largest(self, of: slice) -> tuple[int, float, float]:
        """Where the rotation, `TURNED`, or the translation, `MOVED`, is largest, how large it is there, its sigma."""
        size = np.linalg.norm(self.error[:, of], axis=1)
        k = int(size.argmax())
        along = self.error[k, of] / max(float(size[k]), 1e-300)
        return k, float(size[k]), float(np.linalg.norm(along * self.sigma[k, of]))


def time_curve(law: TimeLaw) -> TimeCurve:
    """The course of a law of the flange in time, and its sigma: a free fit at the fitted sizes of all other errors."""
    linear = law.base
    time = np.sort(time_in_steps(linear.measurement))
    places = np.linspace(0, len(time) - 1, _PLACES * (len(time) - 1) + 1)
    steps = np.interp(places, np.arange(len(time)), time)
    shapes, found = law.course.course(steps), law.fitted
    G, wide = linear.in_blocks(found.columns), np.full(found.columns.shape[1], _FREE * found.size)
    fit = at_variances(linear.mixed, found.fit.variances, G, wide)
    # Of every motion of the flange one coefficient for each shape.
    coefficients = fit.mean[-len(wide) :].reshape(6, -1)
    covariance = fit.covariance[-len(wide) :, -len(wide) :].reshape(*coefficients.shape, *coefficients.shape)
    variance = np.einsum("gr,prps,gs->gp", shapes, covariance, shapes)
    # Where the flange carries the part, the views move the other way.
    unit = usual_twist(linear.measurement.length_unit)
    way = -unit if linear.measurement.eye_to_hand else unit
    return TimeCurve(
        steps=steps,
        seconds=usual_time_step(linear.measurement),
        error=way * (shapes @ coefficients.T),
        sigma=unit * np.sqrt(np.maximum(variance, 0.0)),
    )
