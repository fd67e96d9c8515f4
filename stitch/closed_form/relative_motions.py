"""Relative motions of mount and scanner: what they can show, and which way half turns went.

A rotation by θ ≤ π about n is also one by 2π − θ about −n. Near half turns noise decides which of the
two the logarithm returns, for A and for B apart; every solver that pairs their axes needs the same one.
"""

from itertools import product

import numpy as np

from stitch import frames
from stitch.errors import NoResultError
from stitch.frames import Array

# Motions that turn less than this (rad) only translate.
_STILL = 1e-4
# Rotation axes that span less than 3° are parallel for the purpose of a calibration.
_PARALLEL = np.sin(np.radians(3.0))
# No hand-eye data are so noisy that an axis turns round further than this (rad) from a half turn.
_HALF_TURN = 0.5
# Two hand-eyes whose misfits differ by less than this factor cannot be told apart.
_CLEAR = 1.5


def axis_spread(A: Array) -> Array:
    """Singular values (3,) of the stacked rotation axes, each weighted by its angle, over the first."""
    values = np.zeros(3)
    found = np.linalg.svd(frames.log(np.asarray(A))[:, :3], compute_uv=False)
    values[: len(found)] = found
    return values / values[0] if values[0] > _STILL else np.zeros(3)


def require_motion(A: Array) -> None:
    """Refuse motions (N, 4, 4) that cannot show a hand-eye.

    Raises:
        NoResultError: no rotation at all, or all rotations about one axis.
    """
    spread = axis_spread(A)
    if spread[0] == 0:
        raise NoResultError(
            "all views have one orientation, the motions only translate: the hand-eye's translation cannot be found; "
            "to fix: turn the flange both ways"
        )
    if spread[1] < _PARALLEL:
        Vt = np.linalg.svd(frames.log(np.asarray(A))[:, :3], full_matrices=False)[2]
        axis = ", ".join(f"{x:+.2f}" for x in Vt[0])
        raise NoResultError(
            f"all motions turn about one axis ({axis}): translation along it and rotation about it cannot "
            "be found; to fix: add views turned about another axis"
        )


def motions_from_first(G: Array) -> Array:
    """Motions (V − 1, 4, 4) from the first of the poses (V, 4, 4) to each of the others."""
    return frames.inverse(G[:1]) @ G[1:]


def weight_roots(A: Array, weights: Array | None) -> Array:
    """Square roots (M,) of the weights of the motions, ones without weights."""
    return np.ones(len(A)) if weights is None else np.sqrt(np.asarray(weights, float))


def hand_eye_translation(A: Array, B: Array, R: Array, weights: Array | None = None) -> Array:
    """t (3,) of X from (R_A − 1) t = R t_B − t_A, weighted least squares over all motions."""
    return solve_translation(A[:, :3, :3] - np.eye(3), B[:, :3, 3] @ R.T - A[:, :3, 3], weights)


def solve_translation(left: Array, right: Array, weights: Array | None = None) -> Array:
    """t (K,) of left (M, 3, K) · t = right (M, 3), weighted least squares."""
    root = weight_roots(left, weights)[:, None]
    rows = (root[..., None] * left).reshape(right.size, -1)
    return np.asarray(np.linalg.lstsq(rows, (root * right).ravel(), rcond=None)[0])


def matched_rotations(A: Array, B: Array) -> tuple[Array, Array, Array]:
    """Rotation vectors (M, 3) of A and B on the same branch, and the sign (M,) that did it.

    Sign −1 says that B's rotation is taken as the one beyond π about the opposite axis. Only motions
    near a half turn can get it.

    Raises:
        NoResultError: half turns about two axes that fit two different hand-eyes.
    """
    alpha, beta = frames.log(A)[:, :3], frames.log(B)[:, :3]
    length = np.linalg.norm(beta, axis=1)
    open_sign = np.maximum(length, np.linalg.norm(alpha, axis=1)) > np.pi - _HALF_TURN
    sign = np.ones(len(A))
    if not open_sign.any():
        return alpha, beta, sign
    beyond = beta * (1 - 2 * np.pi / np.maximum(length, 1e-12))[:, None]
    R = _branch(A, B, alpha, beta, open_sign)
    worse = np.linalg.norm(alpha - beta @ R.T, axis=1) > np.linalg.norm(alpha - beyond @ R.T, axis=1)
    sign[open_sign & worse] = -1.0
    return alpha, np.where(sign[:, None] < 0, beyond, beta), sign


def _branch(A: Array, B: Array, alpha: Array, beta: Array, open_sign: Array) -> Array:
    """A crude rotation from the widest turn and the one most across it; the open signs by the fit of all motions."""
    i = int(np.linalg.norm(alpha, axis=1).argmax())
    j = int(np.linalg.norm(np.cross(alpha, alpha[i]), axis=1).argmax())
    signs = [(1.0, -1.0) if open_sign[k] else (1.0,) for k in (i, j)]
    candidates = [_triad(alpha[i], alpha[j], s * beta[i], u * beta[j]) for s, u in product(*signs)]
    scores = np.array([_misfit(A, B, R) for R in candidates])
    order = np.argsort(scores)
    best = candidates[order[0]]
    for k in order[1:]:
        apart = np.arccos(np.clip((np.trace(best.T @ candidates[k]) - 1) / 2, -1, 1))
        if apart > 0.5 and scores[k] < _CLEAR**2 * scores[order[0]] + 1e-16:
            raise NoResultError(
                "all motions are half turns and fit two hand-eyes equally well; add views turned by another angle"
            )
    return np.asarray(best)


def _triad(a1: Array, a2: Array, b1: Array, b2: Array) -> Array:
    """Rotation from b to a by two directions (TRIAD, Black 1964)."""

    def basis(u: Array, v: Array) -> Array:
        x = u / np.linalg.norm(u)
        z = np.cross(x, v)
        z = z / max(float(np.linalg.norm(z)), 1e-300)
        return np.column_stack([x, np.cross(z, x), z])

    return np.asarray(basis(a1, a2) @ basis(b1, b2).T)


def _misfit(A: Array, B: Array, R: Array) -> float:
    """Σ|R_A R − R R_B|² + Σ|(R_A − 1)t − R t_B + t_A|² in units of the motions' size: free of branches."""
    rotation = A[:, :3, :3] @ R - R @ B[:, :3, :3]
    t = hand_eye_translation(A, B, R)
    shift = (A[:, :3, :3] - np.eye(3)) @ t - B[:, :3, 3] @ R.T + A[:, :3, 3]
    unit = float(np.abs(np.concatenate([A[:, :3, 3], B[:, :3, 3]])).max()) or 1.0
    return float((rotation**2).sum() + (shift**2).sum() / unit**2)
