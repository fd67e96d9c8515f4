"""Until when a calibration holds: the first time at which a parameter may have left its limits with 5 % probability."""

import numpy as np
from scipy.special import ndtr

from stitch.frames import Array
from stitch.watch.state_bank import Bank, predicted_bank

HORIZON = 180.0  # days that are looked ahead
_RISK = 0.05
_STEPS = 720


def days_valid(bank: Bank, conditions: Array, in_use: Array, limits: Array) -> Array:
    """(P,) days from the last session until a parameter may have left its limits; inf beyond `HORIZON`, 0 where it has.

    What all sessions have in common is in the calibration too, and does not count.

    Args:
        bank: after the last session, one member a parameter.
        conditions: (c,) covariates of the calibration in use.
        in_use: (P,) values in use; NaN where it has none.
        limits: (P,) how far a parameter may be off.
    """
    x = np.concatenate([[1.0, 0.0], conditions])
    ahead = np.linspace(0.0, HORIZON, _STEPS + 1)
    risk = np.zeros((len(ahead), len(in_use)))
    for k, days in enumerate(ahead):
        then = predicted_bank(bank, float(days))
        off = bank.origin + bank.unit * (then.mean[:, 0] @ x) - in_use
        sigma = bank.unit * np.sqrt(np.maximum(x @ then.covariance[:, 0] @ x, 0.0) * bank.scatter[:, 0])
        sigma = np.maximum(sigma, 1e-12 * limits)
        risk[k] = ndtr((off - limits) / sigma) + ndtr((-limits - off) / sigma)
    late = np.nan_to_num(risk) > _RISK
    return np.where(late.any(axis=0), ahead[np.argmax(late, axis=0)], np.inf)
