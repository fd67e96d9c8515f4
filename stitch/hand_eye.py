"""The hand-eye from per-view evidence: generalised least squares, covariance, held-out error.

The poses of the views scatter by the robot's repeatability, which no number of points averages
out: views are the samples. Estimates with one view left out at a time give the held-out error and
show whether the covariance is too small for these data (jackknife; Efron & Stein 1981): a robot
whose pose errors are not independent from view to view has a larger one, never a smaller.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch import frames
from stitch.capture import Capture
from stitch.frames import Array
from stitch.free_poses import FreePoses
from stitch.repeatability import PoseChannel, Repeatability, covariance_of, estimate, pose_channel
from stitch.solve import Gram, pair_squares


@dataclass(frozen=True)
class HandEye:
    """Hand-eye and its statistics; twists are right perturbations T·exp(ξ), rotation first."""

    T_mount: Array  # (4, 4) T_mount_scanner
    covariance: Array  # (6, 6)
    inflation: float  # factor on the covariance that the left-out views asked for, ≥ 1
    repeatability: tuple[Repeatability, ...]  # per capture
    heldout_ratio: float  # rms of left-out views over rms of the fit, same correspondences


def jacobian(poses: Array, centre: Array) -> Array:
    """(6V, 6): left twists of the views about `centre` for a right perturbation of the hand-eye."""
    return np.concatenate(list(frames.adjoint(frames.make(np.eye(3), -centre) @ poses)))


def fit_hand_eye(captures: Sequence[Capture], freed: Sequence[FreePoses], T_mount: Array) -> HandEye:
    """Generalised least squares over the pose channels of all captures.

    Args:
        freed: per capture the views moved by the overlaps alone, from the poses under `T_mount`.
        T_mount: (4, 4) hand-eye at which that began.
    """
    evidence = [_Evidence(c, f.overlaps.gram, f.twists, c.poses(T_mount)) for c, f in zip(captures, freed, strict=True)]
    scatter = [estimate(e.channel()) for e in evidence]
    prior = _weak_prior(captures, freed, T_mount)
    blocks = [_information(e.channel(), s) for e, s in zip(evidence, scatter, strict=True)]
    xi, covariance = _combine(blocks, prior)
    left_out = []
    outside = np.zeros(2)
    for k, (e, s) in enumerate(zip(evidence, scatter, strict=True)):
        for v in range(e.gram.views):
            fewer = e.without(v)
            block = _information(fewer.channel(), s) if len(fewer.gram.pairs) else (np.zeros((6, 6)), np.zeros(6))
            xi_v, _ = _combine([*blocks[:k], block, *blocks[k + 1 :]], prior)
            left_out.append(xi_v)
            outside += e.squares(v, (xi_v, xi))
    inflation = _jackknife_inflation(np.array(left_out), covariance)
    ratio = float(np.sqrt(outside[0] / outside[1])) if outside[1] > 0 else float("nan")
    return HandEye(T_mount @ frames.exp(xi), covariance * inflation, inflation, tuple(scatter), ratio)


def scatter_of(capture: Capture, freed: FreePoses, model_poses: Array) -> Repeatability:
    """The repeatability of one capture's poses, whatever its hand-eye."""
    return estimate(_Evidence(capture, freed.overlaps.gram, freed.twists, model_poses).channel())


@dataclass(frozen=True)
class _Evidence:
    """One capture's pairs and freed views."""

    capture: Capture
    gram: Gram
    twists: Array  # (V, 6)
    poses: Array  # (V, 4, 4) of the model

    def channel(self) -> PoseChannel:
        return pose_channel(self.gram, self.twists, self.poses, self.capture.T_reference_flange)

    def without(self, v: int) -> "_Evidence":
        g = self.gram
        keep = (g.pairs != v).all(axis=1)
        pairs = g.pairs[keep] - (g.pairs[keep] > v)
        fewer = replace(
            g, views=g.views - 1, pairs=pairs, matrix=g.matrix[keep], vector=g.vector[keep], square=g.square[keep],
            weight=g.weight[keep], count=g.count[keep], raw_square=g.raw_square[keep],
        )  # fmt: skip
        return _Evidence(self.capture.without(v), fewer, np.delete(self.twists, v, 0), np.delete(self.poses, v, 0))

    def squares(self, v: int, corrections: Sequence[Array]) -> Array:
        """Σ w e² of the pairs of view v with the robot's poses and each of the hand-eye corrections ξ."""
        touched = (self.gram.pairs == v).any(axis=1)
        J = jacobian(self.poses, self.gram.centre)
        moved = [(J @ xi).reshape(-1, 6) - self.twists for xi in corrections]
        return np.array([pair_squares(self.gram, m)[touched].sum() for m in moved])


def _weak_prior(captures: Sequence[Capture], freed: Sequence[FreePoses], T_mount: Array) -> Array:
    """Precision of one radian and one working distance: keeps the unseen finite, moves nothing else."""
    ranges = [
        np.linalg.norm(frames.transform(frames.inverse(c.poses(T_mount)), f.overlaps.gram.centre[None]), axis=-1)
        for c, f in zip(captures, freed, strict=True)
    ]
    distance = float(np.median(np.concatenate(ranges)))
    return np.diag([1.0] * 3 + [distance**-2.0] * 3)


def _information(channel: PoseChannel, scatter: Repeatability) -> tuple[Array, Array]:
    """Information matrix and vector of ξ from one pose channel."""
    sigma = covariance_of(channel, scatter)
    whitened = np.linalg.solve(sigma, np.column_stack([channel.hand_eye, channel.z]))
    return channel.hand_eye.T @ whitened[:, :6], channel.hand_eye.T @ whitened[:, 6]


def _combine(blocks: Sequence[tuple[Array, Array]], prior: Array) -> tuple[Array, Array]:
    covariance: Array = np.linalg.inv(prior + np.sum([block[0] for block in blocks], axis=0))
    return covariance @ np.sum([block[1] for block in blocks], axis=0), covariance


def _jackknife_inflation(left_out: Array, covariance: Array) -> float:
    """Mean ratio of the jackknife's covariance to the model's over the six directions, at least 1."""
    count = len(left_out)
    if count < 4:
        return 1.0
    centred = left_out - left_out.mean(axis=0)
    jackknife = (count - 1) / count * centred.T @ centred
    return float(max(1.0, np.trace(np.linalg.solve(covariance, jackknife)) / 6))
