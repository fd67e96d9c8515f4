"""How far an effect that is too small to be seen would push the hand-eye: what its sigma does not hold."""

import numpy as np

from stitch import frames
from stitch.diagnosis.candidates import Candidate
from stitch.frames import Array
from stitch.observations.linear_model import LinearModel


def hand_eye_response(linear: LinearModel) -> Array:
    """(3, n) how whitened numbers (n,) displace the middle of the scanner's field through the fitted hand-eye."""
    middle = np.mean([points.mean(axis=0) for points in linear.measurement.capture.point_sets], axis=0)
    lever = np.hstack([-frames.skew(middle), np.eye(3)])
    length = np.linalg.norm(linear.white_design, axis=0)
    scale = np.where(length > 0, length, 1.0)
    return np.asarray(lever @ (np.linalg.pinv(linear.white_design / scale, rcond=1e-10) / scale[:, None])[:6])


def omitted_effect_bias(
    linear: LinearModel, push: Array, candidate: Candidate, detectable: dict[str, float]
) -> float | None:
    """Largest displacement (length_unit) of the middle of the scanner's field by the error of the hand-eye.

    Each parameter in turn is there unseen, at its smallest detectable size or, where that is larger, at its plausible
    one; the hand-eye takes up of it what generalised least squares gives it. None if these views show no parameter.

    Args:
        push: of the same linear model (`hand_eye_response`).
    """
    found = []
    for form in candidate.forms:
        for p, moved in zip(form.free, (push @ linear.whiten(form.columns)).T, strict=True):
            if np.isfinite(detectable.get(p.name, np.inf)):
                found.append(min(detectable[p.name], p.typical) * float(np.linalg.norm(moved)))
    return max(found, default=None)
