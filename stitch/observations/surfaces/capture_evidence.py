"""What one capture says about hand-eye and effects: its pairs, its freed views, and both without some views."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch import frames
from stitch.frames import Array, Indices
from stitch.measurement.capture import Capture
from stitch.observations.surfaces.free_poses import visible_directions
from stitch.observations.surfaces.gram import Gram, pair_squares
from stitch.observations.surfaces.pose_channel import PoseChannel, Repeatability, covariance_of, pose_channel
from stitch.statistics.folds import grouped_folds

# What the scatter alone would give, drawn so often.
DRAWS = 200


def jacobian(hand_eye_frames: Array, centre: Array) -> Array:
    """(6V, 6): left twists of the views about `centre` for a right perturbation of the hand-eye."""
    return np.concatenate(list(frames.adjoint(frames.make(np.eye(3), -centre) @ hand_eye_frames)))


@dataclass(frozen=True)
class CaptureEvidence:
    """One capture's pairs and freed views."""

    capture: Capture
    gram: Gram
    twists: Array  # (V, 6)
    hand_eye_frames: Array  # (V, 4, 4) of the hand-eye
    extra: Array  # (6V, P)

    def channel(self) -> PoseChannel:
        return pose_channel(self.gram, self.twists, self.hand_eye_frames, self.capture.T_reference_flange)

    def further(self) -> Array | None:
        """(n, P) the effects' columns in the channel."""
        return self.channel().reduction @ self.extra if self.extra.shape[1] else None

    def folds(self) -> list[Indices]:
        return grouped_folds(self.capture.T_reference_mount, max(self.gram.lever, 1e-9))

    def without(self, views: Indices) -> "CaptureEvidence":
        g = self.gram
        keep = ~np.isin(g.pairs, views).any(axis=1)
        number = np.cumsum(~np.isin(np.arange(g.views), views)) - 1
        fewer = replace(
            g, views=g.views - len(views), pairs=number[g.pairs[keep]], matrix=g.matrix[keep], vector=g.vector[keep],
            square=g.square[keep], weight=g.weight[keep], count=g.count[keep], raw_square=g.raw_square[keep],
            labelled=g.labelled[keep],
        )  # fmt: skip
        return CaptureEvidence(
            self.capture.without(views), fewer, np.delete(self.twists, views, 0),
            np.delete(self.hand_eye_frames, views, 0), drop(self.extra, views),
        )  # fmt: skip

    def squares(self, views: Indices, corrections: Sequence[Array]) -> Array:
        """Σ w e² of the pairs of some views with the robot's poses and each correction (6 + P,)."""
        touched = np.isin(self.gram.pairs, views).any(axis=1)
        J = np.column_stack([jacobian(self.hand_eye_frames, self.gram.centre), self.extra])
        moved = [(J @ x).reshape(-1, 6) - self.twists for x in corrections]
        return np.array([pair_squares(self.gram, m)[touched].sum() for m in moved])


def measured_and_drawn(evidence: CaptureEvidence, scatter: Repeatability) -> Array:
    """(6V, 1 + DRAWS) twists: the measured ones, then draws under the scatter and the noise alone."""
    rng = np.random.default_rng(0)
    g = evidence.gram
    to_centre = frames.make(np.eye(3), -g.centre)
    carried = frames.adjoint(to_centre @ evidence.capture.T_reference_flange)
    sigma = np.array([scatter.rotation] * 3 + [scatter.translation] * 3)
    robot = np.einsum("vij,vjd->vid", carried, sigma[:, None] * rng.standard_normal((g.views, 6, DRAWS)))
    values, vectors, scale = visible_directions(g)
    noise = np.sqrt(scatter.noise_factor * g.variance / values)[:, None] * rng.standard_normal((len(values), DRAWS))
    drawn = robot.reshape(6 * g.views, DRAWS) + scale[:, None] * (vectors @ noise)
    return np.column_stack([evidence.twists.reshape(-1), drawn])


def drop(rows: Array, views: Indices) -> Array:
    return np.delete(rows, (6 * views[:, None] + np.arange(6)).ravel(), axis=0)


def information(evidence: CaptureEvidence, scatter: Repeatability, twists: Array) -> tuple[Array, Array]:
    """Information matrix (6 + P, 6 + P) and vectors (6 + P, D) from one pose channel and twists (6V, D)."""
    channel = evidence.channel()
    X = np.column_stack([channel.hand_eye, channel.reduction @ evidence.extra])
    weighted = np.linalg.solve(covariance_of(channel, scatter), X).T
    return np.asarray(weighted @ X), np.asarray(weighted @ channel.reduction @ twists)
