"""How far the robot's poses scatter: restricted maximum likelihood on per-view pose estimates.

The points of one view share that view's pose error, so evidence counts in views. The per-view
twists δ̂ (`free_poses.py`) are reduced to the directions the overlaps can see, z, with covariance
σ_r² T_r + σ_t² T_t + c σ² H⁺ (rotation and translation scatter of the flange, and a factor on the
noise within overlaps, whose errors are correlated). Patterson & Thompson (1971), Harville (1977).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch import frames
from stitch.frames import Array, Mask
from stitch.measurement.capture import Capture
from stitch.observations.surfaces.free_poses import UnconstrainedPoses, visible_directions
from stitch.observations.surfaces.gram import Gram
from stitch.statistics.least_squares import column_space, summed_squares
from stitch.statistics.parameter_selection import WhitenedData
from stitch.statistics.restricted_likelihood import MixedModel
from stitch.statistics.variance_components import fit_variances

# Combinations of hand-eye and effects weaker than this share of the strongest are unobservable.
_OBSERVABLE_SHARE = 1e-6


@dataclass(frozen=True)
class ReducedPoses:
    """What overlaps and common targets say about the poses of the views, reduced to n visible directions."""

    reduction: Array  # (n, 6V) from twists of the views to visible directions
    expansion: Array  # (6V, n) back to the shortest twists, a radian as long as what it moves at the part
    z: Array  # (n,) observed twists, reduction @ twists
    hand_eye: Array  # (n, 6) response to the hand-eye's ξ
    rotation: Array  # (n, n) covariance of a unit rotation scatter of the flange
    translation: Array  # (n, n) the same for translation
    noise: Array  # (n, n) covariance of the sensor noise within overlaps


@dataclass(frozen=True)
class Repeatability:
    """Standard deviations of the flange poses and the factor on the noise within overlaps."""

    rotation: float  # rad
    translation: float  # length_unit
    noise_factor: float


def hand_eye_jacobian(hand_eye_frames: Array, centre: Array) -> Array:
    """(6V, 6): left twists of the views about `centre` for a right perturbation of the hand-eye."""
    return np.concatenate(list(frames.adjoint(frames.make(np.eye(3), -centre) @ hand_eye_frames)))


def reduce_poses(g: Gram, twists: Array, hand_eye_frames: Array, T_reference_flange: Array) -> ReducedPoses:
    """Reduce per-view twists to the directions that the overlaps see.

    Args:
        g: normal equations about the part's centre, at the freed poses.
        twists: (V, 6) about that centre, from the model's poses to the freed ones.
        hand_eye_frames: (V, 4, 4) whose adjoint carries a perturbation of the hand-eye into the reference frame.
        T_reference_flange: (V, 4, 4) carries a twist of the flange into the reference frame: identity
            for eye_to_hand, T_base_flange for eye_in_hand.
    """
    values, vectors, scale = visible_directions(g)
    left = vectors.T / scale[None, :]
    to_centre = frames.make(np.eye(3), -g.centre)
    response = left @ hand_eye_jacobian(hand_eye_frames, g.centre)
    carried = frames.adjoint(to_centre @ T_reference_flange)
    rotation, translation = (_unit_scatter(left, carried[:, :, half]) for half in (slice(0, 3), slice(3, 6)))
    expansion = scale[:, None] * vectors
    z, noise = left @ twists.reshape(-1), np.diag(g.variance / values)
    return ReducedPoses(left, expansion, z, response, rotation, translation, noise)


def _unit_scatter(left: Array, carried: Array) -> Array:
    """Covariance of the visible directions for independent unit twists of every view."""
    blocks = left.reshape(len(left), -1, 6).transpose(1, 0, 2) @ carried
    return summed_squares(blocks)


def hand_eye_mixed_model(channel: ReducedPoses, further: Array | None = None) -> MixedModel:
    """The channel as one block; the hand-eye, and `further` columns (n, K), are the free mean."""
    mean = channel.hand_eye if further is None else np.column_stack([channel.hand_eye, further])
    components = np.array([channel.rotation, channel.translation, channel.noise])[:, None]
    return MixedModel(channel.z[None], mean_basis(mean)[None], components)


def mean_basis(columns: Array) -> Array:
    """(n, r) orthonormal basis of the mean's columns (n, K), less what the views cannot tell apart."""
    return column_space(columns, _OBSERVABLE_SHARE)


def estimate_repeatability(channel: ReducedPoses, further: Array | None = None) -> Repeatability:
    """REML of (σ_r, σ_t, c); the hand-eye, and `further` columns (n, K), are the unknown mean."""
    return repeatability_from(fit_variances(hand_eye_mixed_model(channel, further), both_starts=True).variances)


def repeatability_from(variances: Array) -> Repeatability:
    """Standard deviations (rad, length_unit) and noise factor from the three variances (3,)."""
    return Repeatability(float(np.sqrt(variances[0])), float(np.sqrt(variances[1])), float(variances[2]))


def pose_covariance(channel: ReducedPoses, scatter: Repeatability) -> Array:
    """(n, n) covariance of the channel's z."""
    return np.asarray(
        scatter.rotation**2 * channel.rotation
        + scatter.translation**2 * channel.translation
        + scatter.noise_factor * channel.noise
    )


def whiten_captures(
    sessions: Sequence[tuple[Capture, UnconstrainedPoses, Array]], T_mount: Array, values: Array, free: Mask
) -> WhitenedData:
    """All captures of a rig in units of their pose scatter, stacked.

    Args:
        sessions: per capture its freed views and the twists (6V, P) of the effects.
        values: (P,) of the effects at which the views were freed; z is what was seen without them.
        free: (P,) effects that explain scatter.
    """
    out = []
    for capture, f, extra in sessions:
        channel = reduce_poses(f.overlaps.gram, f.twists, capture.hand_eye_frames(T_mount), capture.T_reference_flange)
        further = channel.reduction @ extra
        half = np.linalg.cholesky(pose_covariance(channel, estimate_repeatability(channel, further[:, free])))
        stack = np.column_stack([channel.hand_eye, further, channel.z + further @ values])
        out.append(np.linalg.solve(half, stack))
    everything = np.concatenate(out)
    return WhitenedData(everything[:, :6], everything[:, 6:-1], everything[:, -1])
