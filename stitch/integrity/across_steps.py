"""Views that nothing links because a step stands between them and the others: the linked ones tell it.

A step pulls the hand-eye, and the side of it that has fewer views stands farther from the others than what two scans
share reaches. Tried wide, such a view would close somewhere on a part that looks alike from several sides, and would be
called displaced. One step explains more than that: the views are tried from where it puts them first. The likeliest
step is tried whether it stands out among the few views that are linked or not: that it links more of them is the proof.
"""

import numpy as np

from stitch.frames import Array
from stitch.integrity.expected_poses import expected_poses
from stitch.integrity.linkage import linkage
from stitch.integrity.pose_tests import pose_tests
from stitch.integrity.usual_effects import UsualEffects
from stitch.integrity.view_model import view_model
from stitch.measurement.capture import Capture
from stitch.observations.surfaces.free_poses import UnconstrainedPoses, unconstrained_poses

# Chance at which a step is tried.
_ANY_CHANCE = 1.0


def place_across_steps(
    capture: Capture, T_mount: Array, unconstrained: UnconstrainedPoses, usual: UsualEffects | None
) -> tuple[Array, UnconstrainedPoses]:
    """Where views are expected, and where overlaps put them: beside a step, if that links more of them.

    Args:
        T_mount: (4, 4) hand-eye of the model poses from which `unconstrained` is seen.

    Returns:
        (V, 4, 4) T_reference_scanner, those of the model without a step; and the views freed, seen from these.
    """
    model_poses, apart = capture.poses(T_mount), list(linkage(unconstrained.overlaps).unlinked)
    if not apart:
        return model_poses, unconstrained
    model = view_model(capture, T_mount, unconstrained)
    tests = pose_tests(model, unconstrained, (apart, []), usual, _ANY_CHANCE)
    if not tests.steps:
        return model_poses, unconstrained
    expected = expected_poses(model, model_poses, unconstrained, tests)
    poses = np.array(unconstrained.poses)
    poses[apart] = expected[apart]
    tried = [unconstrained_poses(capture, start, unconstrained.overlaps.gate) for start in (expected, poses)]
    best = min((unconstrained, *tried), key=lambda found: len(linkage(found.overlaps).unlinked))
    return (model_poses, unconstrained) if best is unconstrained else (expected, best.relative_to(expected))
