"""What a candidate would leave, in the fit and on views left out, from the sums over pairs: no new matches."""

from dataclasses import dataclass

import numpy as np

from stitch.diagnosis.pose_evidence import PoseEvidence
from stitch.diagnosis.score import Score
from stitch.effects.columns import PointGram
from stitch.frames import Array
from stitch.solve import pair_squares


@dataclass(frozen=True)
class Left:
    """Mean square of what remains over that of the present model."""

    inside: float  # fitted on all views
    heldout: float  # each fold judged by a fit without it
    poses: float  # the same for where the views were freed to, in units of their scatter, without the sensor's noise
    poses_sigma: float  # standard error of `poses` over folds
    steadiness: float  # smallest share of the amplitude that remains when one view is left out; < 0: sign changes


def null_left(evidence: PoseEvidence) -> float:
    """Weighted mean square of the present model, over all pairs."""
    moved = _moved(evidence, evidence.model, _solve(evidence, evidence.model, None))
    return float(pair_squares(evidence.freed.overlaps.gram, moved).sum())


def left_by(evidence: PoseEvidence, scored: Score, points: PointGram | None) -> Left:
    """Add the best form of a candidate to the model, in the linear approximation."""
    X = np.hstack([evidence.model, scored.form.twists])
    own = None if points is None or scored.candidate.points is None else _own(points, scored)
    whole = _solve(evidence, X, None)
    base = null_left(evidence)
    inside = _squares(evidence, X, whole, own).sum() / base
    shares, weights = [], []
    for fold in evidence.folds():
        touched = np.isin(evidence.freed.overlaps.gram.pairs, fold).any(axis=1)
        with_it = _squares(evidence, X, _solve(evidence, X, fold), own)[touched].sum()
        without = _squares(evidence, evidence.model, _solve(evidence, evidence.model, fold), None)[touched].sum()
        shares.append(with_it / max(without, 1e-300))
        weights.append(without)
    return Left(
        float(inside), float(np.average(shares, weights=weights)), *_poses_left(evidence, X),
        _steadiness(evidence, X, whole),
    )  # fmt: skip


def _poses_left(evidence: PoseEvidence, X: Array) -> tuple[float, float]:
    """How far left-out views lie from the prediction with X over that without, squared, and its standard error.

    What a model says of left-out views is judged in the directions of the whitened channel that they alone move.
    """
    with_it, without = list[float](), list[float]()
    for fold in evidence.folds():
        own = _orthonormal(evidence.white_left[:, _columns_of(fold)])
        for columns, out in ((X, with_it), (evidence.model, without)):
            rest = evidence.raw_white_z - evidence.white_left @ (columns @ _solve(evidence, columns, fold))
            out.append(float(np.sum((own.T @ rest) ** 2)))
    a, b = np.array(with_it), np.array(without)
    share = float(a.sum() / max(b.sum(), 1e-300))
    spread = np.sum((a - share * b) ** 2) * len(a) / max(len(a) - 1, 1)
    return share, float(np.sqrt(spread) / max(b.sum(), 1e-300))


def _orthonormal(columns: Array) -> Array:
    U, s, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(U[:, s > 1e-9 * s[0]])


def _columns_of(views: Array) -> Array:
    return np.asarray((6 * np.asarray(views)[:, None] + np.arange(6)).ravel())


def _own(points: PointGram, scored: Score) -> PointGram:
    keep = np.arange(points.residual.shape[1])[scored.candidate.points][scored.form.keep]
    return PointGram(points.vector[:, :, keep], points.residual[:, keep], points.square[:, keep][:, :, keep])


def _solve(evidence: PoseEvidence, X: Array, left_out: Array | None) -> Array:
    """Coefficients of the columns X (6V, k) by generalised least squares without some views."""
    white = evidence.white_left @ X
    if left_out is not None:
        # A view is left out by letting it move freely: six more columns each.
        white = np.hstack([white, evidence.white_left[:, _columns_of(left_out)]])
    scale = np.maximum(np.linalg.norm(white, axis=0), 1e-300)
    return np.asarray((np.linalg.lstsq(white / scale, evidence.raw_white_z, rcond=1e-10)[0] / scale)[: X.shape[1]])


def _moved(evidence: PoseEvidence, X: Array, coefficients: Array) -> Array:
    return np.asarray((X @ coefficients).reshape(-1, 6) - evidence.freed.twists)


def _squares(evidence: PoseEvidence, X: Array, coefficients: Array, points: PointGram | None) -> Array:
    """Σ w e² per pair after the model moved; point effects change e itself and do not move the views."""
    if points is None:
        return pair_squares(evidence.freed.overlaps.gram, _moved(evidence, X, coefficients))
    k = points.residual.shape[1]
    theta, rest = coefficients[-k:], coefficients[:-k]
    moved = _moved(evidence, X[:, :-k], rest)
    g = evidence.freed.overlaps.gram
    difference = moved[g.pairs[:, 0]] - moved[g.pairs[:, 1]]
    cross = np.einsum("pi,pik,k->p", difference, points.vector, theta)
    return np.asarray(
        pair_squares(g, moved) + 2 * points.residual @ theta + 2 * cross
        + np.einsum("k,pkl,l->p", theta, points.square, theta)
    )  # fmt: skip


def _steadiness(evidence: PoseEvidence, X: Array, whole: Array) -> float:
    """A combination of parameters that one view carries alone vanishes without it."""
    size = X.shape[1] - evidence.model.shape[1]
    theta = whole[-size:]
    norm = float(theta @ theta)
    if norm == 0:
        return 0.0
    white = evidence.whiten(X[:, -size:])
    strength = float(np.sum((white @ theta) ** 2))
    shares = [
        float((white @ theta) @ (white @ _solve(evidence, X, np.array([v]))[-size:])) / max(strength, 1e-300)
        for v in range(evidence.freed.overlaps.gram.views)
    ]
    return min(shares)
