"""Hand-eye calibration A·X = X·B with rotation and translation in one linear system: Andreff, Daniilidis.

Arguments as in `axxb.py`.
"""

import numpy as np

from stitch import frames
from stitch.closed_form.relative_motions import hand_eye_translation, matched_rotations, require_motion, weight_roots
from stitch.frames import Array, skew


def andreff(A: Array, B: Array, weights: Array | None = None) -> Array:
    """Rotation and translation together by Kronecker products (Andreff, Horaud & Espiau 1999).

    Their system fixes the length of vec R by t_A alone and has only the zero solution where the mount
    does not translate. Here |vec R|² = 3 is imposed, so motions of every kind serve.
    """
    require_motion(A)
    eye = np.eye(3)
    # Lengths and rotation entries share one system: count lengths in units of the motions.
    unit = float(np.linalg.norm(weight_roots(A, weights)[:, None] * B[:, :3, 3])) or 1.0
    turned, moved, right = [], [], []
    for a, b, root in zip(A, B, weight_roots(A, weights), strict=True):
        turned += [root * (np.eye(9) - np.kron(a[:3, :3], b[:3, :3])), root * np.kron(eye, b[None, :3, 3]) / unit]
        moved += [np.zeros((9, 3)), root * (eye - a[:3, :3])]
        right += [np.zeros(9), root * a[:3, 3] / unit]
    system, target, shift = np.vstack(turned), np.concatenate(right), np.linalg.qr(np.vstack(moved))[0]
    # The translation is eliminated; what it cannot explain is left for the rotation.
    system, target = system - shift @ (shift.T @ system), target - shift @ (shift.T @ target)
    vec = _on_sphere(system.T @ system, system.T @ target, np.sqrt(3.0)).reshape(3, 3)
    # Without t_A both signs of vec R solve the system; a rotation has determinant +1.
    R = frames.nearest_rotation(vec * np.sign(np.linalg.det(vec)))
    return frames.make(R, hand_eye_translation(A, B, R, weights))


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
    """X (4, 4) from unit dual quaternions, rotation and translation together (Daniilidis 1999)."""
    require_motion(A)
    unit = float(np.average(np.linalg.norm(B[:, :3, 3], axis=1), weights=weights)) or 1.0
    sign = matched_rotations(A, B)[2]
    rows = []
    for T_a, T_b, s, root in zip(A, B, sign, weight_roots(A, weights), strict=True):
        (a, a_dual), (b, b_dual) = _dual_quaternion(T_a, unit), _dual_quaternion(T_b, unit)
        real = root * np.hstack([(a - s * b)[:, None], skew(a + s * b)])
        dual = root * np.hstack([(a_dual - s * b_dual)[:, None], skew(a_dual + s * b_dual)])
        rows += [np.hstack([real, np.zeros((3, 4))]), np.hstack([dual, real])]
    Vt = np.linalg.svd(np.vstack(rows), full_matrices=False)[2]
    q, q_dual = _combine_dual_quaternions(Vt[6], Vt[7])
    R = frames.from_quaternion(np.zeros(3), np.append(q[1:], q[0]))[:3, :3]
    t = 2 * (-q_dual[0] * q[1:] + q[0] * q_dual[1:] - np.cross(q_dual[1:], q[1:]))
    return frames.make(R, t * unit)


def _dual_quaternion(T: Array, unit: float) -> tuple[Array, Array]:
    """Vector parts of the unit dual quaternion of one motion, w ≥ 0."""
    q = frames.to_quaternion(T)
    w, v = q[3], q[:3]
    t = T[:3, 3] / unit
    return v, 0.5 * (w * t + np.cross(t, v))


def _combine_dual_quaternions(u: Array, v: Array) -> tuple[Array, Array]:
    """The unit dual quaternion λ₁u + λ₂v: |q| = 1 and q·q' = 0 (Daniilidis 1999, eq. 34–35)."""
    a, b, c = u[:4] @ u[4:], u[:4] @ v[4:] + u[4:] @ v[:4], v[:4] @ v[4:]
    ratios = np.roots([a, b, c]).real if abs(a) > 1e-15 else np.array([0.0])
    lengths = ratios**2 * (u[:4] @ u[:4]) + 2 * ratios * (u[:4] @ v[:4]) + v[:4] @ v[:4]
    best = int(np.argmax(lengths))
    scale = 1 / np.sqrt(lengths[best])
    whole = scale * (ratios[best] * u + v)
    return whole[:4], whole[4:]
