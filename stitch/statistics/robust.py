"""Robust scale and weights of residuals."""

import numpy as np

from stitch.frames import Array

MAD_TO_SIGMA = 1.4826
# Tukey's biweight at 4.685 σ keeps 95 % efficiency for normal errors (Holland & Welsch 1977).
_TUKEY = 4.685


def mad_sigma(e: Array) -> float:
    """Robust sigma 1.4826 × median |e| of residuals (N,) that are symmetric about zero."""
    return MAD_TO_SIGMA * float(np.median(np.abs(e)))


def nan_median(values: Array) -> Array:
    """(n,) medians over the first axis of values (m, n) without their NaN; NaN where there is nothing else."""
    known, ordered, column = np.isfinite(values).sum(axis=0), np.sort(values, axis=0), np.arange(values.shape[1])
    low, high = np.maximum(known - 1, 0) // 2, np.minimum(known // 2, len(values) - 1)
    return np.asarray((ordered[low, column] + ordered[high, column]) / 2)


def tukey(e: Array, scale: float) -> Array:
    """Biweight of residuals at a robust sigma."""
    return np.asarray(np.clip(1 - (e / (_TUKEY * scale)) ** 2, 0, None) ** 2)
