"""The hand-eye without its model: one rigid motion for whoever knows nothing of the effects.

Effects of base, arm and mount place every view a little elsewhere. A program that has the hand-eye alone gets right
what they do on the average over the views, if the hand-eye holds it; what they do from view to view it does not.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.model.forward import perturbed_frames
from stitch.model.model import ARM_PLACES, Model, Term
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.session.measurement import Measurement

# The mean of motions of a few mrad is exact to rounding after so many steps.
_STEPS = 3


@dataclass(frozen=True)
class HandEyeAlone:
    """The hand-eye at the mean of the effects over the views."""

    T_mount: Array  # (4, 4)
    covariance: Array  # (6, 6) of T·exp(ξ), scanner frame, rotation first; the spread of single views in it
    displacement: float  # length_unit, of the middle of what the views show, from where the model's hand-eye has it
    spread: float  # length_unit, rms, of the same from view to view


def hand_eye_alone(measurement: Measurement, model: Model) -> HandEyeAlone | None:
    """Return the hand-eye at the mean of the effects over the views; None without effects of base, arm or mount.

    What began at a view counts as it was in the end.
    """
    places = (*ARM_PLACES, "mount")
    terms = _as_in_the_end([term for term in model.terms if term.effect.place in places and not term.is_geometry])
    # Several scanners have no hand-eye in common.
    if not terms or measurement.views.scanners:
        return None
    left, right = perturbed_frames(measurement, terms)
    plain, _ = perturbed_frames(measurement, ())
    of_views = frames.inverse(plain) @ left @ model.T_mount @ right
    T_mount = model.T_mount
    for _ in range(_STEPS):
        T_mount = T_mount @ frames.exp(frames.log(frames.inverse(T_mount) @ of_views).mean(axis=0))
    apart = frames.log(frames.inverse(T_mount) @ of_views)
    middle = np.mean([points.mean(axis=0) for points in measurement.capture.point_sets if len(points)], axis=0)

    def moved(T: Array) -> Array:
        return np.linalg.norm(frames.transform(T, middle[None]) - frames.transform(T_mount, middle[None]), axis=-1)

    return HandEyeAlone(
        T_mount=T_mount,
        covariance=model.covariance + apart.T @ apart / len(apart),
        displacement=float(moved(model.T_mount)[0]),
        spread=float(np.sqrt(np.mean(moved(of_views) ** 2))),
    )


def _as_in_the_end(terms: Sequence[Term]) -> list[Term]:
    """Return the terms with events before the first view."""
    return [term.at(np.array([0.0 if p.discrete else p.value for p in term.parameters])) for term in terms]
