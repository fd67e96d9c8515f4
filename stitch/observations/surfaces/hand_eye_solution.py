"""The linear problem of hand-eye and effects over freed views, and its answer without the statistics."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.measurement.capture import Capture
from stitch.observations.surfaces.capture_evidence import CaptureEvidence
from stitch.observations.surfaces.free_poses import FreePoses
from stitch.observations.surfaces.pose_channel import Repeatability, estimate
from stitch.observations.surfaces.rig_model import RigModel, rig_model
from stitch.statistics.least_squares import Generalised


@dataclass(frozen=True)
class Columns:
    """P parameters of effects that are fitted together with the hand-eye."""

    twists: tuple[Array, ...]  # per capture (6V, P): left twists about the centre of its Gram matrices
    values: Array  # (P,) at which they were computed
    prior: Array  # (P,) standard deviation of a weak prior about zero


@dataclass(frozen=True)
class Solution:
    """The linear problem of hand-eye and effects, and its answer x (6 + P,)."""

    parts: list[CaptureEvidence]
    rig: RigModel
    scatter: tuple[Repeatability, ...]
    prior: Array  # (6 + P, 6 + P) precision
    pull: Array  # (6 + P,)
    weighed: Generalised
    x: Array
    values: Array  # (P,) of the effects at which it was made


def solved(
    captures: Sequence[Capture], freed: Sequence[FreePoses], T_mount: Array, columns: Columns | None = None
) -> Solution:
    """Views weigh by the scatter that they show; arguments as of `fit_hand_eye`."""
    columns = columns or Columns(tuple(np.zeros((6 * len(f.poses), 0)) for f in freed), np.zeros(0), np.zeros(0))
    parts = [
        CaptureEvidence(c, f.overlaps.gram, f.twists, c.hand_eye_frames(T_mount), extra)
        for c, f, extra in zip(captures, freed, columns.twists, strict=True)
    ]
    rig, scatter = rig_model(parts), tuple(estimate(e.channel, e.further) for e in parts)
    prior = weak_prior(captures, freed, T_mount, columns.prior)
    pull = np.concatenate([np.zeros(6), -columns.values * columns.prior**-2.0])
    weighed = rig.weighed(scatter, prior)
    return Solution(
        parts, rig, scatter, prior, pull=pull, weighed=weighed, x=weighed.solve(rig.z, pull), values=columns.values
    )


def step_hand_eye(
    captures: Sequence[Capture], freed: Sequence[FreePoses], T_mount: Array
) -> tuple[Array, tuple[Repeatability, ...]]:
    """T_mount (4, 4) as `fit_hand_eye` finds it, without its statistics, and how the poses scatter per capture."""
    found = solved(captures, freed, T_mount)
    return T_mount @ frames.exp(found.x), found.scatter


def weak_prior(captures: Sequence[Capture], freed: Sequence[FreePoses], T_mount: Array, effects: Array) -> Array:
    """Precision of one radian and one working distance: keeps the unseen finite, moves nothing else.

    Args:
        effects: (P,) standard deviations of the prior of effects fitted with the hand-eye.
    """
    ranges = [
        np.linalg.norm(frames.transform(frames.inverse(c.poses(T_mount)), f.overlaps.gram.centre[None]), axis=-1)
        for c, f in zip(captures, freed, strict=True)
    ]
    distance = float(np.median(np.concatenate(ranges)))
    return np.diag(np.concatenate([[1.0] * 3, [distance**-2.0] * 3, effects**-2.0]))
