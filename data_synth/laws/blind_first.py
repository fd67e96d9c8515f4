"""Laws of arms that were written after, and apart from, what looks for formulas: a blind test of it.

Each is drawn for one arm and returns errors of the joints (V, n) in rad, or of the flange in its own frame (V, 6) in
rad and mm. Sizes are about 0.15 mrad or 0.05 mm rms, what a good arm is off by.
"""

from collections.abc import Callable

import numpy as np

from data_synth import kinematics
from data_synth.laws.sizes import Array, clock, joint_with, of_base_frame, of_flange, of_joint, torque_of
from data_synth.moment import Plan

_FOOT = 250.0  # mm from a base's middle to its anchor bolts


def flank_change(plan: Plan, rng: np.random.Generator) -> Array:
    """A worn gear rests on one flank of its teeth or the other: tanh((τ_i − τ₀)/w), the balancer bears τ₀."""
    torque = torque_of(plan)
    i = joint_with(plan, np.ptp(torque, axis=0), rng)
    load = torque[:, i] - np.quantile(torque[:, i], rng.uniform(0.3, 0.7))
    return of_joint(plan, i, np.tanh(load / (rng.uniform(0.15, 0.4) * max(float(load.std()), 1e-12))))


def softening_belt(plan: Plan, rng: np.random.Generator, time: Array | None = None) -> Array:
    """A belt yields more to the load as the arm warms, less than usual at first: τ_i (g − ḡ), g = 1 − e^(−t/T).

    Args:
        time: (V,) of the views, in usual steps from one to the next; their numbers where it is not given.
    """
    torque, (t, whole) = torque_of(plan), clock(plan, time)
    i = joint_with(plan, np.ptp(torque, axis=0), rng)
    warm = 1 - np.exp(-t / (rng.uniform(0.2, 0.6) * whole))
    return of_joint(plan, i, torque[:, i] * (warm - warm.mean()))


def slack_cable(plan: Plan, rng: np.random.Generator) -> Array:
    """A cable twists with two neighbouring joints and pulls once its slack s is used up: x − clip(x, −s, s)."""
    i = joint_with(plan, np.ptp(plan.joints, axis=0), rng)
    twist = plan.joints[:, i] + plan.joints[:, i + 1 if i + 1 < plan.joints.shape[1] else i - 1]
    twist = twist - np.quantile(twist, rng.uniform(0.35, 0.65))
    slack = np.quantile(np.abs(twist), rng.uniform(0.35, 0.65))
    return of_joint(plan, i, rng.choice([-1.0, 1.0]) * (twist - np.clip(twist, -slack, slack)))


def scale_segments(plan: Plan, rng: np.random.Generator) -> Array:
    """An encoder's scale put together of three to six pieces along the way, each glued on a little off."""
    i = joint_with(plan, np.ptp(plan.joints, axis=0), rng)
    q, pieces = plan.joints[:, i], int(rng.integers(3, 7))
    seams = q.min() + np.ptp(q) * (np.arange(1, pieces) + rng.uniform(-0.3, 0.3, pieces - 1)) / pieces
    return of_joint(plan, i, rng.standard_normal(pieces)[np.searchsorted(seams, q)])


def motor_heat(plan: Plan, rng: np.random.Generator) -> Array:
    """The motor of one joint warms with the way it goes and cools over three to eight views: h ← ρ h + |Δq_i|."""
    i = joint_with(plan, np.ptp(plan.joints, axis=0), rng)
    way = np.abs(np.diff(plan.joints[:, i], prepend=plan.joints[0, i]))
    ago = np.subtract.outer(np.arange(len(way)), np.arange(len(way)))
    kept = np.where(ago >= 0, np.exp(-np.maximum(ago, 0) / rng.uniform(3, 8)), 0.0)
    return of_joint(plan, i, rng.choice([-1.0, 1.0]) * (kept @ way))


def loose_anchor(plan: Plan, rng: np.random.Generator) -> Array:
    """The base tips towards one loose bolt once the arm's centre of mass is out beyond s there: max(0, c·u − s)."""
    centre, T = _centre_of_mass(plan)[:, :2], kinematics.flange(plan.arm, plan.joints)
    towards = centre[rng.integers(len(centre))]
    azimuth = np.arctan2(towards[1], towards[0]) + rng.uniform(-1, 1)
    u = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    out = centre @ u[:2]
    tilt = np.outer(np.maximum(out - np.quantile(out, rng.uniform(0.2, 0.5)), 0.0), [-u[1], u[0], 0.0])
    shift = np.cross(tilt, T[:, :3, 3] + _FOOT * u)  # it turns about the bolt across
    return of_base_frame(T, tilt, shift)


def work_breaks(plan: Plan, rng: np.random.Generator, time: Array | None = None) -> Array:
    """The arm warms up, cools in breaks and starts anew at t_k: 1 − e^(−(t − t_k)/T); `time` as above."""
    t, whole = clock(plan, time)
    spells = int(rng.integers(3, 5))
    starts = whole * (np.arange(1, spells) + rng.uniform(-0.25, 0.25, spells - 1)) / spells
    since = t - np.append(0.0, starts)[np.searchsorted(starts, t, side="right")]
    return of_flange(1 - np.exp(-since / (rng.uniform(0.3, 0.8) * whole / spells)), rng)


def heating_overshoot(plan: Plan, rng: np.random.Generator, time: Array | None = None) -> Array:
    """The hall's heating, switched on, overshoots and settles: e^(−t/T) cos(2πt/P + φ); `time` as above."""
    t, whole = clock(plan, time)
    swing = np.cos(2 * np.pi * t / (rng.uniform(0.2, 0.35) * whole) + rng.uniform(0, 2 * np.pi))
    return of_flange(np.exp(-t / (rng.uniform(0.35, 0.7) * whole)) * swing, rng)


FOREIGN: dict[str, Callable[..., Array]] = {
    law.__name__: law
    for law in (
        *(flank_change, softening_belt, slack_cable, scale_segments),
        *(motor_heat, loose_anchor, work_breaks, heating_overshoot),
    )
}
FOREIGN_IN_TIME = ("work_breaks", "heating_overshoot")  # the others follow the joints, `softening_belt` time as well
FOREIGN_OF_FLANGE = (*FOREIGN_IN_TIME, "loose_anchor")


def _centre_of_mass(plan: Plan) -> Array:
    """(V, 3) mm of links and payload, in the base frame."""
    arm, frames = plan.arm, kinematics.links(plan.arm, plan.joints)
    centres = np.einsum("vnij,nj->vni", frames[:, 1:, :3, :3], arm.com) + frames[:, 1:, :3, 3]
    load = frames[:, -1, :3, :3] @ np.array(arm.payload_com) + frames[:, -1, :3, 3]
    moment = np.einsum("n,vni->vi", arm.mass, centres) + arm.payload_mass * load
    return np.asarray(moment / max(float(arm.mass.sum()) + arm.payload_mass, 1e-12))
