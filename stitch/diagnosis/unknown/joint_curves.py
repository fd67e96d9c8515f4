"""Where in the range a joint errs that follows the joint angles by a law without a name: its course, with bands."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.diagnosis.unknown.joint_laws import JointLaw
from stitch.effects.contract import EFFECTS
from stitch.frames import Array
from stitch.model.term import term_of
from stitch.observations.pose_errors import OWN_ANGLE
from stitch.statistics.kernels import alike_closely, alike_joint_by_joint

_PLACES = 25  # over the range of a joint
# Courses that carry less of what the joint does by its law say nothing about where.
_WORTH = 0.1


@dataclass(frozen=True)
class JointCurve:
    """How far a joint is off as one turns, the others where these views had them; beside its mean over the views."""

    joint: int  # that errs, counted from 1
    along: int  # that turns, counted from 1
    share: float  # of what the law does over the views, 0 … 1
    angle: Array  # (G,) of the joint that turns, rad
    error: Array  # (G,) of the joint that errs, rad
    sigma: Array  # (G,) of `error`, rad

    @property
    def name(self) -> str:
        """Of the angle, as tables call it."""
        return f"j{self.along}_deg"

    @property
    def extremes(self) -> tuple[int, int]:
        """Places at which the error is smallest and largest."""
        return int(np.argmin(self.error)), int(np.argmax(self.error))


def joint_curves(laws: Sequence[JointLaw]) -> tuple[JointCurve, ...]:
    """Partial dependence (Friedman 2001, Ann. Stat. 29:1189) of each law on every joint angle, largest share first.

    The law is a random function; what the views say of it is its mean and covariance given their numbers, with the
    hand-eye free and at the fitted sizes of all errors (kriging; Rasmussen & Williams 2006, eq. 2.41).
    """
    found = []
    for law in laws:
        joints, errors = law.model.measurement.views.joints, law.model.pose_errors
        assert errors is not None
        own = law.joint - 1
        closely = law.follows == OWN_ANGLE
        alike = errors.of_one_joint[law.follows].alike_of(own)
        whole = float(_given_views(law, alike, alike)[0].var())
        found += [_course(law, j, whole) for j in ([own] if closely else range(joints.shape[1]))]
    return tuple(sorted((c for c in found if c.share > _WORTH), key=lambda c: -c.share))


def _course(law: JointLaw, j: int, whole: float) -> JointCurve:
    """Along joint j, counted from 0; `whole` is the variance over the views of all that the law does, rad²."""
    joints = law.model.measurement.views.joints
    angle, views = np.linspace(joints[:, j].min(), joints[:, j].max(), _PLACES), len(joints)
    places = np.append(angle, joints[:, j])
    with_views, with_places = _alike(law, j, places)
    centred = np.eye(len(places)) - np.repeat([0.0, 1.0 / views], [_PLACES, views])
    mean, covariance = _given_views(law, centred @ with_views, centred @ with_places @ centred.T)
    return JointCurve(
        joint=law.joint,
        along=j + 1,
        share=min(float(mean[_PLACES:].var() / max(whole, 1e-300)), 1.0),
        angle=angle,
        error=mean[:_PLACES],
        sigma=np.sqrt(np.maximum(np.diag(covariance)[:_PLACES], 0)),
    )


def _alike(law: JointLaw, j: int, places: Array) -> tuple[Array, Array]:
    """(G, V) and (G, G) covariances of the law at places (G,) of joint j, rad, with the views and with each other."""
    joints = law.model.measurement.views.joints
    if law.follows == OWN_ANGLE:
        return alike_closely(places, joints[:, j]), alike_closely(places, places)
    # Of the function averaged over where the other joints stood.
    others = np.prod(np.delete(alike_joint_by_joint(joints, joints), j, axis=2), axis=2)
    along = places[:, None]
    with_views = others.mean(axis=0) * alike_joint_by_joint(along, joints[:, [j]])[:, :, 0]
    return with_views, others.mean() * alike_joint_by_joint(along, along)[:, :, 0]


def _given_views(law: JointLaw, with_views: Array, prior: Array) -> tuple[Array, Array]:
    """Mean (G,) and covariance (G, G) of places of the law, rad, from what the views show.

    Args:
        with_views: (G, V) covariance of the places with the law at the views, per unit of its variance.
        prior: (G, G) of the places among each other.
    """
    linear, k = law.model, law.joint - 1
    assert linear.pose_errors is not None
    variance, usual = linear.null.variances[-1], float(term_of(linear.measurement, EFFECTS["joint_offset"]).typical[k])
    columns = linear.pose_errors.of_one_joint[law.follows].columns[:, k].reshape(-1, 6, 1)
    seen = linear.residual(linear.reduce((columns * with_views.T[:, None, :]).reshape(-1, len(with_views))))
    mean = variance * seen.T @ linear.white_residual
    return usual * mean, usual**2 * (variance * prior - variance**2 * seen.T @ seen)
