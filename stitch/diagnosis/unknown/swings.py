"""A flange that swings to and fro in time, as a law without a name.

A cabinet that cools in turns, air that is conditioned in turns, a part that breathes: errors of views half a period
apart are opposite, which no process that forgets can be. Beside such a prior they count as white scatter, and a model
that leaves 0.1 mrad of them was adequate; or an effect that goes with time got its name from a part of a swing.
"""

import numpy as np

from stitch.diagnosis.thresholds import ODDS, PRIOR_UNKNOWN
from stitch.diagnosis.unknown.process_size import FittedProcess, at_likeliest_size, fitted
from stitch.diagnosis.unknown.smooth_processes import swinging
from stitch.observations.linear_model import LinearModel

# Of all periods those whose size is sought with all variances.
_FITTED = 3
# What a size that is wanted costs beside one that is known, nats: as of a joint's law (`joint_laws.py`).
_WIDTH = 3.0


def likeliest_swing(linear: LinearModel) -> tuple[float, FittedProcess] | None:
    """Period, in steps from view to view, and fit of the likeliest swing beside a model; its log Bayes factor is
    charged for all periods that were tried and for the width of its prior. None where poses have no prior of errors,
    or no two swings fit into the session."""
    if linear.pose_errors is None:
        return None
    found = [(period, at_likeliest_size(linear, process)) for period, process in swinging(linear)]
    first = sorted(found, key=lambda own: -own[1].gain)[:_FITTED]
    tried = [(period, fitted(linear, sized, len(found))) for period, sized in first]
    return max(tried, key=lambda own: own[1].log_bayes_factor, default=None)


def log_posterior(linear: LinearModel) -> float:
    """Of the likeliest swing, as those of effects in the same model (`Ranked`); −∞ where there is none."""
    found = likeliest_swing(linear)
    return -np.inf if found is None else found[1].log_bayes_factor - _WIDTH + float(np.log(PRIOR_UNKNOWN))


def clear_swing(linear: LinearModel) -> tuple[float, FittedProcess] | None:
    """The likeliest swing, where it is 20 to 1 likelier than none though it is the best of all periods."""
    found = likeliest_swing(linear)
    return found if found is not None and found[1].log_bayes_factor - _WIDTH > ODDS else None
