"""The hand-eye under which the robot's motions A explain those of the scanner B: A·X = X·B, robustly.

Found from pairs of motions (RANSAC; Fischler & Bolles 1981), so that wrong motions of a symmetric part do not count.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from stitch import frames
from stitch.frames import Array, Mask
from stitch.integrity.hypotheses import Hypothesis
from stitch.integrity.relative_scans import RelativeScans

# A motion closes within what no arm exceeds, 10 mrad and 5 mm, beside the registration of two scans.
ROTATION, TRANSLATION_M = 0.015, 0.008
_SAMPLES = 60
# Below so many motions, chance agrees.
FEWEST = 4
# A hypothesis is tried if as many angles of rotation agree as this share of the best one's.
_SCREEN = 0.6


@dataclass(frozen=True)
class MotionFit:
    """A hypothesis with the hand-eye that fits it best."""

    hypothesis: Hypothesis
    T_mount: Array  # (4, 4)
    closed: float  # share of the motions that close
    open: float  # mean truncated square of what is left, 0 (all close exactly) … 1
    scale: float  # of the robot's lengths against the scans', where it was fitted; else 1


def screen_hypotheses(tried: Sequence[Hypothesis], motions: RelativeScans) -> list[Hypothesis]:
    """The first hypothesis, and what could close: motions keep their angle under any hand-eye (Chen 1991)."""
    v, w = np.array(motions.pairs).T
    seen = rotation_angles(motions.T)
    share = []
    for h in tried:
        T = h.T_reference_mount
        used = np.ones(len(T), bool) if h.used is None else np.isin(np.arange(len(T)), h.used)
        kept = used[v] & used[w]
        near = np.abs(rotation_angles(frames.inverse(T[v]) @ T[w]) - seen) < ROTATION
        share.append(float(near[kept].mean()) if kept.any() else 0.0)
    limit = _SCREEN * max(share)
    return [tried[0]] + [h for h, agree in zip(tried[1:], share[1:], strict=True) if agree >= limit]


def rotation_angles(T: Array) -> Array:
    """Angles of rotation (M,) of motions (M, 4, 4)."""
    return np.asarray(np.arccos(np.clip((np.trace(T[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1)))


def fit_motions(hypothesis: Hypothesis, motions: RelativeScans, length: float, *, scaled: bool = False) -> MotionFit:
    """The hand-eye of one hypothesis.

    Args:
        length: what a motion may leave open, length_unit.
        scaled: fit the scale of the robot's lengths too.
    """
    used = set(range(len(hypothesis.T_base_flange)) if hypothesis.used is None else hypothesis.used)
    keep = [i for i, (v, w) in enumerate(motions.pairs) if v in used and w in used]
    T = hypothesis.T_reference_mount
    if len(keep) < FEWEST:
        return MotionFit(hypothesis, np.eye(4), 0.0, 1.0, 1.0)
    A = np.array([frames.inverse(T[v]) @ T[w] for v, w in (motions.pairs[i] for i in keep)])
    B = motions.T[keep]
    R, turned = _rotation(A, B)
    t, s, moved = _translation(A, B, R, turned < ROTATION, scaled)
    near = (turned < ROTATION) & (moved < length)
    left = np.minimum(1.0, (turned / ROTATION) ** 2 + (moved / length) ** 2)
    return MotionFit(hypothesis, frames.make(R, t), float(near.mean()), float(left.mean()), s)


def _rotation(A: Array, B: Array) -> tuple[Array, Array]:
    """R_X (3, 3) and per motion what is left, rad: the best of many pairs, then all that agree."""
    a, b = (frames.log(T)[:, :3] for T in (A, B))
    pairs = list(combinations(range(len(a)), 2))
    step = max(len(pairs) // _SAMPLES, 1)
    i, j = np.array(pairs[::step]).T
    # A third, the common normal, so that two axes determine the rotation.
    left = np.stack([a[i], a[j], np.cross(a[i], a[j])], axis=2)
    right = np.stack([b[i], b[j], np.cross(b[i], b[j])], axis=2)
    R = frames.nearest_rotation(left @ right.transpose(0, 2, 1))
    rest = _angles(A, B, R)
    best = int(np.argmin(np.minimum(rest / ROTATION, 1.0).mean(axis=1)))
    chosen = R[best]
    for _ in range(3):
        near = _angles(A, B, chosen[None])[0] < 2 * ROTATION
        if near.sum() < 2:
            break
        chosen = frames.nearest_rotation(a[near].T @ b[near])
    if _angles(A, B, chosen[None])[0].clip(max=ROTATION).mean() > rest[best].clip(max=ROTATION).mean():
        chosen = R[best]
    return chosen, _angles(A, B, chosen[None])[0]


def _angles(A: Array, B: Array, R: Array) -> Array:
    """(S, M) rad between R_A and R_X R_B R_Xᵀ for S rotations R_X."""
    turned = R[:, None] @ B[None, :, :3, :3] @ R.transpose(0, 2, 1)[:, None]
    off = turned - A[None, :, :3, :3]
    # ‖R₁ − R₂‖_F = 2√2 sin(θ/2).
    return np.asarray(2 * np.arcsin(np.clip(np.linalg.norm(off, axis=(2, 3)) / np.sqrt(8), 0, 1)))


def _translation(A: Array, B: Array, R: Array, near: Mask, scaled: bool) -> tuple[Array, float, Array]:
    """t_X (3,), scale and per motion what is left: R_A t_X + s t_A = R_X t_B + t_X, least absolute sum (IRLS)."""
    M = len(A)
    rows = A[:, :3, :3] - np.eye(3)
    right = np.einsum("ij,mj->mi", R, B[:, :3, 3]) - (0 if scaled else 1) * A[:, :3, 3]
    if scaled:
        rows = np.concatenate([rows, A[:, :3, 3:]], axis=2)
    weight = np.where(near, 1.0, 1e-6)
    x = np.zeros(rows.shape[2])
    for _ in range(12):
        root = np.sqrt(weight)[:, None]
        x = np.linalg.lstsq((root[..., None] * rows).reshape(3 * M, -1), (root * right).reshape(-1), rcond=1e-9)[0]
        left = np.linalg.norm(rows @ x - right, axis=1)
        weight = np.where(near, 1.0, 1e-6) / np.maximum(left, 1e-3 * np.median(left) + 1e-12)
    return x[:3], float(x[3]) if scaled else 1.0, left
