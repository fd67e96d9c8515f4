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
from stitch.diagnosis.unknown.process_size import FittedProcess, fit_process, size_process
from stitch.diagnosis.unknown.time_processes import TimeProcess, processes_near_period, time_processes
from stitch.observations.linear_model import LinearModel
from stitch.statistics.mean_factor import log_mean_exp

# Of all courses those whose size is sought with all variances.
_TIME_LAWS_FITTED = 3


@dataclass(frozen=True)
class TimeLaw:
    """The flange errs in one course of time, of which this is the likeliest."""

    course: TimeProcess
    log_bayes_factor: float  # of all courses that were tried, over everything else, each at its likeliest size
    fitted: FittedProcess
    base: LinearModel  # without the law


def likeliest_time_law(linear: LinearModel) -> TimeLaw | None:
    """The likeliest beside a model; None where poses have no prior of errors, or a session is too short for any.

    Of each kind of courses one may be there, each kind and each of its courses as likely before: what counts is the
    mean of their Bayes factors. All variances are sought anew for the likeliest few; for the others that is a bound.
    """
    courses = [] if linear.pose_errors is None else time_processes(linear)
    if not courses:
        return None
    sized = [size_process(linear, course.process) for course in courses]
    gains = np.array([own.gain for own in sized])
    found = {k: fit_process(linear, sized[k], tried=1) for k in np.argsort(-gains)[:_TIME_LAWS_FITTED]}
    for k, own in found.items():
        gains[k] = max(gains[k], own.log_bayes_factor)
    best = max(found, key=lambda k: gains[k])
    kinds = np.array([course.kind for course in courses])
    together = log_mean_exp([float(log_mean_exp(gains[kinds == kind])) for kind in np.unique(kinds)])
    return TimeLaw(courses[best], float(together), found[best], linear)


def time_law_log_posterior(linear: LinearModel) -> float:
    """Of such a law, as those of effects in the same model (`Ranked`); −∞ where there is none. None of the sizes is
    known."""
    law = likeliest_time_law(linear)
    return -np.inf if law is None else law.log_bayes_factor - ANY_SIZE + float(np.log(PRIOR_UNKNOWN))


def significant_time_law(linear: LinearModel) -> TimeLaw | None:
    """The likeliest, where it is 20 to 1 likelier than none, beside all else that poses may do or in place of what
    wanders; a swing with the likeliest of all periods near its own.

    As with a joint's law (`clear_joints.py`) the odds are those of the likeliest sizes.
    """
    law = likeliest_time_law(linear)
    if law is None or law.log_bayes_factor <= ODDS:
        law = _law_replacing_wander(linear)
    return law if law is None or law.course.frequency is None else _refine_period(law)


def _law_replacing_wander(linear: LinearModel) -> TimeLaw | None:
    """That of a flange that does not wander but by it: 20 to 1 likelier than none, and no less likely than all that
    wanders, which can do what a stretch does, so that beside it a stretch gains nothing."""
    steady = linear.without_drift
    law = likeliest_time_law(steady)
    wandering = 0.5 * (steady.null.deviance - linear.null.deviance)
    if law is None or law.log_bayes_factor <= max(ODDS, wandering):
        return None
    return replace(law, log_bayes_factor=law.log_bayes_factor - wandering)


def _refine_period(law: TimeLaw) -> TimeLaw:
    """What is known of it was asked for one of the periods that are tried, and stays as it is."""
    beside = replace(law.base, null=law.fitted.fit)
    near = [(course, size_process(beside, course.process)) for course in processes_near_period(law.base, law.course)]
    course, sized = max(near, key=lambda own: own[1].gain)
    return replace(law, course=course, fitted=fit_process(law.base, sized, tried=1))
