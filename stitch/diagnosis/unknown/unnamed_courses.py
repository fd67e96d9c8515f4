"""Errors without a name as rivals of names where no prior of pose errors stands beside these: labelled points, and
views by the hundred.

Whatever is smooth gets the name of what it resembles, unless something smooth is what the name is held against. So a
name must be wanted beside single joints that follow the joint angles, or the angles that they come from, by no law,
and beside a flange that wanders in time: smooth processes of few numbers each (the leading eigenvectors of their
covariance) and of a size that the views tell.
"""

from dataclasses import dataclass, replace

import numpy as np

from stitch.diagnosis.candidates import Form
from stitch.diagnosis.thresholds import ODDS
from stitch.diagnosis.unknown.smooth_processes import SmoothProcess, alone, in_pairs, of_joints, wandering
from stitch.frames import Array
from stitch.observations.linear_model import LinearModel
from stitch.statistics.variance_components import VarianceFit, fit_variances
from stitch.system.threads import parallel

# Sizes that are tried, as multiples of the one at which the clearest column is as large as its own sigma.
_SIZES = np.geomspace(0.1, 1e5, 49)
# Beside an effect a process may be that much smaller than alone.
_SMALLER = (1.0, 0.3, 0.1, 0.01)
# Joints for which a second one is sought that theirs may follow, and processes whose size is sought with all variances.
_JOINTS, _FITTED = 2, 2


@dataclass(frozen=True)
class UnnamedCourse:
    """A process without a name, at its likeliest size."""

    joint: int | None  # that follows it, counted from 1; None: the flange, in time
    columns: Array  # (n, R) of the channel, per unit of that size
    size: float
    fit: VarianceFit  # of the views with the process
    log_bayes_factor: float  # over scatter alone, less the number of processes that were tried


def unnamed_courses(linear: LinearModel) -> tuple[UnnamedCourse, ...]:
    """The likeliest of them beside a model; () where pose errors have a prior."""
    if linear.pose_errors is not None:
        return ()
    found = [_likeliest(linear, wandering(linear))]
    if linear.measurement.views.has("joints"):
        motions = of_joints(linear)
        by_joint = [[_likeliest(linear, process) for process in own] for own in alone(linear, motions)]
        found += [course for own in by_joint for course in own]
        first = sorted(range(len(by_joint)), key=lambda k: -max(course.gain for course in by_joint[k]))[:_JOINTS]
        found += [_likeliest(linear, process) for k in first for process in in_pairs(linear, motions, k)]
    tried = float(np.log(len(found)))
    likeliest = sorted(found, key=lambda course: -course.gain)[:_FITTED]
    fitted = parallel(lambda c: _fitted(linear, c, tried), likeliest)
    return tuple(sorted(fitted, key=lambda c: -c.log_bayes_factor))


def clear_course(linear: LinearModel) -> UnnamedCourse | None:
    """The likeliest of them, where it is 20 to 1 likelier than scatter alone though it is the best of all."""
    return next((course for course in unnamed_courses(linear) if course.log_bayes_factor > ODDS), None)


def least_wanted(linear: LinearModel, form: Form) -> float:
    """Log Bayes factor of an effect beside that process which leaves least of it; ∞ where pose errors have a prior."""
    wanted = parallel(lambda course: _wanted_beside(linear, course, form), unnamed_courses(linear))
    return min(wanted, default=np.inf)


def _wanted_beside(linear: LinearModel, course: UnnamedCourse, form: Form) -> float:
    both = linear.in_blocks(np.hstack([course.columns, form.columns]))
    tried = [
        _deviance(linear, both, np.append(np.full(course.columns.shape[1], times * course.size), form.sizes))
        for times in _SMALLER
    ]
    return 0.5 * (course.fit.deviance - min(tried))


def _deviance(linear: LinearModel, G: Array, prior: Array) -> float:
    return fit_variances(linear.mixed, G, prior, start=linear.null.variances).deviance


@dataclass(frozen=True)
class _Likeliest:
    """A process at the size that is likeliest at the null's variances, and its log Bayes factor there."""

    process: SmoothProcess
    size: float
    gain: float


def _fitted(linear: LinearModel, found: _Likeliest, tried: float) -> UnnamedCourse:
    """With all variances sought anew: what a process explains is no scatter, and where the scatter is less it is
    likelier of another size."""
    columns = found.process.columns(linear)
    G, unit = linear.in_blocks(columns), np.ones(columns.shape[1])
    fit = fit_variances(linear.mixed, G, found.size * unit, start=linear.null.variances)
    size = _likeliest(replace(linear, null=fit), found.process).size
    again = fit_variances(linear.mixed, G, size * unit, start=fit.variances)
    size, fit = (size, again) if again.deviance < fit.deviance else (found.size, fit)
    gained = 0.5 * (linear.null.deviance - fit.deviance)
    return UnnamedCourse(found.process.joint, columns, size, fit, gained - tried)


def _likeliest(linear: LinearModel, process: SmoothProcess) -> _Likeliest:
    """Its size at the null's variances.

    Over the eigenvalues k of the columns' information and the shares g of what was seen: log BF(s) =
    ½ Σ g²/(k + 1/s²) − ½ Σ log(1 + s²k).
    """
    white = linear.residual(process.columns(linear))
    k, vectors = np.linalg.eigh(white.T @ white)
    k, g = np.maximum(k, 0.0), vectors.T @ (white.T @ linear.white_residual)
    if not k[-1] > 0:
        return _Likeliest(process, 1.0, -np.inf)
    sizes = _SIZES / np.sqrt(k[-1])
    gains = g**2 / (k + 1 / sizes[:, None] ** 2) - np.log1p(sizes[:, None] ** 2 * k)
    found = 0.5 * gains.sum(axis=1)
    return _Likeliest(process, float(sizes[found.argmax()]), float(found.max()))
