"""Judge labelled points by a model that was fitted elsewhere: nothing is fitted but targets that it does not know."""

from collections.abc import Sequence

import numpy as np

from stitch.frames import Array
from stitch.measurement.measurement import Measurement, Term
from stitch.model.forward import corrected
from stitch.model.model_toml import Model
from stitch.model.terms import sigmas_of
from stitch.observations.targets.landmark_fit import fitted_landmarks, landmarks_covariance
from stitch.observations.targets.landmarks import Landmarks
from stitch.observations.targets.rows import evidence_of_rows, rows_of
from stitch.stages.target_fit import LabelledFit, rms_of
from stitch.statistics.variance_components import fit_variances


def evaluate(measurement: Measurement, model: Model, terms: Sequence[Term]) -> LabelledFit:
    """Rows and scatter under the model; a target that it does not know sits where the views have it."""
    own = corrected(measurement, terms, model.T_mount)
    free, blocks, _ = fitted_landmarks(own, model.T_mount)
    landmarks = _known(free, measurement, model)
    rows = rows_of(own, model.T_mount, landmarks)
    variances = fit_variances(evidence_of_rows(rows, rows.hand_eye[..., :0]), both_starts=True).variances
    covariance = landmarks_covariance(blocks, rows, model.covariance)
    distances = rows.distances(rows.residual)
    return LabelledFit(
        model.T_mount, model.covariance, 1.0, landmarks, _as_known(covariance, measurement, model), tuple(terms),
        sigmas_of(model, measurement), variances, rows, distances, (rms_of(distances),),
    )  # fmt: skip


def _as_known(covariance: Array, measurement: Measurement, model: Model) -> Array:
    """The covariance (U, U) of the landmarks with the model's own sigmas for the targets that it knows."""
    assert measurement.capture.sightings is not None
    out = covariance.copy()
    for k, name in enumerate(measurement.capture.sightings.targets):
        if name in model.targets:
            at = slice(3 * k, 3 * k + 3)
            out[at] = out[:, at] = 0.0
            out[at, at] = np.diag(model.targets[name].sigma ** 2)
    return out


def _known(landmarks: Landmarks, measurement: Measurement, model: Model) -> Landmarks:
    """The landmarks with those of the model in their place."""
    assert measurement.capture.sightings is not None
    positions, orientation = landmarks.positions.copy(), landmarks.orientation
    for k, name in enumerate(measurement.capture.sightings.targets):
        if name in model.targets:
            positions[k] = model.targets[name].position
            if orientation is not None and model.targets[name].orientation is not None:
                orientation = model.targets[name].orientation
    return Landmarks(positions, orientation)
