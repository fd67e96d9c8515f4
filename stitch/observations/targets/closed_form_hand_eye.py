"""A first hand-eye from labelled points alone, in closed form.

left·(R p + t) = P is linear in R (9), t (3) and P (3 a target): solved by weighted least squares with weights
1/|residual| (which end at the least sum of distances, so that a wrong label pulls little), R projected to a
rotation, t and P solved again. A measured probe adds the turns: A·X = Z·B (Shah 2013).
"""

import numpy as np

from stitch.errors import NoResultError
from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices
from stitch.numerics.hand_eye import shah
from stitch.session.capture import Capture

_REWEIGHTED = 12
# Singular values of the equilibrated system below this share of the largest: the motions do not show it all.
_DEGENERATE = 1e-6


def closed_form_hand_eye(capture: Capture) -> Array:
    """Return T_mount_sensor (4, 4) of a capture with sightings.

    Raises:
        NoResultError: motions or targets that cannot show the hand-eye.
    """
    s = capture.sightings
    assert s is not None
    if s.rotation is not None:
        # T_mount·T_sensor_probe = T_reference_mount⁻¹·T_reference_probe is A·X = Z·B for A = T_reference_mount⁻¹.
        used = s.used.any(axis=1)
        A = frames.inverse(capture.T_reference_mount[used])
        return shah(A, frames.make(s.rotation[used], s.points[used, 0]))[1]
    v, slot = np.nonzero(s.used)
    L = capture.T_reference_mount[v]
    p, target = s.points[v, slot], s.target[v, slot]
    offset = p.mean(axis=0)
    scale = float(np.linalg.norm(p - offset, axis=1).mean()) or 1.0
    R = _solve_rotation_translation(L, (p - offset) / scale, target, len(s.targets), None)
    t = _solve_rotation_translation(L, p - offset, target, len(s.targets), R)[:, 0]
    return frames.make(R, t - R @ offset)


def _solve_rotation_translation(L: Array, p: Array, target: Indices, targets: int, R: Array | None) -> Array:
    """Return the rotation (3, 3) from all unknowns, or the translation (3, 1) with the rotation known.

    Args:
        L: (N, 4, 4) what stands left of the hand-eye, per sighting.
        p: (N, 3) sensor frame.
        target: (N,) which target.
    """
    N, size = len(p), 9 if R is None else 0
    rows = np.zeros((N, 3, size + 3 + 3 * targets))
    right = -L[:, :3, 3]
    if R is None:
        rows[:, :, :9] = np.einsum("nij,nk->nijk", L[:, :3, :3], p).reshape(N, 3, 9)
    else:
        right = right - np.einsum("nij,jk,nk->ni", L[:, :3, :3], R, p)
    rows[:, :, size : size + 3] = L[:, :3, :3]
    for axis in range(3):
        rows[np.arange(N), axis, size + 3 + 3 * target + axis] = -1.0
    used = np.abs(rows).max(axis=(0, 1)) > 0
    weight, x = np.ones(N), np.zeros(rows.shape[2])
    for _ in range(_REWEIGHTED):
        A = (np.sqrt(weight)[:, None, None] * rows[:, :, used]).reshape(3 * N, -1)
        length = np.linalg.norm(A, axis=0)
        U, sv, Vt = np.linalg.svd(A / length, full_matrices=False)
        if R is None and sv[-1] < _DEGENERATE * sv[0]:
            raise NoResultError(
                "these views do not show the hand-eye: turn the flange about two axes at least and show three targets "
                "that are not in one line, or give scanner.pose in session.toml"
            )
        keep = sv > _DEGENERATE * sv[0]
        b = (np.sqrt(weight)[:, None] * right).ravel()
        x[used] = (Vt[keep].T @ ((U[:, keep].T @ b) / sv[keep])) / length
        left = np.linalg.norm(rows @ x - right, axis=1)
        weight = 1 / np.maximum(left, 1e-3 * np.median(left) + 1e-12)
        weight /= weight.mean()
    if R is None:
        return frames.nearest_rotation(x[:9].reshape(3, 3))
    return x[:3, None]
