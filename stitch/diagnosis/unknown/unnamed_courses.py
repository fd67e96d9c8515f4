"""Errors without a name as rivals of names where no prior of pose errors stands beside these: labelled points, and
views by the hundred.

Whatever is smooth gets the name of what it resembles, unless something smooth is what the name is held against. So a
name must be wanted beside single joints that follow the joint angles, or the angles that they come from, by no law,
and beside a flange that wanders in time: smooth processes of few numbers each (the leading eigenvectors of their
covariance) and of a size that the views tell.
"""

import numpy as np

from stitch.diagnosis.score import Score
from stitch.diagnosis.thresholds import ODDS
from stitch.diagnosis.unknown.process_size import FittedProcess, fit_process, size_process
from stitch.diagnosis.unknown.smooth_processes import (
    joint_motions,
    joint_pair_processes,
    single_joint_processes,
    wandering_flange,
)
from stitch.frames import Array
from stitch.observations.linear_model import LinearModel
from stitch.statistics.variance_components import fit_variances
from stitch.system.threads import parallel

# Beside an effect a process may be that much smaller than alone.
_SMALLER = (1.0, 0.3, 0.1, 0.01)
# Joints for which a second one is sought that theirs may follow, and processes whose size is sought with all variances.
_PAIRED_JOINTS, _COURSES_FITTED = 2, 2


def unnamed_courses(linear: LinearModel) -> tuple[FittedProcess, ...]:
    """The likeliest of them beside a model; () where pose errors have a prior."""
    if linear.pose_errors is not None:
        return ()
    found = [size_process(linear, wandering_flange(linear))]
    if linear.measurement.views.has("joints"):
        motions = joint_motions(linear)
        by_joint = [
            [size_process(linear, process) for process in own] for own in single_joint_processes(linear, motions)
        ]
        found += [course for own in by_joint for course in own]
        first = sorted(range(len(by_joint)), key=lambda k: -max(course.gain for course in by_joint[k]))[:_PAIRED_JOINTS]
        found += [size_process(linear, process) for k in first for process in joint_pair_processes(linear, motions, k)]
    likeliest = sorted(found, key=lambda course: -course.gain)[:_COURSES_FITTED]
    courses = parallel(lambda c: fit_process(linear, c, len(found)), likeliest)
    return tuple(sorted(courses, key=lambda c: -c.log_bayes_factor))


def significant_course(linear: LinearModel) -> FittedProcess | None:
    """The likeliest of them, where it is 20 to 1 likelier than scatter alone though it is the best of all.

    Scatter of the joints counts here, as what repeats least resembles it. It does not where names are asked for: an arm
    that errs by many small laws at once seems to scatter by its joints, and of two tracked arms of one series one was
    then not what it was named for on the other's poses.
    """
    courses = unnamed_courses(linear.independent_only)
    return next((course for course in courses if course.log_bayes_factor > ODDS), None)


def least_log_bayes_factor(linear: LinearModel, scored: Score) -> float:
    """Log Bayes factor of an effect beside that process which leaves least of it; ∞ where pose errors have a prior."""
    wanted = parallel(lambda course: _factor_with_course(linear, course, scored), unnamed_courses(linear))
    return min(wanted, default=np.inf)


def _factor_with_course(linear: LinearModel, course: FittedProcess, scored: Score) -> float:
    both = linear.in_blocks(np.hstack([course.columns, scored.form.columns]))
    tried = [
        _deviance_with_columns(
            linear, both, np.append(np.full(course.columns.shape[1], times * course.size), scored.sizes)
        )
        for times in _SMALLER
    ]
    return 0.5 * (course.fit.deviance - min(tried))


def _deviance_with_columns(linear: LinearModel, G: Array, prior: Array) -> float:
    return fit_variances(linear.mixed, G, prior, start=linear.null.variances).deviance
