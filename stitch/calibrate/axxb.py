"""Hand-eye calibration A·X = X·B from relative motions: five closed-form solvers.

A (M, 4, 4) are motions of the robot's mount frame, B (M, 4, 4) those of the scanner between the same
views; X maps scanner coordinates into the mount frame. Every solver needs at least two motions whose
rotation axes are not parallel; otherwise the translation along the common axis, and with parallel
axes the rotation about it, cannot be found.
"""

from collections.abc import Callable

import numpy as np

from stitch import frames
from stitch.errors import NoResultError
from stitch.frames import Array, skew

# Rotation axes that span less than 3° are parallel for the purpose of a calibration.
_PARALLEL = np.sin(np.radians(3.0))


def axis_spread(A: Array) -> Array:
    """Singular values (3,) of the stacked rotation axes, each weighted by its angle, over the first."""
    rotation = frames.log(np.asarray(A))[:, :3]
    values = np.linalg.svd(rotation, compute_uv=False)
    values = np.append(values, np.zeros(3 - len(values))) if len(values) < 3 else values
    return np.asarray(values / max(values[0], 1e-300)) if values[0] > 1e-6 else np.zeros(3)


def require_motion(A: Array) -> None:
    """Refuse motions that cannot show a hand-eye.

    Raises:
        NoResultError: no rotation at all, or all rotations about one axis.
    """
    spread = axis_spread(A)
    if spread[0] == 0:
        raise NoResultError("the motions only translate: the hand-eye's translation cannot be found; turn the flange")
    if spread[1] < _PARALLEL:
        _U, _s, Vt = np.linalg.svd(frames.log(np.asarray(A))[:, :3])
        axis = ", ".join(f"{x:+.2f}" for x in Vt[0])
        raise NoResultError(
            f"all motions turn about one axis ({axis}): translation along it and rotation about it cannot "
            "be found; add views turned about another axis"
        )


def translation(A: Array, B: Array, R: Array) -> Array:
    """t of X from (R_A − 1) t = R t_B − t_A, least squares over all motions."""
    left = (A[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right = (B[:, :3, 3] @ R.T - A[:, :3, 3]).reshape(-1)
    return np.asarray(np.linalg.lstsq(left, right, rcond=None)[0])


def park_martin(A: Array, B: Array) -> Array:
    """Log of rotations, orthogonal Procrustes (Park & Martin 1994)."""
    require_motion(A)
    alpha, beta = frames.log(A)[:, :3], frames.log(B)[:, :3]
    R = frames.nearest_rotation(alpha.T @ beta)
    return frames.make(R, translation(A, B, R))


def tsai_lenz(A: Array, B: Array) -> Array:
    """Modified Rodrigues vectors, skew(P_A + P_B) P' = P_B − P_A (Tsai & Lenz 1989)."""
    require_motion(A)

    def rodrigues(T: Array) -> Array:
        rotation = frames.log(T)[:, :3]
        angle = np.linalg.norm(rotation, axis=1, keepdims=True)
        return np.asarray(2 * np.sin(angle / 2) * rotation / np.maximum(angle, 1e-12))

    # Their P is that of X⁻¹-free form: P_A = R P_B, so (P_A + P_B) x P' = P_B − P_A gives X's own.
    pa, pb = rodrigues(A), rodrigues(B)
    half = np.linalg.lstsq(skew(pa + pb).reshape(-1, 3), (pa - pb).reshape(-1), rcond=None)[0]
    half = -half
    P = 2 * half / np.sqrt(1 + half @ half)
    R = (1 - P @ P / 2) * np.eye(3) + 0.5 * (np.outer(P, P) + np.sqrt(4 - P @ P) * skew(P))
    return frames.make(R, translation(A, B, R))


def horaud_dornaika(A: Array, B: Array) -> Array:
    """Unit quaternion minimising Σ|q n_B − n_A q|² (Horaud & Dornaika 1995)."""
    require_motion(A)
    na, nb = frames.log(A)[:, :3], frames.log(B)[:, :3]
    K = np.zeros((4, 4))
    for a, b in zip(na, nb, strict=True):
        D = _left(a) - _right(b)
        K += D.T @ D
    q = np.linalg.eigh(K)[1][:, 0]
    R = frames.from_quaternion(np.zeros(3), np.append(q[1:], q[0]))[:3, :3]
    return frames.make(R, translation(A, B, R))


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


def andreff(A: Array, B: Array) -> Array:
    """Rotation and translation together by Kronecker products (Andreff, Horaud & Espiau 1999)."""
    require_motion(A)
    eye = np.eye(3)
    blocks, right = [], []
    for a, b in zip(A, B, strict=True):
        top = np.hstack([np.eye(9) - np.kron(a[:3, :3], b[:3, :3]), np.zeros((9, 3))])
        bottom = np.hstack([np.kron(eye, b[None, :3, 3]), eye - a[:3, :3]])
        blocks.append(np.vstack([top, bottom]))
        right.append(np.concatenate([np.zeros(9), a[:3, 3]]))
    # Lengths and rotation entries share one system: count lengths in units of the motions.
    unit = float(np.linalg.norm(B[:, :3, 3])) or 1.0
    system, target = np.vstack(blocks), np.concatenate(right)
    rows = np.tile([False] * 9 + [True] * 3, len(A))
    system[rows] /= unit
    target[rows] /= unit
    system[:, 9:] *= unit
    R = frames.nearest_rotation(np.linalg.lstsq(system, target, rcond=None)[0][:9].reshape(3, 3))
    return frames.make(R, translation(A, B, R))


def daniilidis(A: Array, B: Array) -> Array:
    """Unit dual quaternions, rotation and translation together (Daniilidis 1999)."""
    require_motion(A)
    unit = float(np.mean(np.linalg.norm(B[:, :3, 3], axis=1))) or 1.0
    rows = []
    for T_a, T_b in zip(A, B, strict=True):
        (a, a_dual), (b, b_dual) = _dual(T_a, unit), _dual(T_b, unit)
        zero = np.zeros((3, 4))
        real = np.hstack([(a - b)[:, None], skew(a + b)])
        dual = np.hstack([(a_dual - b_dual)[:, None], skew(a_dual + b_dual)])
        rows += [np.hstack([real, zero]), np.hstack([dual, real])]
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


SOLVERS: dict[str, Callable[[Array, Array], Array]] = {
    "Tsai-Lenz": tsai_lenz,
    "Park-Martin": park_martin,
    "Horaud-Dornaika": horaud_dornaika,
    "Andreff": andreff,
    "Daniilidis": daniilidis,
}
