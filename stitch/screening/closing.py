"""How near all views come together under the poses of a hypothesis, with the best hand-eye: by centroids, by surfaces.

The centroid of a view leans to the side that it sees, by about as much in every view: under right poses the centroids
meet within some hundredths of the part's size, under wrong ones within about all of it. That is a first, cheap judge:
all hypotheses and starts are minimised side by side (Levenberg 1944; Marquardt 1963). Surfaces judge the best few.
Parts that look alike from several sides, such as plates with holes, close pair by pair in wrong ways, so that too few
motions agree under any hypothesis. All views at once close under the right one alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from stitch.fit.coarse import SCORE_SHARE, icp_from_starts
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.screening.hypotheses import Hypothesis
from stitch.screening.motions import MotionFit
from stitch.session.capture import Capture, part_size

# Hand-eyes that centroids begin with, and steps from there.
_STARTS, _CENTROID_STEPS = 12, 40
# Problems minimised at a time: memory.
_BATCH = 4000
# Another hypothesis is refuted by the surfaces if it leaves this much more between them. Under rows in any order, where
# none is right, the best of 58 readings led by 1.12 at most (four views) and by 1.04 (seven to twelve); right ones led
# by 1.4 to 2.0 where all views overlap, by less where they go all round a part: there the motions decide.
CLEARLY_BETTER = 1.25
# Hypotheses that the surfaces see: those that the motions like best.
_HYPOTHESES_TRIED = 5


@dataclass(frozen=True)
class SurfaceFit:
    """A hypothesis with the hand-eye under which its views fall together best."""

    hypothesis: Hypothesis
    T_mount: Array  # (4, 4)
    misfit: float  # length_unit: rms distance between views, truncated; what it is truncated at where none overlap
    meets: bool  # some views overlap


def hypotheses_by_surface(capture: Capture, ranked: Sequence[MotionFit]) -> tuple[SurfaceFit, ...]:
    """Return the hypotheses about the poses under which surfaces agree clearly better than as stated, best first.

    The first leaves less than 1/`CLEARLY_BETTER` of the misfit as stated, else the result is (). The others leave at
    most `CLEARLY_BETTER` times the misfit of the first.

    Args:
        ranked: hypotheses, the likeliest by the scans' motions first (`rank_hypotheses`); the first few are tried.
    """
    stated = next((fit for fit in ranked if fit.hypothesis.kind == "stated"), None)
    mistakes = [fit for fit in ranked if fit.hypothesis.kind != "stated"][:_HYPOTHESES_TRIED]
    if stated is None or not mistakes:
        return ()
    tried = [stated, *mistakes]
    posed = []
    for fit in tried:
        # The robot's lengths in the scans' unit.
        T = fit.hypothesis.T_base_flange
        scaled = frames.make(T[:, :3, :3], fit.scale * T[:, :3, 3])
        posed.append(replace(fit.hypothesis, T_base_flange=scaled))
    by_centroids = fit_centroids(posed, np.array([scan.points.mean(axis=0) for scan in capture.scans]))
    as_stated, *others = [
        surface_misfit(capture, h, [T_mount, fit.T_mount])
        for h, (_, T_mount), fit in zip(posed, by_centroids, tried, strict=True)
    ]
    best, *others = sorted(others, key=lambda fit: fit.misfit)
    if not best.meets or best.misfit * CLEARLY_BETTER > as_stated.misfit:
        return ()
    return (best, *(fit for fit in others if fit.misfit <= CLEARLY_BETTER * best.misfit))


def surface_misfit(capture: Capture, hypothesis: Hypothesis, starts: Sequence[Array]) -> SurfaceFit:
    """Return the hand-eye under which the surfaces of all views agree best, given a hypothesis about the poses.

    ICP from several hand-eyes; the best end counts. Where no views overlap the misfit is the largest, its truncation.

    Args:
        capture: the scans; its poses are replaced by those of the hypothesis.
        starts: hand-eyes T_mount (4, 4) to begin with.
    """
    posed = replace(capture, T_reference_mount=hypothesis.T_reference_mount)
    if hypothesis.used is not None:
        posed = posed.without(np.setdiff1d(np.arange(len(capture.scans)), hypothesis.used))
    named = [(str(i), T) for i, T in enumerate(starts)]
    ends = icp_from_starts([posed], named, part_size([posed]))
    if not ends:
        return SurfaceFit(hypothesis, np.asarray(starts[0]), SCORE_SHARE * part_size([posed]), False)
    best = min(ends, key=lambda end: end.score)
    return SurfaceFit(hypothesis, best.T_mount, best.score, True)


def fit_centroids(tried: Sequence[Hypothesis], centroids: Array) -> list[tuple[float, Array]]:
    """Return per hypothesis the rms distance of the placed centroids from their mean, and the hand-eye (4, 4).

    Args:
        centroids: (V, 3) of the scans, scanner frame.
    """
    per_batch = max(_BATCH // _STARTS, 1)
    batches = [tried[i : i + per_batch] for i in range(0, len(tried), per_batch)]
    return [fit for batch in batches for fit in _fit_batch(batch, centroids)]


def _fit_batch(tried: Sequence[Hypothesis], centroids: Array) -> list[tuple[float, Array]]:
    """Return per hypothesis the rms (length_unit) of placed centroids about their mean, and the best hand-eye (4, 4).

    Levenberg–Marquardt in `_CENTROID_STEPS` steps of all hypotheses from `_STARTS` rotations at once; a step that
    raises the cost is not taken.

    Args:
        centroids: (V, 3) of the scans, scanner frame.
    """
    count, views = len(tried), len(centroids)
    poses = np.repeat(np.array([h.T_reference_mount for h in tried]), _STARTS, axis=0)
    used = np.ones((count, views))
    for i, h in enumerate(tried):
        if h.used is not None:
            used[i] = np.isin(np.arange(views), h.used)
    share = np.repeat(used / used.sum(axis=1, keepdims=True), _STARTS, axis=0)
    # Random, yet the same in every run.
    starts = Rotation.random(_STARTS, rng=np.random.default_rng(0)).as_matrix()
    X = frames.make(np.tile(starts, (count, 1, 1)), np.zeros(3))
    X[:, :3, 3] = _best_translation(poses, X, centroids, share)
    R, residual = _placed(poses, X, centroids, share)
    cost = _mean_square(residual, share)
    damping = np.full(len(X), 1e-3)
    for _ in range(_CENTROID_STEPS):
        new = X @ frames.exp(_centroid_step(R, residual, centroids, share, damping))
        new_R, new_residual = _placed(poses, new, centroids, share)
        new_cost = _mean_square(new_residual, share)
        better = new_cost < cost
        X[better] = new[better]
        R[better] = new_R[better]
        residual[better] = new_residual[better]
        cost[better] = new_cost[better]
        damping = np.clip(np.where(better, damping / 5, damping * 8), 1e-9, 1e6)
    cost = cost.reshape(count, _STARTS)
    best = np.argmin(cost, axis=1)
    return [(float(np.sqrt(cost[i, b])), X[i * _STARTS + b]) for i, b in enumerate(best)]


def _placed(poses: Array, X: Array, centroids: Array, share: Array) -> tuple[Array, Array]:
    """Return rotations (P, V, 3, 3) of scans placed by P hand-eyes X, and their centroids (P, V, 3) about the mean."""
    R_mount = poses[..., :3, :3].reshape(len(X), -1, 3)
    R = (R_mount @ X[:, :3, :3]).reshape(*share.shape, 3, 3)
    placed = (R @ centroids[..., None])[..., 0] + (R_mount @ X[:, :3, 3:]).reshape(*share.shape, 3) + poses[..., :3, 3]
    return R, placed - share[:, None] @ placed


def _mean_square(residual: Array, share: Array) -> Array:
    return (share * np.einsum("pvi,pvi->pv", residual, residual)).sum(axis=1)


def _best_translation(poses: Array, X: Array, centroids: Array, share: Array) -> Array:
    """Return translations (P, 3) to add to hand-eyes X that bring the centroids closest together; rotations stay.

    Args:
        poses: (P, V, 4, 4) of the mount.
        X: (P, 4, 4) hand-eyes.
        centroids: (V, 3) of the scans, scanner frame.
        share: (P, V) weights of the views, of sum 1.
    """
    R = poses[..., :3, :3]
    M = R - np.einsum("pv,pvij->pij", share, R)[:, None]
    _, r = _placed(poses, X, centroids, share)
    normal = np.einsum("pv,pvki,pvkj->pij", share, M, M) + 1e-9 * np.eye(3)
    right = np.einsum("pv,pvki,pvk->pi", share, M, r)
    return -np.linalg.solve(normal, right[..., None])[..., 0]


def _centroid_step(R: Array, residual: Array, centroids: Array, share: Array, damping: Array) -> Array:
    """Return a damped Gauss–Newton step (Levenberg–Marquardt) of P hand-eyes: right twists (P, 6).

    A centroid c moves by R K with K = (−[c]×, I): R cancels in the squares, and stays in their mean.

    Args:
        R: (P, V, 3, 3) of the scans as they are placed.
        residual: (P, V, 3) of the placed centroids, about their mean.
        centroids: (V, 3) of the scans, scanner frame.
        share: (P, V) weights of the views, of sum 1.
        damping: (P,) as a share of the diagonal.
    """
    views = len(centroids)
    K = np.concatenate([-frames.skew(centroids), np.broadcast_to(np.eye(3), (views, 3, 3))], axis=2)
    weighted = share[..., None, None] * R
    mean = weighted.transpose(0, 2, 1, 3).reshape(-1, 3, 3 * views) @ K.reshape(3 * views, 6)
    squares = share @ (K.transpose(0, 2, 1) @ K).reshape(views, 36)
    normal = squares.reshape(-1, 6, 6) - mean.transpose(0, 2, 1) @ mean
    right = (residual[..., None, :] @ weighted).reshape(-1, 3 * views) @ K.reshape(3 * views, 6)
    # Damped by its own diagonal: rotations and translations have scales of their own.
    diagonal = np.einsum("pii->pi", normal)
    floor = 1e-9 * diagonal.max(axis=1, keepdims=True) + 1e-12
    damped = normal + (damping[:, None] * diagonal + floor)[:, :, None] * np.eye(6)
    return -np.linalg.solve(damped, right[..., None])[..., 0]
