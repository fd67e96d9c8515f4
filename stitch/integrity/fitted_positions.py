"""Positions of which a table of poses has lost something, as the scanner's motions have them by A·X = X·B."""

from collections.abc import Collection

import numpy as np

from stitch.frames import Array
from stitch.integrity.relative_scans import RelativeScans
from stitch.measurement.session import Mount

_POSITION_STEPS = 12


def fit_positions(
    R: Array, known: tuple[Array, Array], mount: Mount, motions: RelativeScans, used: Collection[int], R_mount: Array
) -> Array:
    """(V, 3) positions p + Q·u of the flange with the u under which most motions close, least absolute sum (IRLS).

    Args:
        R: (V, 3, 3) rotations of T_base_flange.
        known: p (V, 3) and Q (V, 3, U), length_unit.
        used: views whose motions count.
        R_mount: (3, 3) of the hand-eye.
    """
    p, Q = known
    keep = [i for i, (v, w) in enumerate(motions.pairs) if v in used and w in used]
    v, w = np.array([motions.pairs[i] for i in keep]).T
    back = R[v].transpose(0, 2, 1)
    if mount == "eye_in_hand":
        turned, from_v, from_w = back @ R[w], -back, back
    else:
        turned = R[v] @ R[w].transpose(0, 2, 1)
        from_v, from_w = np.broadcast_to(np.eye(3), turned.shape), -turned
    rows = np.concatenate([turned - np.eye(3), from_v @ Q[v] + from_w @ Q[w]], axis=2)
    fixed = np.einsum("mij,mj->mi", from_v, p[v]) + np.einsum("mij,mj->mi", from_w, p[w])
    right = motions.T[keep][:, :3, 3] @ R_mount.T - fixed
    return np.asarray(p + Q @ _least_absolute(rows, right)[3:])


def _least_absolute(rows: Array, right: Array) -> Array:
    """(U,) least sum of the lengths of rows (M, 3, U) · x − right (M, 3)."""
    weight = np.ones(len(rows))
    for _ in range(_POSITION_STEPS):
        root = np.sqrt(weight)[:, None]
        x = np.linalg.lstsq(
            (root[..., None] * rows).reshape(-1, rows.shape[2]), (root * right).reshape(-1), rcond=1e-9
        )[0]
        left = np.linalg.norm(rows @ x - right, axis=1)
        weight = 1 / np.maximum(left, 1e-3 * np.median(left) + 1e-12)
    return np.asarray(x)
