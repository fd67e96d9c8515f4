"""The linear problem of hand-eye and effects over freed views, and its answer without the statistics."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.measurement.capture import Capture
from stitch.observations.surfaces.capture_evidence import CaptureEvidence
from stitch.observations.surfaces.free_poses import UnconstrainedPoses
from stitch.observations.surfaces.pose_channel import Repeatability, estimate_repeatability
from stitch.observations.surfaces.rig_model import RigModel, stack_captures
from stitch.statistics.least_squares import GeneralisedFit


@dataclass(frozen=True)
class FittedEffects:
    """P parameters of effects that are fitted together with the hand-eye."""

    twists: tuple[Array, ...]  # per capture (6V, P): left twists about the centre of its Gram matrices
    values: Array  # (P,) at which they were computed
    prior: Array  # (P,) standard deviation of a weak prior about zero


@dataclass(frozen=True)
class HandEyeSolution:
    """The linear problem of hand-eye and effects, and its answer x (6 + P,)."""

    parts: list[CaptureEvidence]
    rig: RigModel
    scatter: tuple[Repeatability, ...]
    prior: Array  # (6 + P, 6 + P) precision
    prior_vector: Array  # (6 + P,)
    gls: GeneralisedFit
    x: Array
    values: Array  # (P,) of the effects at which it was made


def solve_hand_eye(
    captures: Sequence[Capture],
    unconstrained: Sequence[UnconstrainedPoses],
    T_mount: Array,
    columns: FittedEffects | None = None,
) -> HandEyeSolution:
    """Views weigh by the scatter that they show; arguments as of `fit_hand_eye`."""
    columns = columns or FittedEffects(
        tuple(np.zeros((6 * len(f.poses), 0)) for f in unconstrained), np.zeros(0), np.zeros(0)
    )
    parts = [
        CaptureEvidence(c, f.overlaps.gram, f.twists, c.hand_eye_frames(T_mount), extra)
        for c, f, extra in zip(captures, unconstrained, columns.twists, strict=True)
    ]
    rig, scatter = (
        stack_captures(parts),
        tuple(estimate_repeatability(e.reduced_poses, e.effect_columns) for e in parts),
    )
    prior = weak_prior(captures, unconstrained, T_mount, columns.prior)
    pull = np.concatenate([np.zeros(6), -columns.values * columns.prior**-2.0])
    weighed = rig.fit_gls(scatter, prior)
    return HandEyeSolution(
        parts, rig, scatter, prior, prior_vector=pull, gls=weighed, x=weighed.solve(rig.z, pull), values=columns.values
    )


def step_hand_eye(
    captures: Sequence[Capture], unconstrained: Sequence[UnconstrainedPoses], T_mount: Array
) -> tuple[Array, tuple[Repeatability, ...]]:
    """T_mount (4, 4) as `fit_hand_eye` finds it, without its statistics, and how the poses scatter per capture."""
    found = solve_hand_eye(captures, unconstrained, T_mount)
    return T_mount @ frames.exp(found.x), found.scatter


def weak_prior(
    captures: Sequence[Capture], unconstrained: Sequence[UnconstrainedPoses], T_mount: Array, effects: Array
) -> Array:
    """Precision of one radian and one working distance: keeps the unseen finite, moves nothing else.

    Args:
        effects: (P,) standard deviations of the prior of effects fitted with the hand-eye.
    """
    ranges = [
        np.linalg.norm(frames.transform(frames.inverse(c.poses(T_mount)), f.overlaps.gram.centre[None]), axis=-1)
        for c, f in zip(captures, unconstrained, strict=True)
    ]
    distance = float(np.median(np.concatenate(ranges)))
    return np.diag(np.concatenate([[1.0] * 3, [distance**-2.0] * 3, effects**-2.0]))
