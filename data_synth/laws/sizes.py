"""How large the errors of a good arm are, and what laws of arms are put together from.

Sizes are about 0.15 mrad or 0.05 mm rms. Errors are of the joints (V, n) in rad, or of the flange in its own frame
(V, 6) in rad and mm.
"""

import numpy as np
from numpy.typing import NDArray

from data_synth import kinematics
from data_synth.moment import Plan

Array = NDArray[np.float64]
SIZE, SHIFT = 1.5e-4, 0.05


def joint_with(plan: Plan, amount: Array, rng: np.random.Generator) -> int:
    """One of the useful joints of which there is some; where there is none, the joint of which there is most."""
    some = [i for i in plan.useful if amount[i] > 1e-3 * amount.max()]
    return int(rng.choice(some or [int(np.argmax(amount))]))


def of_joint(plan: Plan, joint: int, course: Array) -> Array:
    """(V, n) of the usual rms about its mean."""
    return at_joint(plan, joint, SIZE * standard(course))


def at_joint(plan: Plan, joint: int, error: Array) -> Array:
    """(V, n) of one joint that errs (V,), rad."""
    out = np.zeros_like(plan.joints)
    out[:, joint] = error
    return out


def of_flange(course: Array, rng: np.random.Generator) -> Array:
    """(V, 6) of the usual rms about its mean, along one direction."""
    return np.outer(standard(course), direction(rng))


def direction(rng: np.random.Generator) -> Array:
    """(6,) of the usual size: 50 µm and 0.15 mrad."""
    turn, shift = (x / np.linalg.norm(x) for x in rng.standard_normal((2, 3)))
    return np.concatenate([SIZE * turn, SHIFT * shift])


def of_base_frame(T: Array, turn: Array, shift: Array) -> Array:
    """(V, 6) of flanges at T (V, 4, 4) that turn and shift so in the base frame, (V, 3) each.

    Turn and shift belong together: the one that is larger for its kind has the usual size.
    """
    error = np.concatenate([np.einsum("vji,vj->vi", T[:, :3, :3], x) for x in (turn, shift)], axis=1)
    sizes = np.sqrt((error.reshape(-1, 2, 3) ** 2).sum(axis=2).mean(axis=0)) / [SIZE, SHIFT]
    return np.asarray(error / max(float(sizes.max()), 1e-12))


def standard(course: Array) -> Array:
    """About its mean, of rms 1; 0 where it does not change."""
    return np.asarray((course - course.mean()) / max(float(course.std()), 1e-12))


def clock(plan: Plan, time: Array | None) -> tuple[Array, float]:
    """Steps since the first view, and how many there are."""
    steps = np.arange(len(plan.joints), dtype=float) if time is None else time - time.min()
    return steps, float(np.ptp(steps)) + 1.0


def torque_of(plan: Plan) -> Array:
    """(V, n) of gravity, which is there where the controller does not know it."""
    return plan.torque if np.ptp(plan.torque, axis=0).any() else kinematics.gravity_torques(plan.arm, plan.joints)
