"""Judge labelled points by a model that was fitted elsewhere: nothing is fitted but targets that it does not know."""

from collections.abc import Sequence

import numpy as np

from stitch.effects.chain import Chain, Term
from stitch.effects.terms import sigmas_of
from stitch.effects.undo import corrected
from stitch.frames import Array
from stitch.labelled.fit import LabelledFit, rms_of
from stitch.labelled.fitted_landmarks import fitted_landmarks, landmarks_covariance
from stitch.labelled.landmarks import Landmarks
from stitch.labelled.rows import evidence_of_rows, rows_of
from stitch.model import Model
from stitch.variance import fit_variances


def judged(chain: Chain, model: Model, terms: Sequence[Term]) -> LabelledFit:
    """Rows and scatter under the model; a target that it does not know sits where the views have it."""
    own = corrected(chain, terms, model.T_mount)
    free, blocks, _ = fitted_landmarks(own, model.T_mount)
    landmarks = _known(free, chain, model)
    rows = rows_of(own, model.T_mount, landmarks)
    variances = fit_variances(evidence_of_rows(rows, rows.hand_eye[..., :0]), both_starts=True).variances
    covariance = landmarks_covariance(blocks, rows, model.covariance)
    distances = rows.distances(rows.left)
    return LabelledFit(
        model.T_mount, model.covariance, 1.0, landmarks, _as_known(covariance, chain, model), tuple(terms),
        sigmas_of(model, chain), variances, rows, distances, (rms_of(distances),),
    )  # fmt: skip


def _as_known(covariance: Array, chain: Chain, model: Model) -> Array:
    """The covariance (U, U) of the landmarks with the model's own sigmas for the targets that it knows."""
    assert chain.capture.sightings is not None
    out = covariance.copy()
    for k, name in enumerate(chain.capture.sightings.targets):
        if name in model.targets:
            at = slice(3 * k, 3 * k + 3)
            out[at] = out[:, at] = 0.0
            out[at, at] = np.diag(model.targets[name].sigma ** 2)
    return out


def _known(landmarks: Landmarks, chain: Chain, model: Model) -> Landmarks:
    """The landmarks with those of the model in their place."""
    assert chain.capture.sightings is not None
    positions, orientation = landmarks.positions.copy(), landmarks.orientation
    for k, name in enumerate(chain.capture.sightings.targets):
        if name in model.targets:
            positions[k] = model.targets[name].position
            if orientation is not None and model.targets[name].orientation is not None:
                orientation = model.targets[name].orientation
    return Landmarks(positions, orientation)
