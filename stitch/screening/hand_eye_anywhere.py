"""How well a hand-eye is known anywhere the arm reaches: with usual sizes of what these views cannot show.

A covariance of the hand-eye holds for a complete model at the poses measured: errors of arm and scanner are in it, an
effect of the mount, the part or the scanner's points that nobody added is not. Such an effect is zero give or take its
usual size, less what the views say of it. Parameters p with prior N(0, 1) in usual sizes and columns J have, the
hand-eye free, the posterior covariance (1 + JᵀPJ)⁻¹, P = C⁻¹ − C⁻¹A(AᵀC⁻¹A)⁻¹AᵀC⁻¹. What is left moves the hand-eye
by −GJp, G = (AᵀC⁻¹A)⁻¹AᵀC⁻¹: what the views would show adds next to nothing, what they would not, all of it.
"""

import numpy as np

from stitch.model.model import Model
from stitch.numerics.frames import Array
from stitch.numerics.least_squares import equilibrated
from stitch.observations.surfaces.hand_eye_fit import Repeatability, pose_covariance
from stitch.observations.surfaces.view_poses import UnconstrainedPoses
from stitch.screening.view_model import UsualEffects, thin_correspondences, view_model
from stitch.session.measurement import Measurement

# Of more views the dense matrices take seconds, and what they cannot show is little.
_MOST_VIEWS = 150
# Places whose errors the covariance of the hand-eye holds already.
_COUNTED = ("robot", "links")
# Directions of the hand-eye that views show less than this share of the clearest stay as they are.
_SEEN = 1e-9


def hand_eye_sigma_anywhere(
    measurement: Measurement, model: Model, unconstrained: UnconstrainedPoses, scatter: Repeatability
) -> Array | None:
    """Return sigma (6,) of the hand-eye's ξ, T_mount·exp(ξ), rad and length_unit, with effects that nobody added.

    To the model's covariance is added G J (1 + JᵀPJ)⁻¹ Jᵀ Gᵀ: what effects of mount, part and scanner may still do
    after the views were seen (symbols at the head of this file). None for more than `_MOST_VIEWS` views.

    Args:
        model: with the covariance of its hand-eye; effects in use are in that already.
        unconstrained: the views moved by their overlaps alone.
        scatter: of the flange's poses, as the overlaps show it.
    """
    capture = measurement.capture
    if len(unconstrained.poses) > _MOST_VIEWS:
        return None
    reduced = view_model(capture, model.T_mount, unconstrained).reduced
    usual = UsualEffects(measurement, model).by_place(thin_correspondences(unconstrained), set(model.effects))
    columns = [reduced.reduction @ twists for place, twists in usual.items() if place not in _COUNTED]
    covariance = model.covariance
    if columns:
        J = np.hstack(columns)
        CA, CJ = np.split(np.linalg.solve(pose_covariance(reduced, scatter), np.hstack([reduced.hand_eye, J])), [6], 1)
        normal, unit = equilibrated(reduced.hand_eye.T @ CA)
        inverse = np.linalg.pinv(normal, rcond=_SEEN, hermitian=True) * np.outer(unit, unit)
        moved = inverse @ (CA.T @ J)
        seen = J.T @ CJ - (CA.T @ J).T @ moved
        left = np.linalg.inv(np.eye(J.shape[1]) + (seen + seen.T) / 2)
        covariance = covariance + moved @ left @ moved.T
    return np.sqrt(np.diag(covariance))
