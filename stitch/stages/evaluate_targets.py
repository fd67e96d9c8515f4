"""Where labelled points lie under a model that is given: nothing is fitted but places that it does not know."""

import numpy as np

from stitch.frames import Array
from stitch.measurement.measurement import Measurement
from stitch.measurement.sightings import Sightings
from stitch.model.forward import corrected
from stitch.model.model import Model
from stitch.observations.targets.landmark_fit import fitted_landmarks, landmarks_covariance
from stitch.observations.targets.landmarks import Landmarks
from stitch.observations.targets.rows import mixed_model_of_rows, rows_of
from stitch.observations.targets.target_fit import TargetFit, rms_of
from stitch.statistics.variance_components import fit_variances


def placed_targets(measurement: Measurement, model: Model, inflation: float) -> TargetFit | None:
    """Targets in the middle of where the views put them under a model that clouds fitted; None without any.

    Their covariance counts the scatter of the poses, the sensor's noise and the hand-eye.
    """
    if measurement.capture.sightings is None:
        return None
    own = corrected(measurement, model)
    landmarks, blocks, variances = fitted_landmarks(own, model.T_mount)
    rows = rows_of(own, model.T_mount, landmarks)
    distances = rows.distances(rows.residual)
    return TargetFit(
        model=model,
        inflation=inflation,
        landmarks=landmarks,
        landmarks_covariance=landmarks_covariance(blocks, rows, model.covariance),
        variances=variances,
        rows=rows,
        heldout=np.full(distances.shape, np.nan),
        history=(rms_of(distances),),
    )


def evaluate_targets(measurement: Measurement, model: Model) -> TargetFit:
    """Rows and scatter under a model of another run; a target that it does not know sits where the views have it."""
    own = corrected(measurement, model)
    free, blocks, _ = fitted_landmarks(own, model.T_mount)
    assert own.sightings is not None
    landmarks = _known(free, own.sightings, model)
    rows = rows_of(own, model.T_mount, landmarks)
    nothing = rows.hand_eye[..., :0]
    covariance = landmarks_covariance(blocks, rows, model.covariance)
    distances = rows.distances(rows.residual)
    return TargetFit(
        model=model,
        inflation=1.0,
        landmarks=landmarks,
        landmarks_covariance=_as_known(covariance, own.sightings, model),
        variances=fit_variances(mixed_model_of_rows(rows, nothing), both_starts=True).variances,
        rows=rows,
        heldout=distances,
        history=(rms_of(distances),),
    )


def _as_known(covariance: Array, sightings: Sightings, model: Model) -> Array:
    """The covariance (U, U) of the landmarks with the model's own sigmas for the targets that it knows."""
    out = covariance.copy()
    for k, name in enumerate(sightings.targets):
        if name in model.targets:
            at = slice(3 * k, 3 * k + 3)
            out[at] = out[:, at] = 0.0
            out[at, at] = np.diag(model.targets[name].sigma ** 2)
    return out


def _known(landmarks: Landmarks, sightings: Sightings, model: Model) -> Landmarks:
    """The landmarks with those of the model in their place."""
    positions, orientation = landmarks.positions.copy(), landmarks.orientation
    for k, name in enumerate(sightings.targets):
        if name in model.targets:
            positions[k] = model.targets[name].position
            if orientation is not None and model.targets[name].orientation is not None:
                orientation = model.targets[name].orientation
    return Landmarks(positions, orientation)
