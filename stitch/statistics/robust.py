"""Robust scale and weights of residuals."""

import numpy as np

from stitch.frames import Array

MAD_TO_SIGMA = 1.4826
# Tukey's biweight at 4.685 σ keeps 95 % efficiency for normal errors (Holland & Welsch 1977).
_TUKEY = 4.685


def mad_sigma(e: Array) -> float:
    """Robust sigma 1.4826 × median |e| of residuals (N,) that are symmetric about zero."""
    return MAD_TO_SIGMA * float(np.median(np.abs(e)))


def tukey(e: Array, scale: float) -> Array:
    """Biweight of residuals at a robust sigma."""
    return np.asarray(np.clip(1 - (e / (_TUKEY * scale)) ** 2, 0, None) ** 2)
