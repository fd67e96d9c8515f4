"""How large an amplitude may be over its plausible size: scales of a normal prior, and the share of belief in each.

A mixture of normal distributions has tails that one of them has not (West 1987, Biometrika 74:646): a table of lengths
in which a digit is wrong, or a joint mounted a tooth off, is no reason to believe in nothing at all.
"""

import numpy as np
from scipy.special import logsumexp

from stitch.frames import Array

# What is grossly wrong: one effect of a hundred.
GROSS, _GROSS_SHARE = 30.0, 0.01
# Of plausible size, or grossly wrong.
PLAUSIBLE = {1.0: 1 - _GROSS_SHARE, GROSS: _GROSS_SHARE}
# Of any size: what plausible sizes are is a guess.
ANY_SIZE = dict.fromkeys((1.0, 3.0, 0.3, 0.1), (1 - _GROSS_SHARE) / 4) | {GROSS: _GROSS_SHARE}


def log_mixture(logs: Array, scales: dict[float, float]) -> float:
    """Log evidence over all scales from that of each (s,)."""
    return float(logsumexp(logs, b=np.array(list(scales.values()))))
