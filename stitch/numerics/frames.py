"""Rigid motions SE(3) as 4x4 arrays; `T_a_b` maps coordinates of frame b into frame a.

A twist is ξ = (rotation, translation), rotation first, in rad and length units. All functions
broadcast over leading axes and compute in float64. Formulas: Barfoot, *State Estimation for
Robotics* (2017), chapter 7, reordered to rotation first.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
# Positions in other arrays.
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Below this angle (rad) the closed forms lose digits; their Taylor series to θ⁴ are exact there.
_SMALL_ANGLE = 1e-3
# Elements of a matrix that was written with six digits are off by less.
_RIGID = 1e-5


def skew(v: Array) -> Array:
    """Return cross-product matrices (..., 3, 3) of vectors (..., 3): `skew(v) @ w == cross(v, w)`."""
    v = np.asarray(v, float)
    out = np.zeros((*v.shape, 3))
    out[..., 2, 1], out[..., 0, 2], out[..., 1, 0] = v[..., 0], v[..., 1], v[..., 2]
    return out - np.swapaxes(out, -1, -2)


def make(rotation: Array, translation: Array) -> Array:
    """Return transforms (..., 4, 4) from rotation matrices (..., 3, 3) and translations (..., 3)."""
    rotation, translation = np.asarray(rotation, float), np.asarray(translation, float)
    shape = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    T = np.zeros((*shape, 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = rotation, translation, 1.0
    return T


def _left_jacobian_terms(angle: Array) -> tuple[Array, Array]:
    """Return (1 − cos θ)/θ² and (θ − sin θ)/θ³ of angles θ (...) rad ≥ 0, coefficients of `exp`; by series near 0."""
    small = angle < _SMALL_ANGLE
    safe = np.where(small, 1.0, angle)
    square = angle**2
    first = np.where(small, 0.5 - square / 24 + square**2 / 720, (1 - np.cos(safe)) / safe**2)
    second = np.where(small, 1 / 6 - square / 120 + square**2 / 5040, (safe - np.sin(safe)) / safe**3)
    return first, second


def exp(xi: Array) -> Array:
    """Return transforms (..., 4, 4), the exponential of twists (..., 6).

    R = 1 + sin θ/θ r̂ + (1 − cos θ)/θ² r̂² and t = V ρ with V = 1 + (1 − cos θ)/θ² r̂ + (θ − sin θ)/θ³ r̂², for the
    rotation vector r of length θ, its cross-product matrix r̂, and the translation part ρ.
    """
    xi = np.asarray(xi, float)
    rotation, translation = xi[..., :3], xi[..., 3:]
    angle = np.linalg.norm(rotation, axis=-1)
    first, second = _left_jacobian_terms(angle)
    hat = skew(rotation)
    hat2 = hat @ hat
    sinc = np.sinc(angle / np.pi)
    eye = np.eye(3)
    R = eye + sinc[..., None, None] * hat + first[..., None, None] * hat2
    V = eye + first[..., None, None] * hat + second[..., None, None] * hat2
    return make(R, np.einsum("...ij,...j->...i", V, translation))


def log(T: Array) -> Array:
    """Return twists (..., 6), the logarithm of transforms (..., 4, 4): inverse of `exp`, rotation angle in [0, π]."""
    T = np.asarray(T, float)
    R = T[..., :3, :3]
    rotation = rotations(R).as_rotvec().reshape(*R.shape[:-2], 3)
    angle = np.linalg.norm(rotation, axis=-1)
    first, second = _left_jacobian_terms(angle)
    hat = skew(rotation)
    V = np.eye(3) + first[..., None, None] * hat + second[..., None, None] * (hat @ hat)
    translation = np.linalg.solve(V, T[..., :3, 3:])[..., 0]
    return np.concatenate([rotation, translation], axis=-1)


def inverse(T: Array) -> Array:
    """Return the inverses of rigid transforms (..., 4, 4), without a general matrix inverse."""
    Rt = np.swapaxes(np.asarray(T, float)[..., :3, :3], -1, -2)
    return make(Rt, -np.einsum("...ij,...j->...i", Rt, T[..., :3, 3]))


def adjoint(T: Array) -> Array:
    """Return matrices (..., 6, 6) with `T · exp(ξ) · T⁻¹ = exp(adjoint(T) @ ξ)`, for transforms T (..., 4, 4)."""
    T = np.asarray(T, float)
    R = T[..., :3, :3]
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = R
    out[..., 3:, :3] = skew(T[..., :3, 3]) @ R
    return out


def adjoint_about(centre: Array, T: Array) -> Array:
    """Return matrices (..., 6, 6) from twists in frame b to twists in frame a that turn about its point `centre` (3,).

    Args:
        T: (..., 4, 4) T_a_b.
    """
    return adjoint(make(np.eye(3), -centre) @ T)


def left_jacobian(xi: Array) -> Array:
    """Return J (..., 6, 6) with exp(ξ + δ) ≈ exp(J δ) · exp(ξ) for small twists δ (..., 6), at twists ξ (..., 6).

    By its series Σ ad(ξ)ⁿ/(n+1)! (Barfoot 7.75), up to n = 15: for angles up to 1 rad the rest is below 1e-12.
    """
    xi = np.asarray(xi, float)
    ad = np.zeros((*xi.shape, 6))
    ad[..., :3, :3] = ad[..., 3:, 3:] = skew(xi[..., :3])
    ad[..., 3:, :3] = skew(xi[..., 3:])
    term = out = np.broadcast_to(np.eye(6), ad.shape)
    if not xi.any():
        return np.array(out)
    for n in range(2, 16):
        term = term @ ad / n
        out = out + term
    return out


def transform(T: Array, points: Array) -> Array:
    """Return points (..., N, 3) mapped by transforms T (..., 4, 4): R·point + t."""
    T = np.asarray(T, float)
    out = rotate(T, np.atleast_2d(points))
    # By columns: a sum over rows of three takes longer than the product.
    for i in range(3):
        out[..., i] += T[..., None, i, 3]
    return out


def rotate(T: Array, vectors: Array) -> Array:
    """Return directions (..., N, 3) turned by the rotations of transforms T (..., 4, 4)."""
    # A factor that lies transposed in memory costs a product of thousands of rows three times as much.
    turned = np.ascontiguousarray(np.swapaxes(np.asarray(T, float)[..., :3, :3], -1, -2))
    rows = np.asarray(vectors)
    return rows @ turned


def plane_rows(arms: Array, normals: Array) -> Array:
    """Return (N, 6) by how much each component of a twist moves points along their normals: [arms × normals, normals].

    Args:
        arms: (N, 3) from the point that the twist turns about to each point.
        normals: (N, 3) of unit length, same frame.
    """
    # By columns, each in one piece: np.cross over rows of three takes twice as long.
    out = np.empty((6, len(arms)))
    x, y, z = np.ascontiguousarray(arms.T)
    out[3:] = normals.T
    a, b, c = out[3:]
    out[0], out[1], out[2] = y * c - z * b, z * a - x * c, x * b - y * a
    return out.T


def from_quaternion(position: Array, quaternion: Array) -> Array:
    """Return poses (..., 4, 4) from positions (..., 3) and quaternions (..., 4): x, y, z, w, of any length but 0."""
    x, y, z, w = np.moveaxis(np.asarray(quaternion, float), -1, 0)
    length = np.sqrt(x * x + y * y + z * z + w * w)
    x, y, z, w = x / length, y / length, z / length, w / length
    rows = [
        [x * x - y * y - z * z + w * w, 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), -x * x + y * y - z * z + w * w, 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), -x * x - y * y + z * z + w * w],
    ]
    return make(np.moveaxis(np.array(rows), (0, 1), (-2, -1)), position)


def to_quaternion(T: Array) -> Array:
    """Return quaternions (..., 4) of transforms (..., 4, 4), in the order x, y, z, w, with w ≥ 0."""
    R = np.asarray(T, float)[..., :3, :3]
    quaternion = rotations(R).as_quat(canonical=True)
    return quaternion.reshape(*R.shape[:-2], 4)


def rotations(R: Array) -> Any:
    """Return rotation matrices (..., 3, 3) as one scipy Rotation over all of them, in a flat order.

    scipy is imported here, as it takes a third of a second to load: other threads read scans meanwhile.
    """
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(R.reshape(-1, 3, 3))


def nearest_rotation(matrix: Array) -> Array:
    """Return the rotations (..., 3, 3) closest to matrices (..., 3, 3) in the Frobenius norm: polar factors by SVD."""
    U, _, Vt = np.linalg.svd(np.asarray(matrix, float))
    # An improper factor, of determinant −1, loses least when the direction of the smallest singular value is reversed.
    sign = np.linalg.det(U @ Vt)
    U = U.copy()
    U[..., :, 2] *= np.sign(sign)[..., None]
    return U @ Vt


def is_rigid(T: Array) -> bool:
    """Return True if a matrix (4, 4) is a proper rigid motion within `_RIGID`."""
    T = np.asarray(T, float)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        return False
    R = T[:3, :3]
    orthonormal = np.abs(R @ R.T - np.eye(3)).max() < _RIGID
    return bool(orthonormal and np.linalg.det(R) > 0 and np.abs(T[3] - [0, 0, 0, 1]).max() < _RIGID)


def angle_between(T_a: Array, T_b: Array) -> Array:
    """Return the rotation angles (...,) rad between transforms (..., 4, 4)."""
    R = np.swapaxes(np.asarray(T_a, float)[..., :3, :3], -1, -2) @ np.asarray(T_b, float)[..., :3, :3]
    # R − Rᵀ holds 2 sin θ, the trace 1 + 2 cos θ: together exact at every angle, as the arccosine is not.
    twice_sine = np.linalg.norm([R[..., i, j] - R[..., j, i] for i, j in ((0, 1), (1, 2), (2, 0))], axis=0)
    return np.arctan2(twice_sine, np.trace(R, axis1=-2, axis2=-1) - 1)


def right_jacobian_inverse(rotation: Array) -> Array:
    """Return J⁻¹ (3, 3) with log(exp(r)·exp(φ)) ≈ r + J⁻¹φ for rotation vectors r (3,) and small φ, rad.

    Barfoot, section 7.1.4; by its series near r = 0.
    """
    angle, hat = float(np.linalg.norm(rotation)), skew(rotation)
    if angle < _SMALL_ANGLE:
        return np.eye(3) + hat / 2 + hat @ hat / 12
    return np.eye(3) + hat / 2 + (1 / angle**2 - 1 / (2 * angle * np.tan(angle / 2))) * hat @ hat


def moved_about(centre: Array, twists: Array, T: Array) -> Array:
    """Return poses T_a_b (..., 4, 4) moved by twists (..., 6) in frame a that turn about its point `centre` (3,)."""
    to_centre = make(np.eye(3), -centre)
    return inverse(to_centre) @ exp(twists) @ to_centre @ T


def twists_about(centre: Array, start: Array, end: Array) -> Array:
    """Return twists (..., 6) in frame a, about its point `centre` (3,), that move poses T_a_b `start` to `end`.

    The inverse of `moved_about`, for poses (..., 4, 4).
    """
    to_centre = make(np.eye(3), -centre)
    return log(to_centre @ end @ inverse(to_centre @ start))
