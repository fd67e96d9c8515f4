"""Where the targets lie, and how well that is known, under a hand-eye and a scatter that are given."""

import numpy as np

from stitch.frames import Array
from stitch.labelled.rows import Rows, evidence_of_rows
from stitch.labelled.solve import Blocks


def landmark_blocks(rows: Rows, variances: Array) -> Blocks:
    """Least squares for the U unknowns of the landmarks alone.

    Args:
        variances: (3,) of rotation scatter, translation scatter, and the factor on the sensor's noise.
    """
    evidence = evidence_of_rows(rows, rows.landmarks)
    sightings, size = rows.capture.sightings, rows.landmarks.shape[2]
    assert sightings is not None
    # One working distance for what nobody sees.
    distance = float(np.median(np.linalg.norm(np.concatenate(sightings.sets()), axis=1)))
    precision = np.full(size, distance**-2.0)
    return Blocks(evidence.z, rows.landmarks, evidence.covariance(variances), precision, np.zeros(size))


def landmarks_covariance(blocks: Blocks, rows: Rows, hand_eye: Array) -> Array:
    """(U, U) by the scatter of the poses, the sensor's noise and the uncertainty (6, 6) of the hand-eye."""
    pull = np.einsum("bmk,bmi->ki", blocks.weighted, rows.hand_eye)
    moved = np.linalg.solve(blocks.information.sum(axis=0) + np.diag(blocks.precision), pull)
    return np.asarray(blocks.estimates_covariance() + moved @ hand_eye @ moved.T)
