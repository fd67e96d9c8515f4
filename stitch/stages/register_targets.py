"""Each view moved by its own most likely error, where its labelled points show one."""

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.observations.targets.rows import TargetRows, mixed_model_of_rows


def register_targets(rows: TargetRows, variances: Array, poses: Array) -> tuple[Array, Array]:
    """Poses (V, 4, 4) moved by each view's most likely error, and what is left of its targets, (V, S).

    The most likely twist of a view is C·leverᵀ·V⁻¹·(−left) (best linear unbiased prediction, Robinson 1991).
    """
    V = len(rows.lever)
    to_centre = frames.make(np.eye(3), -rows.centre)
    carried = frames.adjoint(to_centre @ rows.capture.T_reference_flange)
    scatter = carried * np.repeat(variances[:2], 3) @ carried.transpose(0, 2, 1)
    covariance = mixed_model_of_rows(rows, rows.hand_eye).covariance(variances)[:V]
    pushed = np.linalg.solve(covariance, -rows.residual[:V, :, None])
    twist = (scatter @ rows.lever.transpose(0, 2, 1) @ pushed)[..., 0]
    moved = frames.inverse(to_centre) @ frames.exp(twist) @ to_centre @ poses
    left = rows.residual.copy()
    left[:V] += np.einsum("vmi,vi->vm", rows.lever, twist)
    return np.asarray(moved), rows.distances(left)
