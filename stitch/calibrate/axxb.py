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
from stitch.calibrate.motions import axis_spread, matched_rotations, require_motion, translation
from stitch.frames import Array, skew

__all__ = ["SOLVERS", "andreff", "axis_spread", "daniilidis", "horaud_dornaika", "park_martin", "tsai_lenz"]


def _root(A: Array, weights: Array | None) -> Array:
    """Square roots (M,) of the weights."""
    return np.ones(len(A)) if weights is None else np.sqrt(np.asarray(weights, float))


def park_martin(A: Array, B: Array, weights: Array | None = None) -> Array:
    """Log of rotations, orthogonal Procrustes (Park & Martin 1994)."""
    require_motion(A)
    alpha, beta, _ = matched_rotations(A, B)
    R = frames.nearest_rotation((_root(A, weights)[:, None] ** 2 * alpha).T @ beta)
    return frames.make(R, translation(A, B, R, weights))


def tsai_lenz(A: Array, B: Array, weights: Array | None = None) -> Array:
    """Modified Rodrigues vectors, skew(P_A + P_B) P' = P_B − P_A (Tsai & Lenz 1989).

    P' grows without bound where X turns by π. B is therefore seen from four frames, as it is and
    turned by π about x, y, z: in at least one of them X turns by 120° or less.
    """
    require_motion(A)

    def rodrigues(rotation: Array) -> Array:
        angle = np.linalg.norm(rotation, axis=1, keepdims=True)
        return np.asarray(2 * np.sin(angle / 2) * rotation / np.maximum(angle, 1e-12))

    alpha, beta, _ = matched_rotations(A, B)
    root = _root(A, weights)[:, None]
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
    return frames.make(R, translation(A, B, R, weights))


def horaud_dornaika(A: Array, B: Array, weights: Array | None = None) -> Array:
    """Unit quaternion minimising Σ|q n_B − n_A q|² (Horaud & Dornaika 1995)."""
    require_motion(A)
    na, nb, _ = matched_rotations(A, B)
    K = np.zeros((4, 4))
    for a, b, root in zip(na, nb, _root(A, weights), strict=True):
        D = root * (_left(a) - _right(b))
        K += D.T @ D
    q = np.linalg.eigh(K)[1][:, 0]
    R = frames.from_quaternion(np.zeros(3), np.append(q[1:], q[0]))[:3, :3]
    return frames.make(R, translation(A, B, R, weights))


def _left(v: Array) -> Array:
    """Matrix of the product (0, v)·q for q = (w, x, y, z)."""
    out = np.zeros((4, 4))
    out[0, 1:], out[1:, 0], out[1:, 1:] = -v, v, skew(v)
    return out


def _right(v: Array) -> Array:
    """Matrix of the product q·(0, v)."""
    out = np.zeros((4, 4))
    out[0, 1:], out[1:, 0], out[1:, 1:] = -v, v, -skew(v)
    return out


def andreff(A: Array, B: Array, weights: Array | None = None) -> Array:
    """Rotation and translation together by Kronecker products (Andreff, Horaud & Espiau 1999).

    Their system fixes the length of vec R by t_A alone and has only the zero solution where the mount
    does not translate. Here |vec R|² = 3 is imposed, so motions of every kind serve.
    """
    require_motion(A)
    eye = np.eye(3)
    # Lengths and rotation entries share one system: count lengths in units of the motions.
    unit = float(np.linalg.norm(_root(A, weights)[:, None] * B[:, :3, 3])) or 1.0
    turned, moved, right = [], [], []
    for a, b, root in zip(A, B, _root(A, weights), strict=True):
        turned += [root * (np.eye(9) - np.kron(a[:3, :3], b[:3, :3])), root * np.kron(eye, b[None, :3, 3]) / unit]
        moved += [np.zeros((9, 3)), root * (eye - a[:3, :3])]
        right += [np.zeros(9), root * a[:3, 3] / unit]
    system, target, shift = np.vstack(turned), np.concatenate(right), np.linalg.qr(np.vstack(moved))[0]
    # The translation is eliminated; what it cannot explain is left for the rotation.
    system, target = system - shift @ (shift.T @ system), target - shift @ (shift.T @ target)
    vec = _on_sphere(system.T @ system, system.T @ target, np.sqrt(3.0)).reshape(3, 3)
    # Without t_A both signs of vec R solve the system; a rotation has determinant +1.
    R = frames.nearest_rotation(vec * np.sign(np.linalg.det(vec)))
    return frames.make(R, translation(A, B, R, weights))


def _on_sphere(H: Array, g: Array, radius: float) -> Array:
    """Minimiser of xᵀHx − 2gᵀx with |x| = radius (Gander, Golub & von Matt 1989)."""
    n = len(H)
    block = np.block([[H, -np.eye(n)], [-np.outer(g, g) / radius**2, H]])
    values, vectors = np.linalg.eigh(H)
    real = np.linalg.eigvals(block).real
    gap = np.maximum(values - min(float(real.min()), values[0]), 0)
    along = vectors.T @ g
    x = np.where(gap > 1e-12 * values[-1], along / np.maximum(gap, 1e-300), 0.0)
    # Where g has no part along the first eigenvector, the rest of the length lies there.
    missing = max(radius**2 - float(x @ x), 0.0)
    if gap[0] <= 1e-12 * values[-1]:
        x[0] = np.sqrt(missing)
    return np.asarray(vectors @ x)


def daniilidis(A: Array, B: Array, weights: Array | None = None) -> Array:
    """Unit dual quaternions, rotation and translation together (Daniilidis 1999)."""
    require_motion(A)
    unit = float(np.average(np.linalg.norm(B[:, :3, 3], axis=1), weights=weights)) or 1.0
    sign = matched_rotations(A, B)[2]
    rows = []
    for T_a, T_b, s, root in zip(A, B, sign, _root(A, weights), strict=True):
        (a, a_dual), (b, b_dual) = _dual(T_a, unit), _dual(T_b, unit)
        real = root * np.hstack([(a - s * b)[:, None], skew(a + s * b)])
        dual = root * np.hstack([(a_dual - s * b_dual)[:, None], skew(a_dual + s * b_dual)])
        rows += [np.hstack([real, np.zeros((3, 4))]), np.hstack([dual, real])]
    Vt = np.linalg.svd(np.vstack(rows))[2]
    q, q_dual = _combine(Vt[6], Vt[7])
    R = frames.from_quaternion(np.zeros(3), np.append(q[1:], q[0]))[:3, :3]
    t = 2 * (-q_dual[0] * q[1:] + q[0] * q_dual[1:] - np.cross(q_dual[1:], q[1:]))
    return frames.make(R, t * unit)


def _dual(T: Array, unit: float) -> tuple[Array, Array]:
    """Vector parts of the unit dual quaternion of one motion, w ≥ 0."""
    q = frames.to_quaternion(T)
    w, v = q[3], q[:3]
    t = T[:3, 3] / unit
    return v, 0.5 * (w * t + np.cross(t, v))


def _combine(u: Array, v: Array) -> tuple[Array, Array]:
    """The unit dual quaternion λ₁u + λ₂v: |q| = 1 and q·q' = 0 (Daniilidis 1999, eq. 34–35)."""
    a, b, c = u[:4] @ u[4:], u[:4] @ v[4:] + u[4:] @ v[:4], v[:4] @ v[4:]
    ratios = np.roots([a, b, c]).real if abs(a) > 1e-15 else np.array([0.0])
    lengths = ratios**2 * (u[:4] @ u[:4]) + 2 * ratios * (u[:4] @ v[:4]) + v[:4] @ v[:4]
    best = int(np.argmax(lengths))
    scale = 1 / np.sqrt(lengths[best])
    whole = scale * (ratios[best] * u + v)
    return whole[:4], whole[4:]


SOLVERS: dict[str, Callable[..., Array]] = {
    "Tsai-Lenz": tsai_lenz,
    "Park-Martin": park_martin,
    "Horaud-Dornaika": horaud_dornaika,
    "Andreff": andreff,
    "Daniilidis": daniilidis,
}
