"""Robust scale and weights of residuals; tails of distributions, and where they begin.

All are upper tails: P(X > x), and the x beyond which the share p lies. `scipy.stats` has them too, and takes a second
to load.
"""

import numpy as np
from scipy import special

from stitch.numerics.frames import Array

MAD_TO_SIGMA = 1.4826
# Tukey's biweight at 4.685 σ keeps 95 % efficiency for normal errors (Holland & Welsch 1977).
TUKEY = 4.685


def mad_sigma(e: Array) -> float:
    """Return the robust sigma, 1.4826 × median |e|, of residuals (N,) that are symmetric about zero."""
    return MAD_TO_SIGMA * float(np.median(np.abs(e)))


def nan_median(values: Array) -> Array:
    """Return the medians (n,) of the columns of values (m, n), NaN left out; NaN for a column of NaN alone.

    `numpy.nanmedian` does the same, with a Python call for each column.
    """
    known = np.isfinite(values).sum(axis=0)
    ordered, column = np.sort(values, axis=0), np.arange(values.shape[1])
    low, high = np.maximum(known - 1, 0) // 2, np.minimum(known // 2, len(values) - 1)
    return (ordered[low, column] + ordered[high, column]) / 2


def tukey(e: Array, scale: float) -> Array:
    """Return Tukey's biweights (N,), 0 to 1, of residuals e (N,) of robust sigma `scale`: (1 − (e/(TUKEY·scale))²)²."""
    return np.clip(1 - (e / (TUKEY * scale)) ** 2, 0, None) ** 2


def chi2_tail(x: float, degrees: float) -> float:
    """Return P(χ² > x) for a χ² of so many degrees of freedom."""
    return float(special.chdtrc(degrees, x))


def chi2_limit(p: float, degrees: float) -> float:
    """Return the value that a χ² of so many degrees of freedom exceeds with probability p."""
    return float(special.chdtri(degrees, p))


def normal_tail(x: float) -> float:
    """Return P(N(0, 1) > x)."""
    return float(special.ndtr(-x))


def sigmas_among(sigmas: float, count: int) -> float:
    """Return the sigmas that a single normal number needs to be as unlikely as the largest of `count` is at `sigmas`.

    Bonferroni: the upper tails satisfy P(single) = count · P(largest); at most 1/2, so never below 0.
    """
    chance = np.log(max(count, 1)) + float(special.log_ndtr(-sigmas))
    return float(-special.ndtri_exp(min(chance, np.log(0.5))))


def binomial_tail(x: int, count: int, share: float) -> float:
    """Return P(X > x) for the number X of successes in `count` trials, each with probability `share`."""
    return float(special.bdtrc(x, count, share))


def f_tail(x: float, numerator: float, denominator: float) -> float:
    """Return P(F > x) of the F distribution with these degrees of freedom."""
    return float(special.fdtrc(numerator, denominator, x))


def f_limit(p: float, numerator: float, denominator: float) -> float:
    """Return the value that F, with these degrees of freedom, exceeds with probability p."""
    return float(f_limits(np.array(p), numerator, denominator))


def f_limits(p: Array, numerator: float, denominator: float) -> Array:
    """Return the values of F (...) that are exceeded with probabilities p (...), exact for tiny p too.

    By the beta distribution of d₂/(d₂ + d₁ F), with d₁ and d₂ the degrees of freedom of numerator and denominator.
    """
    share = special.betaincinv(denominator / 2, numerator / 2, p)
    return denominator * (1 - share) / (numerator * share)


def noncentral_f_tail(x: float, numerator: float, denominator: float, shift: float) -> float:
    """Return P(F > x) of the noncentral F distribution with noncentrality `shift`."""
    return float(1 - special.ncfdtr(numerator, denominator, shift, x))
