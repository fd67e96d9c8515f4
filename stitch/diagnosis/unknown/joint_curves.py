"""Where in the range a joint errs that follows a law without a name, or when, or under which load: its course, with
bands."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from stitch.diagnosis.unknown.joint_laws import JointLaw
from stitch.effects.contract import EFFECTS
from stitch.frames import Array
from stitch.measurement.torques import STILL
from stitch.model.term import term_of
from stitch.observations.flange_errors import WANDERING, in_steps, usual_step
from stitch.observations.joint_processes import (
    ALL_ANGLES,
    ITS_LOAD,
    OWN_ANGLE,
    THE_WAY,
    TIME_ALONE,
    TWO_ANGLES,
    WAVES,
    WITH_TIME,
)
from stitch.statistics.kernels import (
    alike_closely,
    alike_in_joints,
    alike_in_waves,
    alike_joint_by_joint,
    alike_within,
    reach_of_way,
)

_DEGREES = float(np.degrees(1.0))
_PLACES = 25  # over the range of a joint
# Courses that carry less of what the joint does by its law say nothing about where.
_WORTH = 0.1


@dataclass(frozen=True)
class JointCurve:
    """How far a joint is off along one number that it follows, the rest where these views had it; beside its mean over
    the views."""

    joint: int  # that errs, counted from 1
    covariate: str  # j3_deg; j3_move_deg, how far it came; time_s or view; j3_torque_nm, or j3_torque_nm_per_kg
    share: float  # of what the law does over the views, 0 … 1
    at: Array  # (G,) of the covariate, in the unit that its name ends with
    error: Array  # (G,) of the joint that errs, rad
    sigma: Array  # (G,) of `error`, rad
    stood: Array  # (V,) the covariate in the views
    may_follow: tuple[str, ...] = ()  # what these views do not tell apart, the likeliest first

    @property
    def extremes(self) -> tuple[int, int]:
        """Places at which the error is smallest and largest."""
        return int(np.argmin(self.error)), int(np.argmax(self.error))


@dataclass(frozen=True)
class _Along:
    """One number that a law follows, and the factors of the law's covariance."""

    covariate: str
    stood: Array  # (V,)
    of_it: Callable[[Array, Array], Array]  # (S, O) between places (S,) and (O,)
    of_the_rest: Array | float = 1.0  # (V, V) between views, by all that the law follows beside it
    unit: float = 1.0  # of the covariate per unit of `stood`


def joint_curves(laws: Sequence[JointLaw]) -> tuple[JointCurve, ...]:
    """Partial dependence (Friedman 2001, Ann. Stat. 29:1189) of each law on all that it follows, largest share first.

    The law is a random function; what the views say of it is its mean and covariance given their numbers, with the
    hand-eye free and at the fitted sizes of all errors (kriging; Rasmussen & Williams 2006, eq. 2.41).
    """
    found = []
    for law in laws:
        alike = law.errors.alike_of(law.process)
        whole = float(_given_views(law, alike, alike)[0].var())
        found += [_course(law, along, whole) for along in _FOLLOWED[law.follows](law)]
    return tuple(sorted((c for c in found if c.share > _WORTH), key=lambda c: -c.share))


def _course(law: JointLaw, along: _Along, whole: float) -> JointCurve:
    """`whole` is the variance over the views of all that the law does, rad²."""
    at, views = along.stood, len(along.stood)
    grid = np.linspace(at.min(), at.max(), _PLACES)
    places = np.append(grid, at)
    # Of the function averaged over where all else stood.
    rest = np.broadcast_to(along.of_the_rest, (views, views))
    with_views = rest.mean(axis=0) * along.of_it(places, at)
    with_places = rest.mean() * along.of_it(places, places)
    centred = np.eye(len(places)) - np.repeat([0.0, 1.0 / views], [_PLACES, views])
    mean, covariance = _given_views(law, centred @ with_views, centred @ with_places @ centred.T)
    return JointCurve(
        joint=law.joint,
        covariate=along.covariate,
        share=min(float(mean[_PLACES:].var() / max(whole, 1e-300)), 1.0),
        at=along.unit * grid,
        error=mean[:_PLACES],
        sigma=np.sqrt(np.maximum(np.diag(covariance)[:_PLACES], 0)),
        stood=along.unit * at,
        may_follow=law.may_follow,
    )


def _angle(joint: int, stood: Array, of_it: Callable[[Array, Array], Array], rest: Array | float = 1.0) -> _Along:
    """Along the angle of a joint, counted from 0; `stood` (V,) rad."""
    return _Along(f"j{joint + 1}_deg", stood, of_it, rest, _DEGREES)


def _all_angles(law: JointLaw) -> list[_Along]:
    joints = law.base.measurement.views.joints
    factors = alike_joint_by_joint(joints, joints)
    return [
        _angle(j, q, _of_angle, np.asarray(np.prod(np.delete(factors, j, axis=2), axis=2)))
        for j, q in enumerate(joints.T)
    ]


def _two_angles(law: JointLaw) -> list[_Along]:
    joints, two = law.base.measurement.views.joints, (law.joint - 1, law.errors.others[law.process])
    return [
        _angle(j, joints[:, j], _of_one_of_two, _of_one_of_two(joints[:, other], joints[:, other]))
        for j, other in (two, two[::-1])
    ]


def _own_angle(law: JointLaw) -> list[_Along]:
    own = law.joint - 1
    return [_angle(own, law.base.measurement.views.joints[:, own], alike_closely)]


def _waves(law: JointLaw) -> list[_Along]:
    own = law.joint - 1
    of_it = partial(alike_in_waves, period=law.errors.periods[law.process])
    return [_angle(own, law.base.measurement.views.joints[:, own], of_it)]


def _the_way(law: JointLaw) -> list[_Along]:
    own, views = law.joint - 1, law.base.measurement.views
    q, came = views.joints[:, own], views.joints[:, own] - views.previous[:, own]
    of_move = partial(alike_within, reach=reach_of_way(q))
    return [
        _angle(own, q, _of_angle, of_move(came, came)),
        _Along(f"j{law.joint}_move_deg", came, of_move, _of_angle(q, q), _DEGREES),
    ]


def _with_time(law: JointLaw) -> list[_Along]:
    return [_in_time(law, (1 + alike_in_joints(law.base.measurement.views.joints)) / 2)]


def _time_alone(law: JointLaw) -> list[_Along]:
    return [_in_time(law, 1.0)]


def _in_time(law: JointLaw, rest: Array | float) -> _Along:
    measurement = law.base.measurement
    seconds = usual_step(measurement)
    name, unit = ("time_s", seconds) if seconds else ("view", 1.0)
    return _Along(name, in_steps(measurement), partial(alike_within, reach=WANDERING["slowly wandering"]), rest, unit)


def _its_load(law: JointLaw) -> list[_Along]:
    torques, whole = law.base.measurement.views.torques, law.errors.alike_of(law.process)
    own = [t for t, k in enumerate(torques.joint) if k == law.joint - 1 and np.ptp(torques.values[:, t]) > STILL]
    found = []
    for t in own:
        stood = torques.values[:, t]
        of_it = partial(alike_within, reach=len(own) * float(np.ptp(stood)))
        found.append(_Along(_load_name(torques.names[t]), stood, of_it, whole / of_it(stood, stood)))
    return found


def _load_name(torque: str) -> str:
    """Of a torque by its name: of what is known to weigh something, or of 1 kg at a link."""
    return f"j{torque}_torque_nm" + ("_per_kg" if "_" in torque else "")


_FOLLOWED = {
    ALL_ANGLES: _all_angles,
    TWO_ANGLES: _two_angles,
    OWN_ANGLE: _own_angle,
    WAVES: _waves,
    THE_WAY: _the_way,
    WITH_TIME: _with_time,
    TIME_ALONE: _time_alone,
    ITS_LOAD: _its_load,
}


def _of_angle(some: Array, others: Array) -> Array:
    """(S, O) of a smooth function of one angle, (S,) and (O,) rad."""
    return alike_in_joints(some[:, None], others[:, None])


def _of_one_of_two(some: Array, others: Array) -> Array:
    """(S, O) the factor of one angle, (S,) and (O,) rad, in what follows two."""
    return np.asarray(2 * _of_angle(some, others) - 1)


def _given_views(law: JointLaw, with_views: Array, prior: Array) -> tuple[Array, Array]:
    """Mean (G,) and covariance (G, G) of places of the law, rad, from what the views show.

    Args:
        with_views: (G, V) covariance of the places with the law at the views, per unit of its variance.
        prior: (G, G) of the places among each other.
    """
    linear, k = law.model, law.joint - 1
    variance, usual = linear.null.variances[-1], float(term_of(linear.measurement, EFFECTS["joint_offset"]).typical[k])
    columns = law.errors.columns[:, law.process].reshape(-1, 6, 1)
    seen = linear.residual(linear.reduce((columns * with_views.T[:, None, :]).reshape(-1, len(with_views))))
    mean = variance * seen.T @ linear.white_residual
    return usual * mean, usual**2 * (variance * prior - variance**2 * seen.T @ seen)
