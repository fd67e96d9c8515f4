"""How much more leaving out samples moves estimates than their covariance says (Efron & Stein 1981)."""

import numpy as np

from stitch.frames import Array

# Fewer estimates say nothing about their spread.
_FEWEST = 4


def drawn_inflation(left_out: Array, covariance: Array) -> float:
    """Factor on the covariance, at least 1, read against what the jackknife gives under the model itself.

    The mean ratio of the jackknife's covariance to the model's over all directions, over its lower
    quartile under the model: with a handful of views the jackknife itself reads too large, and taking
    it at its word would widen sigmas that are right; of two readings the cautious one is taken.

    Args:
        left_out: (L, K, 1 + draws) estimates with one sample left out; column 0 from the measurement.
        covariance: (K, K) of the estimates.
    """
    count = len(left_out)
    if count < _FEWEST:
        return 1.0
    centred = left_out - left_out.mean(axis=0)
    scale = np.sqrt(np.diag(covariance))
    precision = np.linalg.inv(covariance / scale[:, None] / scale) / scale[:, None] / scale
    squares = np.einsum("lid,ij,ljd->d", centred, precision, centred, optimize=True)
    ratio = (count - 1) / count * squares / len(covariance)
    return float(max(1.0, ratio[0] / np.quantile(ratio[1:], 0.25)))


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
