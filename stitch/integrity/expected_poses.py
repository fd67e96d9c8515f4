"""Where views are expected beside steps: what a single one is off by does not hold what all from one on share.

Across a step the hand-eye is a compromise, and every view stands off from it by its share of the step.
"""

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.integrity.blunders import free_view_columns
from stitch.integrity.pose_tests import PoseTests
from stitch.integrity.smallest import displacement_lower_bound
from stitch.integrity.view_model import ViewModel, projector
from stitch.integrity.view_test import test_alternative
from stitch.observations.surfaces.free_poses import UnconstrainedPoses
from stitch.statistics.least_squares import least_squares


def expected_poses(model: ViewModel, model_poses: Array, unconstrained: UnconstrainedPoses, tests: PoseTests) -> Array:
    """Hand-eye and steps estimated together, without the views that stand off.

    Args:
        model_poses: (V, 4, 4) T_reference_scanner from which the evidence is counted.
        unconstrained: the views from there where surfaces put them.

    Returns:
        (V, 4, 4) T_reference_scanner.
    """
    alone = [*tests.excluded, *(b.view for b in tests.blunder_search.blunders)]
    moved = [_step_displacement(model, tests, alone, k) for k in range(len(tests.steps))]
    z = model.z - sum(step.columns(model) @ by for step, by in zip(tests.steps, moved, strict=True))
    singles = model.columns(alone)
    X = model.hand_eye if singles is None else np.column_stack([model.hand_eye, singles])
    CX = np.linalg.solve(model.mixed().covariance(tests.blunder_search.fit.variances)[0], X)
    twists = model.mount_twists @ least_squares(X.T @ CX, -CX.T @ z)[:6]
    for step, by in zip(tests.steps, moved, strict=True):
        own = model.mount_twists[step.start :] if step.moved == "scanner" else np.eye(6)[None]
        twists[step.start :] += own @ by
    twists[:, :3] /= model.lever
    # Surfaces do not say where all views together stand.
    twists += np.mean(np.delete(unconstrained.twists - twists, alone, axis=0), axis=0)
    to_centre = frames.make(np.eye(3), -model.centre)
    return np.asarray(frames.inverse(to_centre) @ frames.exp(twists) @ to_centre @ model_poses)


def _step_displacement(model: ViewModel, tests: PoseTests, excluded: list[int], k: int) -> Array:
    """(6,) the least that step k may have moved, rotations in 1/lever: along itself a part slides unseen."""
    others = free_view_columns(model, excluded, (*tests.steps[:k], *tests.steps[k + 1 :]))
    under = projector(model, tests.blunder_search.fit, others)
    return displacement_lower_bound(test_alternative(under, tests.steps[k].columns(model)), under.degrees)
