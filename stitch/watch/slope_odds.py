"""Whether a parameter has moved steadily since its first session: what no chart can tell that never saw it still."""

import numpy as np

from stitch.frames import Array
from stitch.watch.state_bank import SLOPE, Bank

# The members that believe that nothing moves, and in a steady slope.
STILL, STEADY = 0, 5


def slope_odds(bank: Bank, still: int = STILL, steady: int = STEADY) -> Array:
    """(P,) log odds of a steady slope since the first session over no motion; −inf after something has happened.

    Where nothing moves they exceed log(1/α) with probability α at most, however long one watches (Ville's inequality).
    """
    untouched = bank.covariance[:, still, SLOPE, SLOPE] == 0
    return np.where(untouched, bank.log_likelihood[:, steady] - bank.log_likelihood[:, still], -np.inf)
