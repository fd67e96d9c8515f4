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
from stitch.free_poses import FreePoses, visible_directions
from stitch.repeatability import PoseChannel, Repeatability, covariance_of, estimate, pose_channel
from stitch.solve import Gram, pair_squares

_DRAWS = 200
_NOTHING = (np.zeros((6, 6)), np.zeros((6, 1 + _DRAWS)))


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
    # Column 0 is what was measured; the others are draws of what this scatter alone would give.
    twists = [_measured_and_drawn(e, s) for e, s in zip(evidence, scatter, strict=True)]
    blocks = [_information(e.channel(), s, t) for e, s, t in zip(evidence, scatter, twists, strict=True)]
    xi, covariance = _combine(blocks, prior)
    left_out = []
    outside = np.zeros(2)
    for k, (e, s, t) in enumerate(zip(evidence, scatter, twists, strict=True)):
        for v in range(e.gram.views):
            fewer = e.without(v)
            block = _information(fewer.channel(), s, _drop(t, v)) if len(fewer.gram.pairs) else _NOTHING
            xi_v, _ = _combine([*blocks[:k], block, *blocks[k + 1 :]], prior)
            left_out.append(xi_v)
            outside += e.squares(v, (xi_v[:, 0], xi[:, 0]))
    inflation = _jackknife_inflation(np.array(left_out), covariance)
    xi = xi[:, 0]
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


def _measured_and_drawn(evidence: _Evidence, scatter: Repeatability) -> Array:
    """(6V, 1 + _DRAWS) twists: the measured ones, then draws under the scatter and the noise alone."""
    rng = np.random.default_rng(0)
    g = evidence.gram
    to_centre = frames.make(np.eye(3), -g.centre)
    carried = frames.adjoint(to_centre @ evidence.capture.T_reference_flange)
    sigma = np.array([scatter.rotation] * 3 + [scatter.translation] * 3)
    robot = np.einsum("vij,vjd->vid", carried, sigma[:, None] * rng.standard_normal((g.views, 6, _DRAWS)))
    values, vectors, scale = visible_directions(g)
    noise = np.sqrt(scatter.noise_factor * g.variance / values)[:, None] * rng.standard_normal((len(values), _DRAWS))
    drawn = robot.reshape(6 * g.views, _DRAWS) + scale[:, None] * (vectors @ noise)
    return np.column_stack([evidence.twists.reshape(-1), drawn])


def _drop(twists: Array, v: int) -> Array:
    return np.delete(twists, range(6 * v, 6 * v + 6), axis=0)


def _information(channel: PoseChannel, scatter: Repeatability, twists: Array) -> tuple[Array, Array]:
    """Information matrix (6, 6) and vectors (6, D) of ξ from one pose channel and twists (6V, D)."""
    weighted = np.linalg.solve(covariance_of(channel, scatter), channel.hand_eye).T
    return weighted @ channel.hand_eye, weighted @ channel.left @ twists


def _combine(blocks: Sequence[tuple[Array, Array]], prior: Array) -> tuple[Array, Array]:
    covariance: Array = np.linalg.inv(prior + np.sum([block[0] for block in blocks], axis=0))
    return covariance @ np.sum([block[1] for block in blocks], axis=0), covariance


def _jackknife_inflation(left_out: Array, covariance: Array) -> float:
    """How much more the left-out views move the hand-eye than chance explains, at least 1.

    The mean ratio of the jackknife's covariance to the model's over the six directions, over its
    95 % point under the model: a handful of views makes the jackknife itself uncertain, and taking
    every value above 1 at its word would widen sigmas that are right.

    Args:
        left_out: (L, 6, 1 + draws) estimates with one view left out; column 0 from the measurement.
    """
    count = len(left_out)
    if count < 4:
        return 1.0
    centred = left_out - left_out.mean(axis=0)
    squares = np.einsum("lid,ij,ljd->d", centred, np.linalg.inv(covariance), centred)
    ratio = (count - 1) / count * squares / 6
    return float(max(1.0, ratio[0] / np.quantile(ratio[1:], 0.95)))
