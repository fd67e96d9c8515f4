"""Hand-eye calibration in closed form: A·X = X·B from relative motions, A·X = Z·B from poses.

For A·X = X·B, A (M, 4, 4) are motions of the robot's mount frame and B (M, 4, 4) those of the scanner between the
same views; X maps scanner coordinates into the mount frame. Two solvers that err differently: `park_martin` pairs the
axes of rotations and adds the translation, `andreff` takes all entries of both as one linear system. Both need two
motions whose rotation axes are not parallel; otherwise the translation along the common axis, and with parallel axes
the rotation about it, cannot be found.

For A·X = Z·B (`shah`), A and B (V, 4, 4) are poses of the same views, X and Z unknown and constant. For a probe on the
flange and a sensor in the cell: A = T_base_flange, X = T_flange_probe, Z = T_base_sensor, B = T_sensor_probe. For a
camera on the flange and a board in the cell: A = T_base_flange, X = T_flange_camera, Z = T_base_board,
B = T_board_camera.

Half turns, of the motions or of X, are like any other
angle here: a rotation by θ ≤ π about n is also one by 2π − θ about −n, near half turns noise decides which of the two
the logarithm returns, for A and for B apart, and a solver that pairs their axes needs the same one.
"""

from collections.abc import Callable
from itertools import product

import numpy as np

from stitch.errors import NoResultError
from stitch.numerics import frames
from stitch.numerics.frames import Array

# Motions that turn less than this (rad) only translate.
_STILL = 1e-4
# Rotation axes that span less than 3° are parallel for the purpose of a calibration.
_PARALLEL = np.sin(np.radians(3.0))
# No hand-eye data are so noisy that an axis turns round further than this (rad) from a half turn.
_HALF_TURN = 0.5
# Two hand-eyes whose misfits differ by less than this factor cannot be told apart.
_CLEAR = 1.5


def park_martin(A: Array, B: Array) -> Array:
    """Return X (4, 4) of A·X = X·B from motions (M, 4, 4): logs of rotations, orthogonal Procrustes.

    Park & Martin 1994, IEEE Trans. Robotics and Automation 10:717.

    R minimises Σ |α − R β|² over rotation vectors α of A and β of B; the translation follows by least squares.

    Args:
        A, B: (M, 4, 4) motions of the mount frame and of the scanner frame between the same views.

    Raises:
        NoResultError: no rotation, or rotations about one axis alone.
    """
    require_motion(A)
    alpha, beta = matched_rotations(A, B)
    R = frames.nearest_rotation(alpha.T @ beta)
    return frames.make(R, _hand_eye_translation(A, B, R))


def andreff(A: Array, B: Array) -> Array:
    """Return X (4, 4) of A·X = X·B, rotation and translation together, by Kronecker products.

    Andreff, Horaud & Espiau 1999. Their system fixes the length of vec R by t_A alone and has only the zero solution
    where the mount does not translate. Here |vec R|² = 3 is imposed, so motions of every kind serve.

    Args:
        A, B: (M, 4, 4) motions of the mount frame and of the scanner frame between the same views.

    Raises:
        NoResultError: no rotation, or rotations about one axis alone.
    """
    require_motion(A)
    # Lengths and rotation entries share one system: count lengths in units of the motions.
    unit = float(np.linalg.norm(B[:, :3, 3])) or 1.0
    # Rows: vec R − (R_A ⊗ R_B) vec R = 0 and (1 ⊗ t_Bᵀ) vec R + (1 − R_A) t = t_A, with row-major vec.
    turned = np.eye(9) - np.einsum("mij,mkl->mikjl", A[:, :3, :3], B[:, :3, :3]).reshape(-1, 9, 9)
    shifted = np.einsum("ij,mk->mijk", np.eye(3), B[:, :3, 3] / unit).reshape(-1, 3, 9)
    system = np.concatenate([turned, shifted], axis=1).reshape(-1, 9)
    target = np.pad(A[:, :3, 3] / unit, ((0, 0), (9, 0))).ravel()
    Q = np.linalg.qr(np.pad(np.eye(3) - A[:, :3, :3], ((0, 0), (9, 0), (0, 0))).reshape(-1, 3))[0]
    # The translation is eliminated; what it cannot explain is left for the rotation.
    system, target = system - Q @ (Q.T @ system), target - Q @ (Q.T @ target)
    vec = minimise_on_sphere(system.T @ system, system.T @ target, np.sqrt(3.0)).reshape(3, 3)
    # Without t_A both signs of vec R solve the system; a rotation has determinant +1.
    R = frames.nearest_rotation(vec * np.sign(np.linalg.det(vec)))
    return frames.make(R, _hand_eye_translation(A, B, R))


def shah(A: Array, B: Array, weights: Array | None = None) -> tuple[Array, Array]:
    """Return X and Z (4, 4) of A·X = Z·B from poses (V, 4, 4), by the Kronecker product (Shah 2013).

    R_X and R_Z are the first pair of singular vectors of Σ R_Aᵀ ⊗ R_Bᵀ, made rotations.

    Args:
        A, B: (V, 4, 4) poses of the same views, as T_base_flange and T_board_camera.
        weights: (V,) on the squares of each view; None: all are equal.

    Raises:
        NoResultError: fewer than three poses, or poses that cannot show both; names the axis they share.
    """
    if len(A) < 3:
        raise NoResultError(
            f"{len(A)} poses cannot show the base and the tool; measure three or more, turned both ways"
        )
    require_motion(motions_from_first(A))
    Ra, Rb = A[:, :3, :3], B[:, :3, :3]
    # Row-major vec: vec(RaᵀZ Rb) = (Raᵀ ⊗ Rbᵀ) vec Z.
    K = np.einsum("v,vji,vlk->ikjl", weight_roots(A, weights) ** 2, Ra, Rb).reshape(9, 9)
    U, _, Vt = np.linalg.svd(K)
    x, z = U[:, 0].reshape(3, 3), Vt[0].reshape(3, 3)
    sign = np.sign(np.linalg.det(x))
    R_x, R_z = frames.nearest_rotation(sign * x), frames.nearest_rotation(sign * z)
    # t_X and t_Z from R_A t_X − t_Z = R_Z t_B − t_A.
    left = np.concatenate([Ra, np.broadcast_to(-np.eye(3), (len(A), 3, 3))], axis=2)
    t = _solve_translation(left, B[:, :3, 3] @ R_z.T - A[:, :3, 3], weights)
    return frames.make(R_x, t[:3]), frames.make(R_z, t[3:])


def axis_spread(A: Array) -> Array:
    """Return the singular values (3,) of the rotation vectors of motions A (M, 4, 4), divided by the largest.

    (1, 0, 0): all turn about one axis. (0, 0, 0): none turns.
    """
    values = np.zeros(3)
    singular = np.linalg.svd(frames.log(np.asarray(A))[:, :3], compute_uv=False)
    values[: len(singular)] = singular
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
    """Return motions (V − 1, 4, 4) from the first of the poses (V, 4, 4) to each of the others."""
    return frames.inverse(G[:1]) @ G[1:]


def weight_roots(A: Array, weights: Array | None) -> Array:
    """Return square roots (V,) of the weights of poses or motions A, ones without weights."""
    return np.ones(len(A)) if weights is None else np.sqrt(np.asarray(weights, float))


def minimise_on_sphere(H: Array, g: Array, radius: float) -> Array:
    """Return the x (n,) that minimises xᵀHx − 2gᵀx with |x| = radius (Gander, Golub & von Matt 1989).

    It solves (H − λ) x = g with the smallest real eigenvalue λ of a 2n × 2n matrix; λ is at most that of H.

    Args:
        H: (n, n) symmetric, positive semidefinite.
        g: (n,).
    """
    n = len(H)
    block = np.block([[H, -np.eye(n)], [-np.outer(g, g) / radius**2, H]])
    values, vectors = np.linalg.eigh(H)
    multiplier = min(float(np.linalg.eigvals(block).real.min()), values[0])
    gap = np.maximum(values - multiplier, 0)
    # In the eigenvectors of H.
    x = np.where(gap > 1e-12 * values[-1], vectors.T @ g / np.maximum(gap, 1e-300), 0.0)
    # Where g has no part along the first eigenvector, the rest of the length lies there.
    if gap[0] <= 1e-12 * values[-1]:
        x[0] = np.sqrt(max(radius**2 - float(x @ x), 0.0))
    return vectors @ x


def _hand_eye_translation(A: Array, B: Array, R: Array) -> Array:
    """Return t (3,) of X from (R_A − 1) t = R t_B − t_A, least squares over all motions."""
    return _solve_translation(A[:, :3, :3] - np.eye(3), B[:, :3, 3] @ R.T - A[:, :3, 3])


def _solve_translation(left: Array, right: Array, weights: Array | None = None) -> Array:
    """Return t (K,) of left (M, 3, K) · t = right (M, 3), weighted least squares."""
    root = weight_roots(left, weights)[:, None]
    rows = (root[..., None] * left).reshape(right.size, -1)
    return np.linalg.lstsq(rows, (root * right).ravel(), rcond=None)[0].astype(float)


def matched_rotations(A: Array, B: Array) -> tuple[Array, Array]:
    """Return rotation vectors (M, 3) of A and (M, 3) of B that are rotated copies of each other, rad.

    Near a half turn noise decides about which of two opposite axes a logarithm turns. There B's vector is replaced by
    the one of 2π − θ about the opposite axis, where that fits A's better.

    Args:
        A, B: (M, 4, 4) motions of the mount frame and of the scanner frame.

    Raises:
        NoResultError: half turns about two axes that fit two different hand-eyes.
    """
    alpha, beta = frames.log(A)[:, :3], frames.log(B)[:, :3]
    angle = np.linalg.norm(beta, axis=1)
    is_half_turn = np.maximum(angle, np.linalg.norm(alpha, axis=1)) > np.pi - _HALF_TURN
    if not is_half_turn.any():
        return alpha, beta
    opposite = beta * (1 - 2 * np.pi / np.maximum(angle, 1e-12))[:, None]
    R = _crude_rotation(A, B, alpha, beta, is_half_turn)
    is_worse = np.linalg.norm(alpha - beta @ R.T, axis=1) > np.linalg.norm(alpha - opposite @ R.T, axis=1)
    return alpha, np.where((is_half_turn & is_worse)[:, None], opposite, beta)


def _crude_rotation(A: Array, B: Array, alpha: Array, beta: Array, is_half_turn: Array) -> Array:
    """Return R (3, 3) with α ≈ R β, from two motions: the widest turn, and the one most across it.

    A motion near a half turn leaves the sign of its axis open: of the two or four rotations that result, the one that
    fits all motions best is returned.

    Args:
        A, B: (M, 4, 4) motions.
        alpha, beta: (M, 3) their rotation vectors, rad.
        is_half_turn: (M,) mask of the motions near a half turn.

    Raises:
        NoResultError: a clearly different rotation fits nearly as well.
    """
    i = int(np.linalg.norm(alpha, axis=1).argmax())
    j = int(np.linalg.norm(np.cross(alpha, alpha[i]), axis=1).argmax())
    signs = [(1.0, -1.0) if is_half_turn[k] else (1.0,) for k in (i, j)]
    candidates = [_triad(alpha[i], alpha[j], s * beta[i], u * beta[j]) for s, u in product(*signs)]
    scores = np.array([_misfit(A, B, R) for R in candidates])
    order = np.argsort(scores)
    best = candidates[order[0]]
    for k in order[1:]:
        angle = np.arccos(np.clip((np.trace(best.T @ candidates[k]) - 1) / 2, -1, 1))
        # Candidates within half a radian are one rotation, found twice; `_misfit` is a square, so the ratio is too.
        if angle > 0.5 and scores[k] < _CLEAR**2 * scores[order[0]] + 1e-16:
            raise NoResultError(
                "all motions are half turns and fit two hand-eyes equally well; add views turned by another angle"
            )
    return best


def _triad(a1: Array, a2: Array, b1: Array, b2: Array) -> Array:
    """Return the rotation R (3, 3) with R b1 ∥ a1, and R b2 in the plane of a1 and a2 (TRIAD, Black 1964).

    Args:
        a1, a2, b1, b2: (3,) directions of any length.
    """

    def basis(u: Array, v: Array) -> Array:
        """Return orthonormal axes (3, 3) as columns: x along u, y in the plane of u and v, z across it."""
        x = u / np.linalg.norm(u)
        z = np.cross(x, v)
        z = z / max(float(np.linalg.norm(z)), 1e-300)
        return np.column_stack([x, np.cross(z, x), z])

    return basis(a1, a2) @ basis(b1, b2).T


def _misfit(A: Array, B: Array, R: Array) -> float:
    """Return Σ|R_A R − R R_B|² + Σ|(R_A − 1)t − R t_B + t_A|² of a hand-eye rotation R (3, 3) over motions (M, 4, 4).

    Lengths count in units of the largest translation. Unlike rotation vectors, matrices have no sign left open.
    """
    rotation = A[:, :3, :3] @ R - R @ B[:, :3, :3]
    t = _hand_eye_translation(A, B, R)
    shift = (A[:, :3, :3] - np.eye(3)) @ t - B[:, :3, 3] @ R.T + A[:, :3, 3]
    unit = float(np.abs(np.concatenate([A[:, :3, 3], B[:, :3, 3]])).max()) or 1.0
    return float((rotation**2).sum() + (shift**2).sum() / unit**2)


AXXB_SOLVERS: dict[str, Callable[..., Array]] = {"Park-Martin": park_martin, "Andreff": andreff}
