"""Use a model that was fitted on another object of the same rig, without correcting again."""

from collections.abc import Sequence

import numpy as np

from stitch.frames import Array
from stitch.measurement.capture import Capture, part_size
from stitch.model.model import Model
from stitch.observations.surfaces.free_poses import unconstrained_poses
from stitch.observations.surfaces.hand_eye import HandEyeFit, capture_repeatability
from stitch.observations.surfaces.match import sample_points
from stitch.observations.surfaces.overlaps import (
    FINE_SAMPLES,
    Overlaps,
    collect_overlaps,
    common_samples,
    next_gate,
    pooled_rms,
)
from stitch.stages.correct import with_noise_factor
from stitch.stages.correction import Correction

# A corrected hand-eye leaves the robot's pose errors: some percent of the part at most.
REUSE_GATE = 0.05
_TIGHTENINGS = 4
_GATE_CONVERGED = 0.99


def apply_given_hand_eye(captures: Sequence[Capture], model: Model) -> Correction:
    """Overlaps and pose scatter of `captures` under a model, as `correct` returns them.

    Args:
        captures: without the model's effects.

    Raises:
        NoResultError: no two views overlap under the hand-eye.
    """
    size = part_size(captures)
    overlaps = tuple(converged_overlaps(c, model.T_mount, REUSE_GATE * size) for c in captures)
    poses = [c.poses(model.T_mount) for c in captures]
    freed = [unconstrained_poses(c, T, o.gate) for c, T, o in zip(captures, poses, overlaps, strict=True)]
    scatter = tuple(capture_repeatability(c, f, model.T_mount) for c, f in zip(captures, freed, strict=True))
    return Correction(
        model=model,
        hand_eye=HandEyeFit(model.T_mount, model.covariance, 1.0, scatter, 1.0),
        overlaps=overlaps,
        unconstrained=tuple(freed),
        history=(pooled_rms(overlaps),),
        captures=tuple(with_noise_factor(c, s) for c, s in zip(captures, scatter, strict=True)),
        given=True,
    )


def converged_overlaps(capture: Capture, T_mount: Array, gate: float) -> Overlaps:
    """Correspondences under a hand-eye that is right but for pose errors; the gate closes to the data's scale.

    Raises:
        NoResultError: no two views overlap.
    """
    samples = [sample_points(scan, FINE_SAMPLES) for scan in capture.scans]
    return collect_overlaps(capture, capture.poses(T_mount), converged_gate(capture, T_mount, gate), samples)


def converged_gate(capture: Capture, T_mount: Array, gate: float) -> float:
    """The distance that partners may have, from one that is too large.

    Raises:
        NoResultError: no two views overlap.
    """
    samples = common_samples(capture.scans, FINE_SAMPLES)
    poses, overlaps = capture.poses(T_mount), None
    for _ in range(_TIGHTENINGS):
        overlaps = collect_overlaps(capture, poses, gate, samples, overlaps)
        last, gate = gate, float(np.minimum(gate, next_gate(overlaps, capture)))
        if gate > _GATE_CONVERGED * last:
            break
    return gate
