"""Where in the range a joint errs that follows the joint angles by a law without a name: its course, with bands."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from stitch.diagnosis.unknown.joint_laws import JointLaw
from stitch.effects.contract import EFFECTS
from stitch.frames import Array
from stitch.model.term import term_of
from stitch.observations.pose_errors import ALL_ANGLES, OWN_ANGLE, THE_WAY
from stitch.statistics.kernels import alike_closely, alike_in_joints, alike_in_move, alike_joint_by_joint, reach_of_way

_PLACES = 25  # over the range of a joint
# Courses that carry less of what the joint does by its law say nothing about where.
_WORTH = 0.1


@dataclass(frozen=True)
class JointCurve:
    """How far a joint is off as one turns, or along how far it last moved itself, the rest where these views had it;
    beside its mean over the views."""

    joint: int  # that errs, counted from 1
    along: int  # that turns, counted from 1
    of_move: bool  # along how far it came from the view before, not along its angle
    share: float  # of what the law does over the views, 0 … 1
    angle: Array  # (G,) of the joint that turns, or its move, rad
    error: Array  # (G,) of the joint that errs, rad
    sigma: Array  # (G,) of `error`, rad
    stood: Array  # (V,) that angle or move in the views, rad

    @property
    def name(self) -> str:
        """Of the angle, as tables call it, or of the move."""
        return f"j{self.along}_move_deg" if self.of_move else f"j{self.along}_deg"

    @property
    def extremes(self) -> tuple[int, int]:
        """Places at which the error is smallest and largest."""
        return int(np.argmin(self.error)), int(np.argmax(self.error))


@dataclass(frozen=True)
class _Along:
    """One number that a law follows, and the factors of the law's covariance."""

    joint: int  # counted from 0
    stood: Array  # (V,) rad
    of_it: Callable[[Array, Array], Array]  # (S, O) between places (S,) and (O,) rad
    of_the_rest: Array  # (V, V) between views, by all that the law follows beside it
    of_move: bool = False


def joint_curves(laws: Sequence[JointLaw]) -> tuple[JointCurve, ...]:
    """Partial dependence (Friedman 2001, Ann. Stat. 29:1189) of each law on all that it follows, largest share first.

    The law is a random function; what the views say of it is its mean and covariance given their numbers, with the
    hand-eye free and at the fitted sizes of all errors (kriging; Rasmussen & Williams 2006, eq. 2.41).
    """
    found = []
    for law in laws:
        errors = law.model.pose_errors
        assert errors is not None
        alike = errors.of_one_joint[law.follows].alike_of(law.joint - 1)
        whole = float(_given_views(law, alike, alike)[0].var())
        found += [_course(law, along, whole) for along in _FOLLOWED[law.follows](law)]
    return tuple(sorted((c for c in found if c.share > _WORTH), key=lambda c: -c.share))


def _course(law: JointLaw, along: _Along, whole: float) -> JointCurve:
    """`whole` is the variance over the views of all that the law does, rad²."""
    at, views = along.stood, len(along.stood)
    grid = np.linspace(at.min(), at.max(), _PLACES)
    places = np.append(grid, at)
    # Of the function averaged over where all else stood.
    with_views = along.of_the_rest.mean(axis=0) * along.of_it(places, at)
    with_places = along.of_the_rest.mean() * along.of_it(places, places)
    centred = np.eye(len(places)) - np.repeat([0.0, 1.0 / views], [_PLACES, views])
    mean, covariance = _given_views(law, centred @ with_views, centred @ with_places @ centred.T)
    return JointCurve(
        joint=law.joint,
        along=along.joint + 1,
        of_move=along.of_move,
        share=min(float(mean[_PLACES:].var() / max(whole, 1e-300)), 1.0),
        angle=grid,
        error=mean[:_PLACES],
        sigma=np.sqrt(np.maximum(np.diag(covariance)[:_PLACES], 0)),
        stood=at,
    )


def _all_angles(law: JointLaw) -> list[_Along]:
    joints = law.model.measurement.views.joints
    factors = alike_joint_by_joint(joints, joints)
    return [_Along(j, q, _of_angle, np.prod(np.delete(factors, j, axis=2), axis=2)) for j, q in enumerate(joints.T)]


def _own_angle(law: JointLaw) -> list[_Along]:
    q = law.model.measurement.views.joints[:, law.joint - 1]
    return [_Along(law.joint - 1, q, alike_closely, np.ones((len(q), len(q))))]


def _the_way(law: JointLaw) -> list[_Along]:
    own, views = law.joint - 1, law.model.measurement.views
    q, came = views.joints[:, own], views.joints[:, own] - views.previous[:, own]
    of_move = partial(alike_in_move, reach=reach_of_way(q))
    return [
        _Along(own, q, _of_angle, of_move(came, came)),
        _Along(own, came, of_move, _of_angle(q, q), of_move=True),
    ]


_FOLLOWED = {ALL_ANGLES: _all_angles, OWN_ANGLE: _own_angle, THE_WAY: _the_way}


def _of_angle(some: Array, others: Array) -> Array:
    """(S, O) of a smooth function of one angle, (S,) and (O,) rad."""
    return alike_in_joints(some[:, None], others[:, None])


def _given_views(law: JointLaw, with_views: Array, prior: Array) -> tuple[Array, Array]:
    """Mean (G,) and covariance (G, G) of places of the law, rad, from what the views show.

    Args:
        with_views: (G, V) covariance of the places with the law at the views, per unit of its variance.
        prior: (G, G) of the places among each other.
    """
    linear, k = law.model, law.joint - 1
    assert linear.pose_errors is not None
    variance, usual = linear.null.variances[-1], float(term_of(linear.measurement, EFFECTS["joint_offset"]).typical[k])
    columns = linear.pose_errors.of_one_joint[law.follows].column_of(k).reshape(-1, 6, 1)
    seen = linear.residual(linear.reduce((columns * with_views.T[:, None, :]).reshape(-1, len(with_views))))
    mean = variance * seen.T @ linear.white_residual
    return usual * mean, usual**2 * (variance * prior - variance**2 * seen.T @ seen)
