"""Judge labelled points by a model that was fitted elsewhere: nothing is fitted but targets that it does not know."""

from collections.abc import Sequence

import numpy as np

from stitch.effects.chain import Chain, Term
from stitch.effects.terms import sigmas_of
from stitch.effects.undo import corrected
from stitch.labelled.fit import LabelledFit, rms_of
from stitch.labelled.landmarks import Landmarks, settled
from stitch.labelled.rows import evidence_of_rows, rows_of
from stitch.model import Model
from stitch.variance import fit_variances


def judged(chain: Chain, model: Model, terms: Sequence[Term]) -> LabelledFit:
    """Rows and scatter under the model; a target that it does not know sits where the views have it (median)."""
    own = corrected(chain, terms, model.T_mount)
    landmarks = _known(settled(own, model.T_mount), chain, model)
    rows = rows_of(own, model.T_mount, landmarks)
    variances = fit_variances(evidence_of_rows(rows, rows.hand_eye[..., :0]), both_starts=True).variances
    distances, size = rows.distances(rows.left), landmarks.size
    return LabelledFit(
        model.T_mount, model.covariance, 1.0, landmarks, np.zeros((size, size)), tuple(terms), sigmas_of(model, chain),
        variances, rows, distances, (rms_of(distances),),
    )  # fmt: skip


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
