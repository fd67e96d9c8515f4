"""What a law without a name of one joint follows: the numbers along which its course can be told."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from stitch.diagnosis.unknown.joint_laws import JointLaw
from stitch.frames import Array
from stitch.measurement.torques import STILL
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

JOINT_ANGLES = "the joint angles"
_DEGREES = float(np.degrees(1.0))


@dataclass(frozen=True)
class Along:
    """One number that a law follows, and the factors of the law's covariance."""

    covariate: str
    stood: Array  # (V,)
    of_it: Callable[[Array, Array], Array]  # (S, O) between places (S,) and (O,)
    of_the_rest: Array | float = 1.0  # (V, V) between views, by all that the law follows beside it
    unit: float = 1.0  # of the covariate per unit of `stood`


def followed_by(law: JointLaw) -> list[Along]:
    """All of them, by the kind of the law."""
    return _FOLLOWED[law.follows][1](law)


def followed_in_words(law: JointLaw) -> str:
    """The same as people say it: the joint angles, the way it came, time, its load."""
    return _FOLLOWED[law.follows][0]


def _angle(joint: int, stood: Array, of_it: Callable[[Array, Array], Array], rest: Array | float = 1.0) -> Along:
    """Along the angle of a joint, counted from 0; `stood` (V,) rad."""
    return Along(f"j{joint + 1}_deg", stood, of_it, rest, _DEGREES)


def _all_angles(law: JointLaw) -> list[Along]:
    joints = law.base.measurement.views.joints
    factors = alike_joint_by_joint(joints, joints)
    return [
        _angle(j, q, _of_angle, np.asarray(np.prod(np.delete(factors, j, axis=2), axis=2)))
        for j, q in enumerate(joints.T)
    ]


def _two_angles(law: JointLaw) -> list[Along]:
    joints, two = law.base.measurement.views.joints, (law.joint - 1, law.errors.others[law.process])
    return [
        _angle(j, joints[:, j], _of_one_of_two, _of_one_of_two(joints[:, other], joints[:, other]))
        for j, other in (two, two[::-1])
    ]


def _own_angle(law: JointLaw) -> list[Along]:
    own = law.joint - 1
    return [_angle(own, law.base.measurement.views.joints[:, own], alike_closely)]


def _waves(law: JointLaw) -> list[Along]:
    own = law.joint - 1
    of_it = partial(alike_in_waves, period=law.errors.periods[law.process])
    return [_angle(own, law.base.measurement.views.joints[:, own], of_it)]


def _the_way(law: JointLaw) -> list[Along]:
    own, views = law.joint - 1, law.base.measurement.views
    q, came = views.joints[:, own], views.joints[:, own] - views.previous[:, own]
    of_move = partial(alike_within, reach=reach_of_way(q))
    return [
        _angle(own, q, _of_angle, of_move(came, came)),
        Along(f"j{law.joint}_move_deg", came, of_move, _of_angle(q, q), _DEGREES),
    ]


def _with_time(law: JointLaw) -> list[Along]:
    return [_in_time(law, (1 + alike_in_joints(law.base.measurement.views.joints)) / 2)]


def _time_alone(law: JointLaw) -> list[Along]:
    return [_in_time(law, 1.0)]


def _in_time(law: JointLaw, rest: Array | float) -> Along:
    measurement = law.base.measurement
    seconds = usual_step(measurement)
    name, unit = ("time_s", seconds) if seconds else ("view", 1.0)
    return Along(name, in_steps(measurement), partial(alike_within, reach=WANDERING["slowly wandering"]), rest, unit)


def _its_load(law: JointLaw) -> list[Along]:
    torques, whole = law.base.measurement.views.torques, law.errors.alike_of(law.process)
    own = [t for t, k in enumerate(torques.joint) if k == law.joint - 1 and np.ptp(torques.values[:, t]) > STILL]
    found = []
    for t in own:
        stood = torques.values[:, t]
        of_it = partial(alike_within, reach=len(own) * float(np.ptp(stood)))
        found.append(Along(_load_name(torques.names[t]), stood, of_it, whole / of_it(stood, stood)))
    return found


def _load_name(torque: str) -> str:
    """Of a torque by its name: of what is known to weigh something, or of 1 kg at a link."""
    return f"j{torque}_torque_nm" + ("_per_kg" if "_" in torque else "")


# By kind of law what it follows, in words and along what its course is told.
_FOLLOWED: dict[str, tuple[str, Callable[[JointLaw], list[Along]]]] = {
    ALL_ANGLES: (JOINT_ANGLES, _all_angles),
    TWO_ANGLES: (JOINT_ANGLES, _two_angles),
    OWN_ANGLE: (JOINT_ANGLES, _own_angle),
    WAVES: (JOINT_ANGLES, _waves),
    THE_WAY: ("the way it came", _the_way),
    WITH_TIME: ("time", _with_time),
    TIME_ALONE: ("time", _time_alone),
    ITS_LOAD: ("its load", _its_load),
}


def _of_angle(some: Array, others: Array) -> Array:
    """(S, O) of a smooth function of one angle, (S,) and (O,) rad."""
    return alike_in_joints(some[:, None], others[:, None])


def _of_one_of_two(some: Array, others: Array) -> Array:
    """(S, O) the factor of one angle, (S,) and (O,) rad, in what follows two."""
    return np.asarray(2 * _of_angle(some, others) - 1)
