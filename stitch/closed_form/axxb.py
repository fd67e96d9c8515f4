"""Hand-eye calibration A·X = X·B from relative motions: five closed-form solvers.

A (M, 4, 4) are motions of the robot's mount frame, B (M, 4, 4) those of the scanner between the same
views; X maps scanner coordinates into the mount frame; `weights` (M,), if given, multiply the squares
of each motion. Every solver needs at least two motions whose rotation axes are not parallel; otherwise
the translation along the common axis, and with parallel axes the rotation about it, cannot be found.
Half turns, of the motions or of X, are like any other angle here.
"""

from collections.abc import Callable

import numpy as np

from stitch import frames
from stitch.closed_form.axxb_simultaneous import andreff, daniilidis
from stitch.closed_form.relative_motions import hand_eye_translation, matched_rotations, require_motion, weight_roots
from stitch.frames import Array, skew

__all__ = ["AXXB_SOLVERS", "andreff", "daniilidis", "horaud_dornaika", "park_martin", "tsai_lenz"]


def park_martin(A: Array, B: Array, weights: Array | None = None) -> Array:
    """X (4, 4) of A·X = X·B from motions (N, 4, 4): logs of rotations, orthogonal Procrustes (Park & Martin 1994).

    Args:
        weights: (N,) on the squares of each motion, as in all solvers here.

    Raises:
        NoResultError: no rotation, or rotations about one axis alone; so do all solvers here.
    """
    require_motion(A)
    alpha, beta, _ = matched_rotations(A, B)
    R = frames.nearest_rotation((weight_roots(A, weights)[:, None] ** 2 * alpha).T @ beta)
    return frames.make(R, hand_eye_translation(A, B, R, weights))


def tsai_lenz(A: Array, B: Array, weights: Array | None = None) -> Array:
    """X (4, 4) from modified Rodrigues vectors, skew(P_A + P_B) P' = P_B − P_A (Tsai & Lenz 1989).

    P' grows without bound where X turns by π. B is therefore seen from four frames, as it is and
    turned by π about x, y, z: in at least one of them X turns by 120° or less.
    """
    require_motion(A)

    def rodrigues(rotation: Array) -> Array:
        angle = np.linalg.norm(rotation, axis=1, keepdims=True)
        return np.asarray(2 * np.sin(angle / 2) * rotation / np.maximum(angle, 1e-12))

    alpha, beta, _ = matched_rotations(A, B)
    root = weight_roots(A, weights)[:, None]
    pa, pb = root * rodrigues(alpha), root * rodrigues(beta)
    flips = [np.eye(3), *(np.diag(d) for d in ([1.0, -1, -1], [-1.0, 1, -1], [-1.0, -1, 1]))]
    condition = [np.linalg.svd(skew(pa + pb @ flip).reshape(-1, 3), compute_uv=False)[-1] for flip in flips]
    flip = flips[int(np.argmax(condition))]
    pb = pb @ flip
    # Their sign of P' belongs to the inverse; this one gives R_A = R R_B Rᵀ.
    half = np.linalg.lstsq(skew(pa + pb).reshape(-1, 3), (pb - pa).reshape(-1), rcond=None)[0]
    P = 2 * half / np.sqrt(1 + half @ half)
    R = (1 - P @ P / 2) * np.eye(3) + 0.5 * (np.outer(P, P) + np.sqrt(4 - P @ P) * skew(P))
    R = R @ flip
    return frames.make(R, hand_eye_translation(A, B, R, weights))


def horaud_dornaika(A: Array, B: Array, weights: Array | None = None) -> Array:
    """X (4, 4) from the unit quaternion minimising Σ|q n_B − n_A q|² (Horaud & Dornaika 1995)."""
    require_motion(A)
    na, nb, _ = matched_rotations(A, B)
    K = np.zeros((4, 4))
    for a, b, root in zip(na, nb, weight_roots(A, weights), strict=True):
        D = root * (_left_product(a) - _right_product(b))
        K += D.T @ D
    q = np.linalg.eigh(K)[1][:, 0]
    R = frames.from_quaternion(np.zeros(3), np.append(q[1:], q[0]))[:3, :3]
    return frames.make(R, hand_eye_translation(A, B, R, weights))


def _left_product(v: Array) -> Array:
    """Matrix of the product (0, v)·q for q = (w, x, y, z)."""
    out = np.zeros((4, 4))
    out[0, 1:], out[1:, 0], out[1:, 1:] = -v, v, skew(v)
    return out


def _right_product(v: Array) -> Array:
    """Matrix of the product q·(0, v)."""
    out = np.zeros((4, 4))
    out[0, 1:], out[1:, 0], out[1:, 1:] = -v, v, -skew(v)
    return out


AXXB_SOLVERS: dict[str, Callable[..., Array]] = {
    "Tsai-Lenz": tsai_lenz,
    "Park-Martin": park_martin,
    "Horaud-Dornaika": horaud_dornaika,
    "Andreff": andreff,
    "Daniilidis": daniilidis,
}
