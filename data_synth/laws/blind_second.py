"""Laws of arms that were written after, and apart from, what judges them, and are of other kinds than those before.

Each is drawn for one arm and returns errors of the joints (V, n) in rad, or of the flange in its own frame (V, 6) in
rad and mm. Sizes are about 0.15 mrad or 0.05 mm rms, what a good arm is off by.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from data_synth import kinematics
from data_synth.laws.sizes import (
    SHIFT,
    SIZE,
    Array,
    clock,
    joint_with,
    of_base_frame,
    of_flange,
    of_joint,
    standard,
    torque_of,
)
from data_synth.moment import Plan

_KNOTS = 3  # of a correction table, along either joint


def differential_wheel(plan: Plan, rng: np.random.Generator) -> Array:
    """A differential's eccentric wheel, turned by two neighbouring joints, errs both: sin(m (q_i ± q_k) + φ)."""
    i = joint_with(plan, np.ptp(plan.joints, axis=0), rng)
    k, sign = _other(plan, i, rng, beside=True), rng.choice([-1.0, 1.0])
    wheel = rng.uniform(1.2, 2.5) * (plan.joints[:, i] + sign * plan.joints[:, k])
    out = of_joint(plan, i, np.sin(wheel + rng.uniform(0, 2 * np.pi)))
    if k != i and k in plan.useful:
        out[:, k] = sign * out[:, i]
        out /= np.sqrt(2)
    return out


def ring_bolts(plan: Plan, rng: np.random.Generator) -> Array:
    """A gear's ring yields less to the load at each of its N bolts: (τ_i − τ₀) cos(N q_i + φ), a balancer bears τ₀."""
    torque = torque_of(plan)
    i = joint_with(plan, np.ptp(torque, axis=0), rng)
    load = torque[:, i] - np.quantile(torque[:, i], rng.uniform(0.3, 0.7))
    return of_joint(plan, i, load * np.cos(rng.integers(5, 9) * plan.joints[:, i] + rng.uniform(0, 2 * np.pi)))


def stopping_kick(plan: Plan, rng: np.random.Generator) -> Array:
    """A joint is kicked as another stops, by its way and the lever it stands at, and sticks: Δq_k cos(q_k + φ)."""
    i = joint_with(plan, np.ptp(plan.joints, axis=0), rng)
    q = plan.joints[:, _other(plan, i, rng)]
    return of_joint(plan, i, np.diff(q, prepend=q[0]) * np.cos(q + rng.uniform(0, 2 * np.pi)))


def correction_table(plan: Plan, rng: np.random.Generator) -> Array:
    """The maker's table that corrects a joint for where it and another stand, nine knots with lines between, is off."""
    i = joint_with(plan, np.ptp(plan.joints, axis=0), rng)
    along, across = (_between_knots(plan.joints[:, j]) for j in (i, _other(plan, i, rng)))
    return of_joint(plan, i, np.einsum("va,vb,ab->v", along, across, rng.standard_normal((_KNOTS, _KNOTS))))


def slipping_bush(plan: Plan, rng: np.random.Generator, time: Array | None = None) -> Array:
    """A gear's wheel sits on an eccentric bush that slips round in it once: sin(q_i + φ), from t_s on sin(q_i + φ + δ).

    Args:
        time: (V,) of the views, in usual steps from one to the next; their numbers where it is not given.
    """
    t, whole = clock(plan, time)
    i = joint_with(plan, np.ptp(plan.joints, axis=0), rng)
    slip = rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 1.0) * np.pi * (t > rng.uniform(0.3, 0.7) * whole)
    return of_joint(plan, i, np.sin(plan.joints[:, i] + slip + rng.uniform(0, 2 * np.pi)))


def bending_tubes(plan: Plan, rng: np.random.Generator) -> Array:
    """Tubes, and not joints, bend like a beam: the flange sags by r³ and tips by 3/2 r², r the reach past a stiff part.

    Both are what there is beside the mean, for which arms are measured in.
    """
    frames = kinematics.links(plan.arm, plan.joints)
    reach = frames[:, -1, :2, 3] - frames[:, 1, :2, 3]
    r = np.linalg.norm(reach, axis=1)
    length = max(float(r.max()), 1e-12)
    bent = np.maximum(r / length - rng.uniform(0.0, 0.3), 0.0)
    sag, tip = length * (bent**3 - (bent**3).mean()), 1.5 * (bent**2 - (bent**2).mean())
    x, y = (reach / np.maximum(r, 1e-12)[:, None]).T
    turn = np.column_stack([-y * tip, x * tip, 0 * tip])
    return of_base_frame(frames[:, -1], turn, np.outer(sag, [0.0, 0.0, -1.0]))


def knocks_on_rubber(plan: Plan, rng: np.random.Generator, time: Array | None = None) -> Array:
    """Knocks move the tool on its rubber, each its own way, and it creeps back in part: s + (1 − s) e^(−(t − t_k)/T).

    Args:
        time: as above.
    """
    (t, whole), knocks = clock(plan, time), int(rng.integers(2, 5))
    rest, back = rng.uniform(0.1, 0.4), rng.uniform(0.06, 0.15) * whole
    since = np.subtract.outer(whole * (np.arange(knocks) + rng.uniform(0.2, 0.8, knocks)) / knocks, t)
    courses = np.where(since <= 0, rest + (1 - rest) * np.exp(np.minimum(since, 0.0) / back), 0.0)
    return np.asarray(sum(of_flange(course, rng) for course in courses) / np.sqrt(knocks))


def restless_carrier(plan: Plan, rng: np.random.Generator, time: Array | None = None) -> Array:
    """A carrier's screws give by small slips in every direction, its pins draw it back: a walk, held for 4 to 10 views.

    Args:
        time: as above.
    """
    t, _ = clock(plan, time)
    kept = np.exp(-np.abs(np.diff(t)) / rng.uniform(4, 10))
    walk = rng.standard_normal((len(t), 6))
    for v in range(1, len(t)):
        walk[v] = kept[v - 1] * walk[v - 1] + np.sqrt(1 - kept[v - 1] ** 2) * walk[v]
    sizes = np.repeat([SIZE, SHIFT], 3) / np.sqrt(3)
    return np.column_stack([size * standard(course) for size, course in zip(sizes, walk.T, strict=True)])


FURTHER: dict[str, Callable[..., Array]] = {
    law.__name__: law
    for law in (
        *(differential_wheel, ring_bolts, stopping_kick, correction_table),
        *(slipping_bush, bending_tubes, knocks_on_rubber, restless_carrier),
    )
}
FURTHER_IN_TIME = ("knocks_on_rubber", "restless_carrier")  # the others follow the joints, `slipping_bush` time as well
FURTHER_OF_FLANGE = (*FURTHER_IN_TIME, "bending_tubes")


def _other(plan: Plan, joint: int, rng: np.random.Generator, *, beside: bool = False) -> int:
    """A joint that moves and is not this one, whether useful or not; with `beside` one of its neighbours."""
    others = (k for k in range(plan.joints.shape[1]) if k != joint and (not beside or abs(k - joint) == 1))
    return joint_with(replace(plan, useful=tuple(others)), np.ptp(plan.joints, axis=0), rng)


def _between_knots(q: Array) -> Array:
    """(V, knots) weights of knots evenly along the way of a joint, those of lines from knot to knot."""
    at = (_KNOTS - 1) * (q - q.min()) / max(float(np.ptp(q)), 1e-12)
    return np.asarray(np.maximum(1 - np.abs(np.subtract.outer(at, np.arange(_KNOTS))), 0.0))
