"""How far the robot's poses scatter: restricted maximum likelihood on per-view pose estimates.

The points of one view share that view's pose error, so evidence counts in views. The per-view
twists δ̂ (`free_poses.py`) are reduced to the directions the overlaps can see, z, with covariance
σ_r² T_r + σ_t² T_t + c σ² H⁺ (rotation and translation scatter of the flange, and a factor on the
noise within overlaps, whose errors are correlated). Patterson & Thompson (1971), Harville (1977).
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from stitch import frames
from stitch.frames import Array
from stitch.free_poses import visible_directions
from stitch.solve import Gram


@dataclass(frozen=True)
class PoseChannel:
    """What the overlaps say about the poses of the views, reduced to n visible directions."""

    left: Array  # (n, 6V) from twists of the views to visible directions
    z: Array  # (n,) observed twists, left @ twists
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


def pose_channel(g: Gram, twists: Array, model_poses: Array, T_reference_flange: Array) -> PoseChannel:
    """Reduce per-view twists to the directions that the overlaps see.

    Args:
        g: normal equations about the part's centre, at the freed poses.
        twists: (V, 6) about that centre, from the model's poses to the freed ones.
        model_poses: T_reference_scanner (V, 4, 4) of robot and hand-eye.
        T_reference_flange: (V, 4, 4) carries a twist of the flange into the reference frame: identity
            for eye_to_hand, T_base_flange for eye_in_hand.
    """
    values, vectors, scale = visible_directions(g)
    left = vectors.T / scale[None, :]
    to_centre = frames.make(np.eye(3), -g.centre)
    response = left @ np.concatenate(list(frames.adjoint(to_centre @ model_poses)))
    carried = frames.adjoint(to_centre @ T_reference_flange)
    rotation, translation = (_scatter(left, carried[:, :, half]) for half in (slice(0, 3), slice(3, 6)))
    return PoseChannel(left, left @ twists.reshape(-1), response, rotation, translation, np.diag(g.variance / values))


def _scatter(left: Array, carried: Array) -> Array:
    """Covariance of the visible directions for independent unit twists of every view."""
    blocks = left.reshape(len(left), -1, 6).transpose(1, 0, 2) @ carried
    return np.asarray(np.einsum("vni,vmi->nm", blocks, blocks))


def estimate(channel: PoseChannel, design: Array | None = None) -> Repeatability:
    """REML of (σ_r, σ_t, c); the hand-eye (or `design`, (n, K)) is the unknown mean."""
    mean = channel.hand_eye if design is None else design
    mean = _column_space(mean)
    spread = float(np.std(channel.z)) or 1e-12
    lever = np.sqrt(np.trace(channel.rotation) / max(np.trace(channel.translation), 1e-300))
    start = np.log([spread / lever, spread, 1.0])
    options = {"xatol": 1e-3, "fatol": 1e-4, "maxiter": 600}
    # Two starts: a scatter that explains everything, and noise that explains everything.
    starts = [start, start + np.log([1e-2, 1e-2, 1.0])]
    bounds = [(s - 16, s + 6) for s in start[:2]] + [(np.log(0.3), np.log(1e4))]
    fits = [
        minimize(_deviance, s, args=(channel, mean), method="Nelder-Mead", bounds=bounds, options=options)
        for s in starts
    ]
    best = min(fits, key=lambda fit: float(fit.fun))
    rotation, translation, factor = np.exp(best.x)
    return Repeatability(float(rotation), float(translation), float(factor))


def covariance_of(channel: PoseChannel, scatter: Repeatability) -> Array:
    """(n, n) covariance of the channel's z."""
    return np.asarray(
        scatter.rotation**2 * channel.rotation
        + scatter.translation**2 * channel.translation
        + scatter.noise_factor * channel.noise
    )


def _deviance(log_parameters: Array, channel: PoseChannel, mean: Array) -> float:
    """−2 × restricted log likelihood, without constants, with the boundary-avoiding penalty.

    With few views the maximum often lies at a scatter of exactly zero, and every sigma after it would
    be too small; a gamma(2, 0) penalty, + log σ_r + log σ_t in the log likelihood, keeps it off the
    boundary by about one standard error (Chung et al. 2013, Psychometrika 78:685).
    """
    try:
        factor = cho_factor(covariance_of(channel, Repeatability(*np.exp(log_parameters))), lower=True)
    except np.linalg.LinAlgError:
        return float("inf")
    whitened = cho_solve(factor, np.column_stack([mean, channel.z]))
    information = mean.T @ whitened[:, :-1]
    score = mean.T @ whitened[:, -1]
    sign, logdet = np.linalg.slogdet(information)
    rest = channel.z @ whitened[:, -1] - score @ np.linalg.solve(information, score)
    penalty = 2 * (log_parameters[0] + log_parameters[1])
    return float(2 * np.log(np.diag(factor[0])).sum() + logdet + rest - penalty) if sign > 0 else float("inf")


def _column_space(design: Array) -> Array:
    """Orthonormal basis of the columns, so that unobservable combinations drop out."""
    scaled = design / np.maximum(np.linalg.norm(design, axis=0), 1e-300)
    U, s, _ = np.linalg.svd(scaled, full_matrices=False)
    return np.asarray(U[:, s > 1e-6 * s[0]])
