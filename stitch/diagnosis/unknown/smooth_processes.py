"""Smooth processes by which a joint or the flange may err, as columns of the channel with unit coefficients: the
leading eigenvectors of their covariance between views."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import eigh

from stitch.effects.contract import EFFECTS
from stitch.frames import Array, Indices
from stitch.model.jacobian import pose_derivatives
from stitch.model.term import term_of
from stitch.observations.flange_errors import DRIFT_MEMORY, flange_twists, time_in_steps
from stitch.observations.linear_model import LinearModel
from stitch.statistics.kernels import REACH, SHORT_REACH, ornstein_uhlenbeck, rbf_joints

# Columns of a process, and the share of its largest variance that the last of them has at least.
_MOST, _LEAST = 96, 1e-3
# Of so many views the covariance is drawn apart, and the others follow these.
_KNOTS = 400
# Of so many processes what takes longest is kept: those of a session with six or seven joints.
_KEPT = 64


@dataclass(frozen=True)
class SmoothProcess:
    """Motions of the views that follow courses with unit coefficients; far smaller than its columns."""

    joint: int | None  # that errs, counted from 1; None: the flange
    motions: Array  # (V, 6, p) twists
    shapes: Array  # (V, R) courses

    def columns(self, linear: LinearModel) -> Array:
        """(n, p·R) of the channel: each motion in each course."""
        moved = self.motions[:, :, :, None] * self.shapes[:, None, None, :]
        return linear.observation.from_twists(moved.reshape(6 * len(moved), -1))


def joint_motions(linear: LinearModel) -> Array:
    """(n, V, 6, 1) twists of the views by a radian of each joint."""
    offset = term_of(linear.measurement, EFFECTS["joint_offset"])
    return next(pose_derivatives(linear.measurement, linear.model, [offset], linear.observation.centre))[..., None]


def single_joint_processes(linear: LinearModel, motions: Array) -> list[list[SmoothProcess]]:
    """Per joint: that it follows all joints, its own angle closely, or its own and the one that it comes from."""
    views = linear.measurement.views
    every = _smooth_courses(views.joints)
    out = []
    for k, motion in enumerate(motions):
        own, came = views.joints[:, [k]], views.previous[:, [k]]
        courses = (every, _smooth_courses(own, SHORT_REACH), _smooth_courses(np.hstack([own, came])))
        out.append([SmoothProcess(k + 1, motion, shapes) for shapes in courses])
    return out


def joint_pair_processes(linear: LinearModel, motions: Array, k: int) -> Iterator[SmoothProcess]:
    """Joint k, counted from 0, that follows its own angle and that of one other."""
    joints = linear.measurement.views.joints
    for other in range(joints.shape[1]):
        if other != k:
            yield SmoothProcess(k + 1, motions[k], _smooth_courses(joints[:, [k, other]]))


def process_with_covariance(joint: int, motions: Array, kernel: Array) -> SmoothProcess:
    """A joint, counted from 1, that follows a process of covariance (V, V); motions (V, 6, 1) as above."""
    return SmoothProcess(joint, motions, kernel @ _leading_courses(kernel, len(kernel)))


def wandering_flange(linear: LinearModel) -> SmoothProcess:
    """A flange that wanders."""
    measurement, time = linear.measurement, time_in_steps(linear.measurement)
    knots = _knots(len(time))
    alike = ornstein_uhlenbeck(time, DRIFT_MEMORY["slowly wandering"], time[knots])
    carried = flange_twists([measurement], [linear.observation.centre]).reshape(len(alike), 6, 6)
    return SmoothProcess(None, carried, alike @ _leading_courses(alike[knots], _MOST // 6))


def _smooth_courses(angles: Array, reach: float = REACH) -> Array:
    """(V, R) smooth courses over some angles (V, a), without what is alike in all views: that has a name."""
    knots = angles[_knots(len(angles))]
    leading = _leading_courses_cached(np.ascontiguousarray(knots).tobytes(), len(knots), reach)
    shapes = rbf_joints(angles, knots, reach) @ leading
    return np.asarray(shapes - shapes.mean(axis=0))


@lru_cache(maxsize=_KEPT)
def _leading_courses_cached(angles: bytes, views: int, reach: float) -> Array:
    """(K, R) of the knots whose angles these are: the same in every diagnosis of a session."""
    knots = np.frombuffer(angles).reshape(views, -1)
    return _leading_courses(rbf_joints(knots, knots, reach), _MOST)


def _knots(views: int) -> Indices:
    return np.unique(np.linspace(0, views - 1, min(views, _KNOTS)).astype(np.int64))


def _leading_courses(covariance: Array, most: int) -> Array:
    """(K, R) of which the courses with unit coefficients of a process are made, by its covariance with the knots."""
    last = len(covariance) - 1
    values, vectors = eigh(covariance, subset_by_index=(max(last + 1 - most, 0), last))
    values, vectors = values[::-1], vectors[:, ::-1]
    keep = values > _LEAST * values[0]
    return np.asarray(vectors[:, keep] / np.sqrt(values[keep]))
