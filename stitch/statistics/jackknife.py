"""How much more leaving out samples moves estimates than their covariance says (Efron & Stein 1981)."""

import numpy as np

from stitch.frames import Array

# Fewer estimates say nothing about their spread.
_FEWEST = 4


def grouped_inflation(left_out: Array, covariance: Array) -> float:
    """Factor on the covariance, at least 1: the jackknife's over the model's, mean over all directions.

    Args:
        left_out: (G, K) estimates with one group of samples left out.
        covariance: (K, K) of the estimates.
    """
    count = len(left_out)
    if count < _FEWEST:
        return 1.0
    unit = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    centred = (left_out - left_out.mean(axis=0)) / unit
    values, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    keep = values > 1e-9
    squares = (count - 1) / count * ((centred @ vectors[:, keep]) ** 2).sum(axis=0) / values[keep]
    return float(max(1.0, squares.mean()))
