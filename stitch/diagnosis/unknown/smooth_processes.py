"""Smooth processes by which a joint or the flange may err, as columns of the channel with unit coefficients: the
leading eigenvectors of their covariance between views."""

from collections.abc import Iterator

import numpy as np

from stitch.effects.contract import EFFECTS
from stitch.frames import Array
from stitch.model.jacobian import twists
from stitch.model.term import term_of
from stitch.observations.flange_errors import WANDERING, flange_twists, near_in_time
from stitch.observations.linear_model import LinearModel
from stitch.statistics.kernels import alike_in_joints

# Columns of a process, and the share of its largest variance that the last of them has at least.
_MOST, _LEAST = 96, 1e-3
# Of so many views the covariance is drawn apart, and the others follow these.
_KNOTS = 400
# How far, rad, what a tooth or a seal does to a joint reaches.
_SHORT = 0.2


def of_joints(linear: LinearModel) -> Array:
    """(n, V, 6) twists of the views by a radian of each joint."""
    offset = term_of(linear.measurement, EFFECTS["joint_offset"])
    return twists(linear.measurement, linear.model, [offset], linear.observation.centre)[0]


def alone(linear: LinearModel, motions: Array, k: int) -> Iterator[Array]:
    """(n, R) of joint k that follows all joints, its own angle closely, or its own and the one that it comes from."""
    views = linear.measurement.views
    own, came = views.joints[:, [k]], views.previous[:, [k]]
    for alike in (
        alike_in_joints(views.joints),
        alike_in_joints(own, _SHORT),
        alike_in_joints(np.hstack([own, came])),
    ):
        yield _by_courses(linear, motions[k], alike)


def in_pairs(linear: LinearModel, motions: Array, k: int) -> Iterator[Array]:
    """(n, R) of joint k that follows its own angle and that of one other."""
    joints = linear.measurement.views.joints
    for other in range(joints.shape[1]):
        if other != k:
            yield _by_courses(linear, motions[k], alike_in_joints(joints[:, [k, other]]))


def _by_courses(linear: LinearModel, motion: Array, alike: Array) -> Array:
    """(n, R) of one motion (V, 6) in each course of a process, without what is alike in all views: that has a name."""
    shapes = _shapes(alike, _MOST)
    return linear.observation.by_twists(_spread(motion[:, :, None], shapes - shapes.mean(axis=0)))


def wandering(linear: LinearModel) -> Array:
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
