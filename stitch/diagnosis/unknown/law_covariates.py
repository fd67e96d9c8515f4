"""What a law without a name of one joint follows: the numbers along which its course can be told."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from stitch.diagnosis.unknown.joint_laws import JointLaw
from stitch.frames import Array
from stitch.measurement.torques import STILL
from stitch.observations.flange_errors import DRIFT_MEMORY, time_in_steps, usual_time_step
from stitch.observations.joint_processes import (
    ALL_ANGLES,
    JOINT_LOAD,
    OWN_ANGLE,
    TIME_ONLY,
    TRAVEL,
    TWO_ANGLES,
    WAVES,
    WITH_TIME,
)
from stitch.statistics.kernels import (
    direction_reach,
    exponential_kernel,
    joint_kernel_factors,
    periodic_kernel,
    rbf_joints,
    short_range_kernel,
)

JOINT_ANGLES = "the joint angles"
_DEGREES = float(np.degrees(1.0))


@dataclass(frozen=True)
class LawCovariate:
    """One number that a law follows, and the factors of the law's covariance."""

    covariate: str
    view_values: Array  # (V,)
    kernel: Callable[[Array, Array], Array]  # (S, O) between places (S,) and (O,)
    remaining_kernel: Array | float = 1.0  # (V, V) between views, by all that the law follows beside it
    unit: float = 1.0  # of the covariate per unit of `stood`


def covariates_of_law(law: JointLaw) -> list[LawCovariate]:
    """All of them, by the kind of the law."""
    return _COVARIATES_OF_KIND[law.follows][1](law)


def covariates_in_words(law: JointLaw) -> str:
    """The same as people say it: the joint angles, the way it came, time, its load."""
    return _COVARIATES_OF_KIND[law.follows][0]


def _angle(joint: int, stood: Array, of_it: Callable[[Array, Array], Array], rest: Array | float = 1.0) -> LawCovariate:
    """Along the angle of a joint, counted from 0; `stood` (V,) rad."""
    return LawCovariate(f"j{joint + 1}_deg", stood, of_it, rest, _DEGREES)


def _all_angles(law: JointLaw) -> list[LawCovariate]:
    joints = law.base.measurement.views.joints
    factors = joint_kernel_factors(joints, joints)
    return [
        _angle(j, q, _smooth_in_angle, np.asarray(np.prod(np.delete(factors, j, axis=2), axis=2)))
        for j, q in enumerate(joints.T)
    ]


def _two_angles(law: JointLaw) -> list[LawCovariate]:
    joints, two = law.base.measurement.views.joints, (law.joint - 1, law.errors.others[law.process])
    return [
        _angle(j, joints[:, j], _factor_of_one_angle, _factor_of_one_angle(joints[:, other], joints[:, other]))
        for j, other in (two, two[::-1])
    ]


def _own_angle(law: JointLaw) -> list[LawCovariate]:
    own = law.joint - 1
    return [_angle(own, law.base.measurement.views.joints[:, own], short_range_kernel)]


def _periodic_angle(law: JointLaw) -> list[LawCovariate]:
    own = law.joint - 1
    of_it = partial(periodic_kernel, period=law.errors.periods[law.process])
    return [_angle(own, law.base.measurement.views.joints[:, own], of_it)]


def _approach(law: JointLaw) -> list[LawCovariate]:
    own, views = law.joint - 1, law.base.measurement.views
    q, came = views.joints[:, own], views.joints[:, own] - views.previous[:, own]
    of_move = partial(exponential_kernel, reach=direction_reach(q))
    return [
        _angle(own, q, _smooth_in_angle, of_move(came, came)),
        LawCovariate(f"j{law.joint}_move_deg", came, of_move, _smooth_in_angle(q, q), _DEGREES),
    ]


def _angles_and_time(law: JointLaw) -> list[LawCovariate]:
    return [_along_time(law, (1 + rbf_joints(law.base.measurement.views.joints)) / 2)]


def _time_only(law: JointLaw) -> list[LawCovariate]:
    return [_along_time(law, 1.0)]


def _along_time(law: JointLaw, rest: Array | float) -> LawCovariate:
    measurement = law.base.measurement
    seconds = usual_time_step(measurement)
    name, unit = ("time_s", seconds) if seconds else ("view", 1.0)
    return LawCovariate(
        name,
        time_in_steps(measurement),
        partial(exponential_kernel, reach=DRIFT_MEMORY["slowly wandering"]),
        rest,
        unit,
    )


def _joint_load(law: JointLaw) -> list[LawCovariate]:
    torques, whole = law.base.measurement.views.torques, law.errors.kernel_of(law.process)
    own = [t for t, k in enumerate(torques.joint) if k == law.joint - 1 and np.ptp(torques.values[:, t]) > STILL]
    found = []
    for t in own:
        stood = torques.values[:, t]
        of_it = partial(exponential_kernel, reach=len(own) * float(np.ptp(stood)))
        found.append(LawCovariate(_load_name(torques.names[t]), stood, of_it, whole / of_it(stood, stood)))
    return found


def _load_name(torque: str) -> str:
    """Of a torque by its name: of what is known to weigh something, or of 1 kg at a link."""
    return f"j{torque}_torque_nm" + ("_per_kg" if "_" in torque else "")


# By kind of law what it follows, in words and along what its course is told.
_COVARIATES_OF_KIND: dict[str, tuple[str, Callable[[JointLaw], list[LawCovariate]]]] = {
    ALL_ANGLES: (JOINT_ANGLES, _all_angles),
    TWO_ANGLES: (JOINT_ANGLES, _two_angles),
    OWN_ANGLE: (JOINT_ANGLES, _own_angle),
    WAVES: (JOINT_ANGLES, _periodic_angle),
    TRAVEL: ("the way it came", _approach),
    WITH_TIME: ("time", _angles_and_time),
    TIME_ONLY: ("time", _time_only),
    JOINT_LOAD: ("its load", _joint_load),
}


def _smooth_in_angle(some: Array, others: Array) -> Array:
    """(S, O) of a smooth function of one angle, (S,) and (O,) rad."""
    return rbf_joints(some[:, None], others[:, None])


def _factor_of_one_angle(some: Array, others: Array) -> Array:
    """(S, O) the factor of one angle, (S,) and (O,) rad, in what follows two."""
    return np.asarray(2 * _smooth_in_angle(some, others) - 1)
