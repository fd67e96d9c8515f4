"""Where labelled points lie under a model that is given: nothing is fitted but places that it does not know."""

import numpy as np

from stitch.frames import Array
from stitch.measurement.measurement import Measurement
from stitch.measurement.sightings import Sightings
from stitch.model.forward import corrected_capture
from stitch.model.model import Model
from stitch.observations.targets.landmark_fit import fit_landmarks, landmarks_covariance
from stitch.observations.targets.landmarks import Landmarks
from stitch.observations.targets.rows import mixed_model_of_rows, target_rows
from stitch.observations.targets.target_fit import TargetModelFit, rms_of
from stitch.statistics.variance_components import fit_variances


def locate_targets(measurement: Measurement, model: Model, inflation: float) -> TargetModelFit | None:
    """Targets in the middle of where the views put them under a model that clouds fitted; None without any.

    Their covariance counts the scatter of the poses, the sensor's noise and the hand-eye.
    """
    if measurement.capture.sightings is None:
        return None
    own = corrected_capture(measurement, model)
    landmarks, blocks, variances = fit_landmarks(own, model.T_mount)
    rows = target_rows(own, model.T_mount, landmarks)
    distances = rows.distances(rows.residual)
    return TargetModelFit(
        model=model,
        inflation=inflation,
        landmarks=landmarks,
        landmarks_covariance=landmarks_covariance(blocks, rows, model.covariance),
        variances=variances,
        rows=rows,
        heldout=np.full(distances.shape, np.nan),
        history=(rms_of(distances),),
    )


def evaluate_targets(measurement: Measurement, model: Model) -> TargetModelFit:
    """Rows and scatter under a model of another run; a target that it does not know sits where the views have it."""
    own = corrected_capture(measurement, model)
    free, blocks, _ = fit_landmarks(own, model.T_mount)
    assert own.sightings is not None
    landmarks = _with_known_places(free, own.sightings, model)
    rows = target_rows(own, model.T_mount, landmarks)
    nothing = rows.hand_eye[..., :0]
    covariance = landmarks_covariance(blocks, rows, model.covariance)
    distances = rows.distances(rows.residual)
    return TargetModelFit(
        model=model,
        inflation=1.0,
        landmarks=landmarks,
        landmarks_covariance=_with_known_sigmas(covariance, own.sightings, model),
        variances=fit_variances(mixed_model_of_rows(rows, nothing), both_starts=True).variances,
        rows=rows,
        heldout=distances,
        history=(rms_of(distances),),
    )


def _with_known_sigmas(covariance: Array, sightings: Sightings, model: Model) -> Array:
    """The covariance (U, U) of the landmarks with the model's own sigmas for the targets that it knows."""
    out = covariance.copy()
    for k, name in enumerate(sightings.targets):
        if name in model.targets:
            at = slice(3 * k, 3 * k + 3)
            out[at] = out[:, at] = 0.0
            out[at, at] = np.diag(model.targets[name].sigma ** 2)
    return out


def _with_known_places(landmarks: Landmarks, sightings: Sightings, model: Model) -> Landmarks:
    """The landmarks with those of the model in their place."""
    positions, orientation = landmarks.positions.copy(), landmarks.orientation
    for k, name in enumerate(sightings.targets):
        if name in model.targets:
            positions[k] = model.targets[name].position
            if orientation is not None and model.targets[name].orientation is not None:
                orientation = model.targets[name].orientation
    return Landmarks(positions, orientation)
