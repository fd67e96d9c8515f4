"""Robot-world and hand-eye calibration A·X = Z·B from poses, in closed form.

A (V, 4, 4) and B (V, 4, 4) are poses of the same views, X and Z unknown and constant. For a probe on
the flange and a sensor in the cell: A = T_base_flange, X = T_flange_probe, Z = T_base_sensor,
B = T_sensor_probe. For a camera on the flange and a board in the cell: A = T_base_flange,
X = T_flange_camera, Z = T_base_board, B = T_camera_board inverted, T_board_camera.
"""

import numpy as np

from stitch import frames
from stitch.closed_form.relative_motions import motions_from_first, require_motion, solve_translation, weight_roots
from stitch.errors import NoResultError
from stitch.frames import Array


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
