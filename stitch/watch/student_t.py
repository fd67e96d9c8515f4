"""Numbers of Student's t distribution, elementwise, without the library of all distributions."""

import numpy as np
from scipy.special import gammaln, ndtri, stdtr

from stitch.frames import Array


def student_log_density(e: Array, spread: Array, freedom: Array) -> Array:
    """(...,) log density of t = e/spread as one of e, up to a constant; `freedom` are the degrees of freedom."""
    told = gammaln((freedom + 1) / 2) - gammaln(freedom / 2) - np.log(freedom) / 2 - np.log(spread)
    return np.asarray(told - (freedom + 1) / 2 * np.log1p((e / spread) ** 2 / freedom))


def normal_equivalent(t: Array, freedom: Array) -> Array:
    """(...,) numbers of Student's t as normal numbers of the same probability."""
    return np.asarray(-np.sign(t) * ndtri(np.maximum(stdtr(freedom, -np.abs(t)), 1e-300)))
