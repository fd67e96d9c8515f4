"""The hand-eye without its model: one rigid motion for whoever knows nothing of the effects.

Effects of base, arm and mount place every view a little elsewhere. A program that has the hand-eye alone gets right
what they do on the average over the views, if the hand-eye holds it; what they do from view to view it does not.
"""

from dataclasses import dataclass

import numpy as np

from stitch.model.forward import perturbed_frames
from stitch.model.model import ARM_PLACES, Model
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.session.measurement import Measurement

# The mean of motions of a few mrad is exact to rounding after so many steps.
_STEPS = 3


@dataclass(frozen=True)
class HandEyeAlone:
    """The single hand-eye that comes closest to a model with effects, averaged over the views."""

    T_mount: Array  # (4, 4) maps scanner to mount
    covariance: Array  # (6, 6) of T·exp(ξ), scanner frame, rotation first; the spread from view to view included
    displacement: float  # length_unit: how far it puts the middle of the points from where the model's T_mount does
    spread: float  # length_unit: rms over views of the distance of that middle from where the model's effects put it


def hand_eye_alone(measurement: Measurement, model: Model) -> HandEyeAlone | None:
    """Return the mean over the views of the hand-eye that each would need without effects of base, arm and mount.

    The mean on SE(3), by repeated averages of logarithms. Events count as they are after the last view. None where the
    model has no such effects, and with several scanners, which have no hand-eye in common.
    """
    places = (*ARM_PLACES, "mount")
    used = [term for term in model.terms if term.effect.place in places and not term.is_geometry]
    # As after the last view: an event counts as if it were before the first.
    terms = [term.at(np.array([0.0 if p.discrete else p.value for p in term.parameters])) for term in used]
    if not terms or measurement.views.scanners:
        return None
    left, right = perturbed_frames(measurement, terms)
    plain, _ = perturbed_frames(measurement, ())
    # plain · T = left · T_mount · right for the hand-eye T that a view needs without effects.
    of_views = frames.inverse(plain) @ left @ model.T_mount @ right
    T_mount = model.T_mount
    for _ in range(_STEPS):
        T_mount = T_mount @ frames.exp(frames.log(frames.inverse(T_mount) @ of_views).mean(axis=0))
    deviations = frames.log(frames.inverse(T_mount) @ of_views)
    middle = np.mean([points.mean(axis=0) for points in measurement.capture.point_sets if len(points)], axis=0)

    def moved(T: Array) -> Array:
        """Return how far hand-eyes T (..., 4, 4) put the middle of the points from where the mean puts it."""
        return np.linalg.norm(frames.transform(T, middle[None]) - frames.transform(T_mount, middle[None]), axis=-1)

    return HandEyeAlone(
        T_mount=T_mount,
        covariance=model.covariance + deviations.T @ deviations / len(deviations),
        displacement=float(moved(model.T_mount)[0]),
        spread=float(np.sqrt(np.mean(moved(of_views) ** 2))),
    )
