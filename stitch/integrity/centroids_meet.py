"""How near the clouds' centroids come to one point under the best hand-eye of each hypothesis: a first, cheap judge.

The centroid of a view leans to the side that it sees, by about as much in every view: under right poses the centroids
meet within some hundredths of the part's size, under wrong ones within about all of it. All hypotheses and starts are
minimised side by side (Levenberg 1944; Marquardt 1963).
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from stitch import frames
from stitch.frames import Array
from stitch.integrity.hypotheses import Hypothesis

_STARTS = 12
_CENTROID_STEPS = 40
# Problems minimised at a time: memory.
_BATCH = 4000


def fit_centroids(tried: Sequence[Hypothesis], centroids: Array) -> list[tuple[float, Array]]:
    """Per hypothesis the rms distance of the placed centroids from their mean, and the hand-eye (4, 4).

    Args:
        centroids: (V, 3) of the scans, scanner frame.
    """
    per_batch = max(_BATCH // _STARTS, 1)
    groups = [tried[i : i + per_batch] for i in range(0, len(tried), per_batch)]
    return [pair for group in groups for pair in _fit_batch(group, centroids)]


def _fit_batch(tried: Sequence[Hypothesis], centroids: Array) -> list[tuple[float, Array]]:
    H, V = len(tried), len(centroids)
    poses = np.repeat(np.array([h.T_reference_mount for h in tried]), _STARTS, axis=0)
    used = np.ones((H, V))
    for i, h in enumerate(tried):
        if h.used is not None:
            used[i] = np.isin(np.arange(V), h.used)
    share = np.repeat(used / used.sum(axis=1, keepdims=True), _STARTS, axis=0)
    # Random, yet the same in every run.
    starts = Rotation.random(_STARTS, rng=np.random.default_rng(0)).as_matrix()
    X = frames.make(np.tile(starts, (H, 1, 1)), np.zeros(3))
    X[:, :3, 3] = _best_translation(poses, X, centroids, share)
    cost = _centroid_cost(poses, X, centroids, share)
    damping = np.full(len(X), 1e-3)
    for _ in range(_CENTROID_STEPS):
        step = _centroid_step(poses, X, centroids, share, damping)
        new = X @ frames.exp(step)
        new_cost = _centroid_cost(poses, new, centroids, share)
        better = new_cost < cost
        X = np.where(better[:, None, None], new, X)
        cost = np.where(better, new_cost, cost)
        damping = np.clip(np.where(better, damping / 5, damping * 8), 1e-9, 1e6)
    cost = cost.reshape(H, _STARTS)
    best = np.argmin(cost, axis=1)
    return [(float(np.sqrt(cost[i, b])), X[i * _STARTS + b]) for i, b in enumerate(best)]


def _centroid_residual(poses: Array, X: Array, centroids: Array, share: Array) -> Array:
    """(P, V, 3) placed centroids about their mean."""
    placed = frames.transform(poses @ X[:, None], centroids[None, :, None])[:, :, 0]
    return np.asarray(placed - np.einsum("pv,pvi->pi", share, placed)[:, None])


def _centroid_cost(poses: Array, X: Array, centroids: Array, share: Array) -> Array:
    return np.asarray(np.einsum("pv,pvi->p", share, _centroid_residual(poses, X, centroids, share) ** 2))


def _best_translation(poses: Array, X: Array, centroids: Array, share: Array) -> Array:
    """(P, 3) that brings the centroids closest together while the rotations stay."""
    R = poses[..., :3, :3]
    M = R - np.einsum("pv,pvij->pij", share, R)[:, None]
    r = _centroid_residual(poses, X, centroids, share)
    normal = np.einsum("pv,pvki,pvkj->pij", share, M, M) + 1e-9 * np.eye(3)
    right = np.einsum("pv,pvki,pvk->pi", share, M, r)
    return np.asarray(-np.linalg.solve(normal, right[..., None])[..., 0])


def _centroid_step(poses: Array, X: Array, centroids: Array, share: Array, damping: Array) -> Array:
    """(P, 6) right twists of the hand-eyes."""
    R = (poses @ X[:, None])[..., :3, :3]
    J = np.concatenate([-R @ frames.skew(centroids)[None], R], axis=3)
    J = J - np.einsum("pv,pvij->pij", share, J)[:, None]
    r = _centroid_residual(poses, X, centroids, share)
    normal = np.einsum("pv,pvki,pvkj->pij", share, J, J, optimize=True)
    right = np.einsum("pv,pvki,pvk->pi", share, J, r, optimize=True)
    # Damped by its own diagonal: rotations and translations have scales of their own.
    diagonal = np.einsum("pii->pi", normal)
    floor = 1e-9 * diagonal.max(axis=1, keepdims=True) + 1e-12
    damped = normal + (damping[:, None] * diagonal + floor)[:, :, None] * np.eye(6)
    return np.asarray(-np.linalg.solve(damped, right[..., None])[..., 0])
