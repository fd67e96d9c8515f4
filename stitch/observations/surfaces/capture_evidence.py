"""What one capture says about hand-eye and effects: its pairs, its freed views, and both without some views."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from stitch.frames import Array, Indices
from stitch.measurement.capture import Capture
from stitch.observations.surfaces.gram import Gram, pair_squares
from stitch.observations.surfaces.pose_channel import ReducedPoses, hand_eye_jacobian, reduce_poses
from stitch.statistics.folds import grouped_folds


@dataclass(frozen=True)
class CaptureEvidence:
    """One capture's pairs and freed views."""

    capture: Capture
    gram: Gram
    twists: Array  # (V, 6)
    hand_eye_frames: Array  # (V, 4, 4) of the hand-eye
    effect_twists: Array  # (6V, P)

    @cached_property
    def reduced_poses(self) -> ReducedPoses:
        """The visible directions of the freed views."""
        return reduce_poses(self.gram, self.twists, self.hand_eye_frames, self.capture.T_reference_flange)

    @property
    def effect_columns(self) -> Array | None:
        """(n, P) the effects' columns in the channel; None without effects."""
        return self.reduced_poses.reduction @ self.effect_twists if self.effect_twists.shape[1] else None

    def folds(self) -> list[Indices]:
        """Groups of views to leave out."""
        return grouped_folds(self.capture.T_reference_mount, max(self.gram.lever, 1e-9))

    def without(self, views: Indices) -> "CaptureEvidence":
        g = self.gram
        keep = np.asarray(~np.isin(g.pairs, views).any(axis=1))
        number = np.cumsum(~np.isin(np.arange(g.views), views)) - 1
        return CaptureEvidence(
            capture=self.capture.without(views),
            gram=replace(g.only(keep), views=g.views - len(views), pairs=number[g.pairs[keep]]),
            twists=np.delete(self.twists, views, 0),
            hand_eye_frames=np.delete(self.hand_eye_frames, views, 0),
            effect_twists=self.drop_views(self.effect_twists, views),
        )

    def squares(self, views: Indices, corrections: Sequence[Array]) -> Array:
        """Σ w e² of the pairs of some views with the robot's poses and each correction (6 + P,)."""
        touched = np.isin(self.gram.pairs, views).any(axis=1)
        J = np.column_stack([hand_eye_jacobian(self.hand_eye_frames, self.gram.centre), self.effect_twists])
        moved = [(J @ x).reshape(-1, 6) - self.twists for x in corrections]
        return np.array([pair_squares(self.gram, m)[touched].sum() for m in moved])

    @staticmethod
    def drop_views(rows: Array, views: Indices) -> Array:
        """Rows (6V, ·) of twists without those of some views."""
        return np.delete(rows, (6 * views[:, None] + np.arange(6)).ravel(), axis=0)
