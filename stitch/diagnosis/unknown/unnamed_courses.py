"""Errors without a name as rivals of names where no prior of pose errors stands beside these: labelled points, and
views by the hundred.

Whatever is smooth gets the name of what it resembles, unless something smooth is what the name is held against. So a
name must be wanted beside single joints that follow the joint angles, or the angles that they come from, by no law,
and beside a flange that wanders in time: smooth processes of few numbers each (the leading eigenvectors of their
covariance) and of a size that the views tell.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from stitch.diagnosis.candidates import Form
from stitch.effects.contract import EFFECTS
from stitch.frames import Array
from stitch.model.jacobian import twists
from stitch.model.term import term_of
from stitch.observations.flange_errors import WANDERING, flange_twists, near_in_time
from stitch.observations.linear_model import LinearModel
from stitch.statistics.kernels import alike_in_joints
from stitch.statistics.variance_components import VarianceFit, fit_variances

# Columns of a process, and the share of its largest variance that the last of them has at least.
_MOST, _LEAST = 96, 1e-3
# Of so many views the covariance is drawn apart, and the others follow these.
_KNOTS = 400
# Sizes that are tried, as multiples of the one at which the clearest column is as large as its own sigma.
_SIZES = np.geomspace(0.1, 1e5, 49)
# Beside an effect a process may be that much smaller than alone.
_SMALLER = (1.0, 0.3, 0.1, 0.01)
# How far, rad, what a tooth or a seal does to a joint reaches.
_SHORT = 0.2
# Joints for which a second one is sought that theirs may follow, and processes whose size is sought with all variances.
_JOINTS, _FITTED = 2, 2


@dataclass(frozen=True)
class UnnamedCourse:
    """A process without a name, at its likeliest size."""

    columns: Array  # (n, R) of the channel, per unit of that size
    size: float
    fit: VarianceFit  # of the views with the process


def unnamed_courses(linear: LinearModel) -> tuple[UnnamedCourse, ...]:
    """The likeliest of them beside a model; () where pose errors have a prior."""
    if linear.pose_errors is not None:
        return ()
    found = [_likeliest(linear, _wandering(linear))]
    if linear.measurement.views.has("joints"):
        motions = _of_joints(linear)
        joints = range(len(motions))
        alone = [[_likeliest(linear, own) for own in _alone(linear, motions, k)] for k in joints]
        found += [course for own in alone for course in own]
        first = sorted(joints, key=lambda k: -max(course.gain for course in alone[k]))[:_JOINTS]
        found += [_likeliest(linear, own) for k in first for own in _in_pairs(linear, motions, k)]
    likeliest = sorted(found, key=lambda course: -course.gain)[:_FITTED]
    return tuple(_fitted(linear, course.columns, course.size) for course in likeliest)


def least_wanted(linear: LinearModel, form: Form) -> float:
    """Log Bayes factor of an effect beside that process which leaves least of it; ∞ where pose errors have a prior."""
    return min((_wanted_beside(linear, course, form) for course in unnamed_courses(linear)), default=np.inf)


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

    columns: Array  # (n, R)
    size: float
    gain: float


def _fitted(linear: LinearModel, columns: Array, size: float) -> UnnamedCourse:
    """With all variances sought anew: what a process explains is no scatter, and where the scatter is less it is
    likelier of another size."""
    G = linear.in_blocks(columns)
    first = fit_variances(linear.mixed, G, np.full(columns.shape[1], size), start=linear.null.variances)
    again = _likeliest(replace(linear, null=first), columns).size
    second = fit_variances(linear.mixed, G, np.full(columns.shape[1], again), start=first.variances)
    return UnnamedCourse(columns, *((again, second) if second.deviance < first.deviance else (size, first)))


def _likeliest(linear: LinearModel, columns: Array) -> _Likeliest:
    """Its size at the null's variances.

    Over the eigenvalues k of the columns' information and the shares g of what was seen: log BF(s) =
    ½ Σ g²/(k + 1/s²) − ½ Σ log(1 + s²k).
    """
    white = linear.residual(columns)
    k, vectors = np.linalg.eigh(white.T @ white)
    k, g = np.maximum(k, 0.0), vectors.T @ (white.T @ linear.white_residual)
    if not k[-1] > 0:
        return _Likeliest(columns, 1.0, -np.inf)
    sizes = _SIZES / np.sqrt(k[-1])
    gains = g**2 / (k + 1 / sizes[:, None] ** 2) - np.log1p(sizes[:, None] ** 2 * k)
    found = 0.5 * gains.sum(axis=1)
    return _Likeliest(columns, float(sizes[found.argmax()]), float(found.max()))


def _of_joints(linear: LinearModel) -> Array:
    """(n, V, 6) twists of the views by a radian of each joint."""
    offset = term_of(linear.measurement, EFFECTS["joint_offset"])
    return twists(linear.measurement, linear.model, [offset], linear.observation.centre)[0]


def _alone(linear: LinearModel, motions: Array, k: int) -> Iterator[Array]:
    """(n, R) of joint k that follows all joints, its own angle closely, or its own and the one that it comes from."""
    views = linear.measurement.views
    own, came = views.joints[:, [k]], views.previous[:, [k]]
    for alike in (
        alike_in_joints(views.joints),
        alike_in_joints(own, _SHORT),
        alike_in_joints(np.hstack([own, came])),
    ):
        yield _by_courses(linear, motions[k], alike)


def _in_pairs(linear: LinearModel, motions: Array, k: int) -> Iterator[Array]:
    """(n, R) of joint k that follows its own angle and that of one other."""
    joints = linear.measurement.views.joints
    for other in range(joints.shape[1]):
        if other != k:
            yield _by_courses(linear, motions[k], alike_in_joints(joints[:, [k, other]]))


def _by_courses(linear: LinearModel, motion: Array, alike: Array) -> Array:
    """(n, R) of one motion (V, 6) in each course of a process, without what is alike in all views: that has a name."""
    shapes = _shapes(alike, _MOST)
    return linear.observation.by_twists(_spread(motion[:, :, None], shapes - shapes.mean(axis=0)))


def _wandering(linear: LinearModel) -> Array:
    """(n, R) of a flange that wanders."""
    measurement = linear.measurement
    shapes = _shapes(near_in_time([measurement], WANDERING["slowly wandering"]), _MOST // 6)
    carried = flange_twists([measurement], [linear.observation.centre]).reshape(len(shapes), 6, 6)
    return linear.observation.by_twists(_spread(carried, shapes))


def _spread(moved: Array, shapes: Array) -> Array:
    """(6V, p·R) twists of the views by each of p motions (V, 6, p) in each of the courses (V, R)."""
    return (moved[:, :, :, None] * shapes[:, None, None, :]).reshape(6 * len(moved), -1)


def _shapes(alike: Array, most: int) -> Array:
    """(V, R) courses with unit coefficients of which the covariance of a process (V, V) is made."""
    knots = np.unique(np.linspace(0, len(alike) - 1, min(len(alike), _KNOTS)).astype(np.int64))
    values, vectors = np.linalg.eigh(alike[np.ix_(knots, knots)])
    values, vectors = values[::-1][:most], vectors[:, ::-1][:, :most]
    keep = values > _LEAST * values[0]
    return np.asarray(alike[:, knots] @ (vectors[:, keep] / np.sqrt(values[keep])))
