"""Hand-eye calibration A·X = X·B from relative motions: five closed-form solvers.

A (M, 4, 4) are motions of the robot's mount frame, B (M, 4, 4) those of the scanner between the same
views; X maps scanner coordinates into the mount frame; `weights` (M,), if given, multiply the squares
of each motion. Every solver needs at least two motions whose rotation axes are not parallel; otherwise
the translation along the common axis, and with parallel axes the rotation about it, cannot be found.
Half turns, of the motions or of X, are like any other angle here.
"""

from collections.abc import Callable
from itertools import product

import numpy as np

from stitch.errors import NoResultError
from stitch.numerics import frames
from stitch.numerics.frames import Array, skew

# Relative motions of mount and scanner: what they can show, and which way half turns went.
#
# A rotation by θ ≤ π about n is also one by 2π − θ about −n. Near half turns noise decides which of the
# two the logarithm returns, for A and for B apart; every solver that pairs their axes needs the same one.

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
    return np.linalg.lstsq(rows, (root * right).ravel(), rcond=None)[0].astype(float)


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
    return best


def _triad(a1: Array, a2: Array, b1: Array, b2: Array) -> Array:
    """Rotation from b to a by two directions (TRIAD, Black 1964)."""

    def basis(u: Array, v: Array) -> Array:
        x = u / np.linalg.norm(u)
        z = np.cross(x, v)
        z = z / max(float(np.linalg.norm(z)), 1e-300)
        return np.column_stack([x, np.cross(z, x), z])

    return basis(a1, a2) @ basis(b1, b2).T


def _misfit(A: Array, B: Array, R: Array) -> float:
    """Σ|R_A R − R R_B|² + Σ|(R_A − 1)t − R t_B + t_A|² in units of the motions' size: free of branches."""
    rotation = A[:, :3, :3] @ R - R @ B[:, :3, :3]
    t = hand_eye_translation(A, B, R)
    shift = (A[:, :3, :3] - np.eye(3)) @ t - B[:, :3, 3] @ R.T + A[:, :3, 3]
    unit = float(np.abs(np.concatenate([A[:, :3, 3], B[:, :3, 3]])).max()) or 1.0
    return float((rotation**2).sum() + (shift**2).sum() / unit**2)


# A·X = X·B with rotation and translation in one linear system: Andreff, Daniilidis.


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
    return vectors @ x


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


# Robot-world and hand-eye calibration A·X = Z·B from poses, in closed form.
#
# A (V, 4, 4) and B (V, 4, 4) are poses of the same views, X and Z unknown and constant. For a probe on
# the flange and a sensor in the cell: A = T_base_flange, X = T_flange_probe, Z = T_base_sensor,
# B = T_sensor_probe. For a camera on the flange and a board in the cell: A = T_base_flange,
# X = T_flange_camera, Z = T_base_board, B = T_camera_board inverted, T_board_camera.


def require_poses(A: Array) -> None:
    """Refuse poses (V, 4, 4) whose relative rotations cannot show X and Z.

    Raises:
        NoResultError: fewer than three poses, no rotation, or rotations about one axis alone.
    """
    if len(A) < 3:
        raise NoResultError(
            f"{len(A)} poses cannot show the base and the tool; measure three or more, turned both ways"
        )
    require_motion(motions_from_first(A))


def shah(A: Array, B: Array, weights: Array | None = None) -> tuple[Array, Array]:
    """X, Z (4, 4) of A·X = Z·B from poses (V, 4, 4), by the Kronecker product (Shah 2013).

    n vec R_X = Σ(R_Bᵀ ⊗ R_Aᵀ) vec R_Z: its first singular pair.

    Args:
        weights: (V,) on the squares of each view.

    Raises:
        NoResultError: poses that cannot show both; names the axis they share.
    """
    require_poses(A)
    Ra, Rb = A[:, :3, :3], B[:, :3, :3]
    # Row-major vec: vec(RaᵀZ Rb) = (Raᵀ ⊗ Rbᵀ) vec Z.
    K = np.einsum("v,vji,vlk->ikjl", weight_roots(A, weights) ** 2, Ra, Rb).reshape(9, 9)
    U, _, Vt = np.linalg.svd(K)
    x, z = U[:, 0].reshape(3, 3), Vt[0].reshape(3, 3)
    sign = np.sign(np.linalg.det(x))
    return _with_translations(A, B, frames.nearest_rotation(sign * x), frames.nearest_rotation(sign * z), weights)


def _with_translations(A: Array, B: Array, R_x: Array, R_z: Array, weights: Array | None) -> tuple[Array, Array]:
    """t_X, t_Z from R_A t_X − t_Z = R_Z t_B − t_A, weighted least squares."""
    left = np.concatenate([A[:, :3, :3], np.broadcast_to(-np.eye(3), (len(A), 3, 3))], axis=2)
    t = solve_translation(left, B[:, :3, 3] @ R_z.T - A[:, :3, 3], weights)
    return frames.make(R_x, t[:3]), frames.make(R_z, t[3:])


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
        return 2 * np.sin(angle / 2) * rotation / np.maximum(angle, 1e-12)

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
