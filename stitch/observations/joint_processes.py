"""What one joint may do by no law that anybody wrote down: processes by what it follows, in none of the components of
the prior of pose errors."""

from collections.abc import Sequence
from itertools import permutations

import numpy as np

from stitch.frames import Array, Mask
from stitch.measurement.measurement import Measurement
from stitch.measurement.torques import STILL, Torques
from stitch.observations.flange_errors import DRIFT_MEMORY, drift_kernel
from stitch.statistics.kernels import (
    SmoothErrors,
    direction_kernel,
    load_kernel,
    periodic_kernel,
    short_range_kernel,
    two_joint_kernel,
)

# What a joint may follow that errs by no law that anybody wrote down: all joint angles smoothly, its own and one other,
# its own within a few degrees or in waves, the way it came, time, at each pose in another way or in the same, or what
# bends it.
ALL_ANGLES, OWN_ANGLE, TRAVEL, WITH_TIME = "all angles", "own angle", "the way it came", "time"
JOINT_LOAD, TWO_ANGLES, WAVES, TIME_ONLY = "its load", "its angle and another", "waves of its angle", "time alone"
# A joint that turns less stands still, rad: what follows its angle alone is the same in all views, and has a name.
_STATIONARY_RANGE = 1e-3
# Waves along a joint: two over its range at the least, half a wave more or less looks alike, none shorter than 10°.
_MIN_WAVES, _WAVE_STEP, _SHORTEST_PERIOD, _MAX_WAVES = 2.0, 0.5, float(np.radians(10.0)), 14.0


def joint_processes(
    measurements: Sequence[Measurement], joints: Array, offsets: Array, joint_kernel: Array
) -> dict[str, SmoothErrors]:
    """Of every joint, by what it follows, for the sessions of a rig.

    Args:
        joints: (V, n) rad of all views.
        offsets: (6V, n) twists of the views per unit of each joint.
        joint_kernel: (V, V) of a smooth function of all joints.
    """
    came = joints - np.concatenate([m.views.previous for m in measurements])
    slowly = drift_kernel(measurements, DRIFT_MEMORY["slowly wandering"])
    each = tuple(range(joints.shape[1]))
    kinds = {ALL_ANGLES: joint_kernel, WITH_TIME: (1 + joint_kernel) / 2 * slowly, TIME_ONLY: slowly}
    found = {kind: SmoothErrors(offsets, own, each) for kind, own in kinds.items()}
    found |= (
        _own_angle_processes(joints, came, offsets)
        | _angle_pair_processes(joints, offsets)
        | _periodic_processes(joints, offsets)
    )
    return found | _load_processes([m.views.torques for m in measurements], offsets)


def _moving_joints(joints: Array) -> Mask:
    """(n,) joints that do not stand still in all views (V, n), rad."""
    return np.asarray(np.ptp(joints, axis=0) > _STATIONARY_RANGE)


def _own_angle_processes(joints: Array, travel: Array, offsets: Array) -> dict[str, SmoothErrors]:
    """What each joint does that follows its own angle closely, or the way it came, by these kinds of law; {} where none
    turns.

    Args:
        joints: (V, n) rad.
        travel: (V, n) rad from the view before.
        offsets: (6V, n) twists of the views per unit of each joint.
    """
    own = tuple(map(int, np.flatnonzero(_moving_joints(joints))))
    if not own:
        return {}
    closely = np.array([short_range_kernel(joints[:, k], joints[:, k]) for k in own])
    in_way = np.array([direction_kernel(joints[:, k], travel[:, k]) for k in own])
    kinds = {OWN_ANGLE: closely, TRAVEL: in_way}
    return {kind: SmoothErrors(offsets[:, own], alike, own) for kind, alike in kinds.items()}


def _angle_pair_processes(joints: Array, offsets: Array) -> dict[str, SmoothErrors]:
    """What each joint does that follows its own angle and one other's alone, as joints do that drag each other: of the
    many numbers that a function of all angles may have in few views it has a few. By that kind of law; {} where no
    two are known of which one turns.

    Args:
        joints: (V, n) rad.
        offsets: (6V, n) twists of the views per unit of each joint.
    """
    turns = _moving_joints(joints)
    pairs = [two for two in permutations(range(joints.shape[1]), 2) if turns[[*two]].any()]
    if not pairs:
        return {}
    own, others = (tuple(of) for of in zip(*pairs, strict=True))
    alike = np.array([two_joint_kernel(*joints.T[[*two]]) for two in pairs])
    return {TWO_ANGLES: SmoothErrors(offsets[:, own], alike, own, others)}


def _periodic_processes(joints: Array, offsets: Array) -> dict[str, SmoothErrors]:
    """What each joint does again and again as it turns, as teeth of a gear or of a belt do, by that kind of law; {}
    where none turns.

    Args:
        joints: (V, n) rad.
        offsets: (6V, n) twists of the views per unit of each joint.
    """
    found = [
        (k, period)
        for k, own in enumerate(np.ptp(joints, axis=0))
        if own > _STATIONARY_RANGE
        for period in _candidate_periods(own)
    ]
    if not found:
        return {}
    own, periods = (tuple(of) for of in zip(*found, strict=True))
    alike = np.array([periodic_kernel(joints[:, k], joints[:, k], period) for k, period in found])
    return {WAVES: SmoothErrors(offsets[:, own], alike, own, periods=periods)}


def _candidate_periods(turned: float) -> list[float]:
    """Of waves along a joint that turned so far in all, rad."""
    most = min(_MAX_WAVES, turned / _SHORTEST_PERIOD)
    return [turned / waves for waves in np.arange(_MIN_WAVES, most, _WAVE_STEP)]


def _load_processes(torques: Sequence[Torques], offsets: Array) -> dict[str, SmoothErrors]:
    """What each joint that is bent does under its load, by that kind of law; {} where not the same is known of all.

    Args:
        offsets: (6V, n) twists of the views per unit of each joint.
    """
    first = torques[0]
    if any((own.names, own.measured) != (first.names, first.measured) for own in torques):
        return {}
    values, joint = np.concatenate([own.values for own in torques]), np.array(first.joint)
    changes = np.ptp(values, axis=0) > STILL
    bent = tuple(int(k) for k in np.unique(joint[changes]))
    if not bent:
        return {}
    alike = np.array([load_kernel(values[:, changes & (joint == k)]) for k in bent])
    return {JOINT_LOAD: SmoothErrors(offsets[:, bent], alike, bent)}
