"""Where the targets lie, and how well that is known, under a hand-eye that is given."""

import numpy as np

from stitch.frames import Array
from stitch.measurement.capture import Capture
from stitch.observations.targets.landmarks import Landmarks, initial_landmarks
from stitch.observations.targets.rows import TargetRows, mixed_model_of_rows, target_rows
from stitch.statistics.block_least_squares import BlockLeastSquares
from stitch.statistics.variance_components import fit_variances


def fit_landmarks(own: Capture, T_mount: Array) -> tuple[Landmarks, BlockLeastSquares, Array]:
    """The landmarks by least squares under a hand-eye, the blocks of that fit, and the scatter.

    Args:
        own: without the effects in use.

    Returns:
        The scatter as variances (3,) of rotation, of translation, and the factor on the sensor's noise.
    """
    landmarks = initial_landmarks(own, T_mount)
    rows = target_rows(own, T_mount, landmarks)
    mixed = mixed_model_of_rows(rows, rows.landmarks)
    variances = fit_variances(mixed, both_starts=True).variances
    assert own.sightings is not None
    # One working distance for what nobody sees.
    distance = float(np.median(np.linalg.norm(np.concatenate(own.sightings.points_by_view()), axis=1)))
    precision = np.full(landmarks.size, distance**-2.0)
    blocks = BlockLeastSquares(
        mixed.z, rows.landmarks, mixed.covariance(variances), precision, np.zeros(landmarks.size)
    )
    return landmarks.updated(blocks.solve()), blocks, variances


def landmarks_covariance(blocks: BlockLeastSquares, rows: TargetRows, hand_eye: Array) -> Array:
    """(U, U) by the scatter of the poses, the sensor's noise and the uncertainty (6, 6) of the hand-eye."""
    pull = np.einsum("bmk,bmi->ki", blocks.weighted, rows.hand_eye)
    moved = np.linalg.solve(blocks.information + np.diag(blocks.precision), pull)
    return np.asarray(blocks.estimates_covariance() + moved @ hand_eye @ moved.T)
