"""Where views are expected beside steps: what a single one is off by does not hold what all from one on share.

Across a step the hand-eye is a compromise, and every view stands off from it by its share of the step.
"""

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.integrity.pose_tests import PoseTests
from stitch.integrity.view_test import ViewModel
from stitch.observations.surfaces.free_poses import FreePoses
from stitch.statistics.least_squares import least_squares


def expected_poses(model: ViewModel, model_poses: Array, freed: FreePoses, tests: PoseTests) -> Array:
    """Hand-eye and steps estimated together, without the views that stand off.

    Args:
        model_poses: (V, 4, 4) T_reference_scanner from which the evidence is counted.
        freed: the views from there where surfaces put them.

    Returns:
        (V, 4, 4) T_reference_scanner.
    """
    alone = [*tests.alone, *(b.view for b in tests.found.blunders)]
    singles = model.columns(alone)
    common = [model.hand_eye, *(step.columns(model) for step in tests.steps)]
    X = np.column_stack(common if singles is None else [*common, singles])
    CX = np.linalg.solve(model.mixed().covariance(tests.found.fit.variances)[0], X)
    estimate = least_squares(X.T @ CX, -CX.T @ model.z)
    twists = model.mount_twists @ estimate[:6]
    for k, step in enumerate(tests.steps, start=1):
        own = model.mount_twists[step.start :] if step.moved == "scanner" else np.eye(6)[None]
        twists[step.start :] += own @ estimate[6 * k : 6 * k + 6]
    twists[:, :3] /= model.lever
    # Surfaces do not say where all views together stand.
    twists += np.mean(np.delete(freed.twists - twists, alone, axis=0), axis=0)
    to_centre = frames.make(np.eye(3), -model.centre)
    return np.asarray(frames.inverse(to_centre) @ frames.exp(twists) @ to_centre @ model_poses)
