"""The mean of Bayes factors of which one is meant, each as likely before."""

from collections.abc import Sequence

import numpy as np
from scipy.special import logsumexp

from stitch.frames import Array


def log_mean_exp(logs: Sequence[float] | Array) -> Array:
    """(…) log of the mean over n factors, from their logs (n, …)."""
    return np.asarray(logsumexp(logs, axis=0) - np.log(len(logs)))
