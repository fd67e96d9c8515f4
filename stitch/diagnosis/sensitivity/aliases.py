"""Which candidates are aliases in these views: correlation of what they do, hand-eye and model projected out."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.diagnosis.score import Score
from stitch.frames import Array
from stitch.observations.linear_model import LinearModel


@dataclass(frozen=True)
class Alias:
    """Another effect that could do what this one does."""

    name: str
    correlation: float  # of this one's fitted pattern with the best that the other can do


def effect_pattern(linear: LinearModel, scored: Score) -> Array:
    """(n,) what the fitted candidate does to the views, in units of their scatter."""
    white = linear.residual(scored.form.columns)
    if np.any(scored.values):
        return np.asarray(white @ scored.values)
    # Nothing fitted: the most visible combination of plausible size.
    U, s, _ = np.linalg.svd(white * scored.form.sizes, full_matrices=False)
    return np.asarray(U[:, 0] * s[0])


def alias_matrix(linear: LinearModel, scores: Sequence[Score]) -> Array:
    """(K, K): how much of the fitted pattern of row k the effect of the column can imitate, 0 … 1.

    The other effect may use all its parameters, but none beyond ten times its plausible size.
    """
    patterns = [effect_pattern(linear, s) for s in scores]
    whites = [linear.residual(s.candidate.forms[0].columns) for s in scores]
    out = np.eye(len(scores))
    for i, y in enumerate(patterns):
        for j, (white, scored) in enumerate(zip(whites, scores, strict=True)):
            if i != j:
                out[i, j] = imitated_share(y, white * scored.candidate.forms[0].sizes)
    return out


def aliases_of(k: int, matrix: Array, scores: Sequence[Score], least: float = 0.7) -> list[Alias]:
    """The most similar effects of candidate k."""
    order = np.argsort(-matrix[k])
    return [Alias(scores[j].name, float(matrix[k, j])) for j in order if j != k and matrix[k, j] > least][:5]


def imitated_share(y: Array, X: Array) -> float:
    """How much of a pattern (n,) columns (n, p) of plausible size can do, 0 … 1; nothing at all is like nothing."""
    length = float(np.linalg.norm(y))
    if length == 0 or not X.size:
        return 0.0
    # Ridge at ten plausible sizes: what is invisible cannot be blown up to imitate anything.
    M = X.T @ X + 0.01 * np.eye(X.shape[1])
    fitted = X @ np.linalg.solve(M, X.T @ y)
    alike = float(np.linalg.norm(fitted))
    return float(np.clip(fitted / alike @ (y / length), 0.0, 1.0)) if alike > 0 else 0.0
