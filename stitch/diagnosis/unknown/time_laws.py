"""Laws without a name in time: a flange that swings to and fro, or that stands off for a stretch of views.

A cabinet that cools in turns, air that is conditioned in turns, a draught, somebody who leans on the cell. Errors half
a period apart are opposite, and a stretch of large errors lies amid small ones: no process that forgets and has one
size throughout does that. Beside such a prior they count as white scatter, and a model that left 0.1 mrad of them was
adequate; or an effect that goes with time got its name from a part of a swing.
"""

from dataclasses import dataclass, replace

import numpy as np

from stitch.diagnosis.thresholds import ODDS, PRIOR_UNKNOWN
from stitch.diagnosis.unknown.joint_laws import ANY_SIZE
from stitch.diagnosis.unknown.process_size import FittedProcess, at_likeliest_size, fitted
from stitch.diagnosis.unknown.time_processes import TimeProcess, time_processes, with_nearly_its_period
from stitch.observations.linear_model import LinearModel

# Of all courses those whose size is sought with all variances.
_FITTED = 3
# What a size without a prior costs where the question is whether there is anything, nats: ∫ of the prior that other
# pose errors have over log σ, against its value at the maximum (`variance_prior.py`).
_WIDTH = 3.0


@dataclass(frozen=True)
class TimeLaw:
    """The flange errs in one course of time."""

    course: TimeProcess
    log_bayes_factor: float  # over everything else at its likeliest size, charged for all courses that were tried
    fitted: FittedProcess

    @property
    def over_nothing(self) -> float:
        """Its log Bayes factor where the question is whether there is anything: what not knowing its size costs too."""
        return self.log_bayes_factor - _WIDTH


def likeliest_time_law(linear: LinearModel) -> TimeLaw | None:
    """The likeliest beside a model; None where poses have no prior of errors, or a session is too short for any."""
    if linear.pose_errors is None:
        return None
    courses = time_processes(linear)
    sized = [at_likeliest_size(linear, course.process) for course in courses]
    likeliest = sorted(range(len(sized)), key=lambda k: -sized[k].gain)[:_FITTED]
    found = [(courses[k], fitted(linear, sized[k], len(sized))) for k in likeliest]
    laws = [TimeLaw(course, own.log_bayes_factor, own) for course, own in found]
    return max(laws, key=lambda law: law.log_bayes_factor, default=None)


def log_posterior(linear: LinearModel) -> float:
    """Of the likeliest, as those of effects in the same model (`Ranked`); −∞ where there is none."""
    law = likeliest_time_law(linear)
    return -np.inf if law is None else law.log_bayes_factor - ANY_SIZE + float(np.log(PRIOR_UNKNOWN))


def clear_time_law(linear: LinearModel) -> TimeLaw | None:
    """The likeliest, where it is 20 to 1 likelier than none; a swing with the likeliest of all periods near its own."""
    law = likeliest_time_law(linear)
    if law is None or law.over_nothing <= ODDS:
        return None
    return law if law.course.frequency is None else _of_period(linear, law)


def _of_period(linear: LinearModel, law: TimeLaw) -> TimeLaw:
    """What is known of it was asked for one of the periods that are tried, and stays as it is."""
    beside = replace(linear, null=law.fitted.fit)
    near = [
        (course, at_likeliest_size(beside, course.process)) for course in with_nearly_its_period(linear, law.course)
    ]
    course, sized = max(near, key=lambda own: own[1].gain)
    return replace(law, course=course, fitted=fitted(linear, sized, tried=1))
