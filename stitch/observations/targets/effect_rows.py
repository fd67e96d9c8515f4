"""How the rows of labelled points answer to the parameters of effects."""

from collections.abc import Sequence

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.measurement.measurement import Measurement
from stitch.model.forward import moves_points
from stitch.model.jacobian import pose_derivatives
from stitch.model.model import Model
from stitch.model.point_slopes import PointSlopes
from stitch.model.term import Term
from stitch.observations.targets.rows import TargetRows


def effect_rows(rows: TargetRows, measurement: Measurement, model: Model, terms: Sequence[Term]) -> list[Array]:
    """Per term (B, m, P) how the rows answer to its parameters, at `model`."""
    of_views = pose_derivatives(measurement, model, [t for t in terms if not moves_points([t])], rows.centre)
    out = []
    for term in terms:
        if moves_points([term]):
            out.append(_point_rows(rows, measurement, model, term))
        else:
            moved = next(of_views)
            out.append(rows.from_twists(moved.reshape(len(moved), -1).T))
    return out


def _point_rows(rows: TargetRows, measurement: Measurement, model: Model, term: Term) -> Array:
    """(B, m, P) of an effect that changes the points."""
    poses = rows.capture.poses(rows.T_mount)
    slopes = frames.rotate(poses, PointSlopes.about_model(measurement, model, [term]).at_targets(poses))  # (P, V, S, 3)
    out = np.zeros((*rows.residual.shape, len(slopes)))
    out[: len(poses), : rows.positions] = slopes.reshape(*slopes.shape[:2], -1).transpose(1, 2, 0)
    out[: len(poses)][~rows.used] = 0.0
    return out


def effect_columns(rows: TargetRows, measurement: Measurement, model: Model) -> Array:
    """(B, m, P) how the rows answer to all parameters of the effects in use."""
    found = effect_rows(rows, measurement, model, model.terms)
    return np.concatenate([np.zeros((*rows.residual.shape, 0)), *found], axis=2)
