"""Laws of arms of a third hand, written without knowing what looks for them: a blind test of it.

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

_SIZES = np.repeat([SIZE, SHIFT], 3) / np.sqrt(3)  # of turn and shift along every axis
_ROUNDING = 1e-9  # a leaning of gravity below this is none


def two_flanks(plan: Plan, rng: np.random.Generator) -> Array:
    """Either flank of a pinion is cut off centre its own way: sin(m q_i + φ), going down sin(m q_i + φ + δ)."""
    i = joint_with(plan, np.ptp(plan.joints, axis=0), rng)
    way = np.diff(plan.joints[:, i], prepend=plan.joints[0, i])
    moved = np.maximum.accumulate(np.where(way != 0, np.arange(len(way)), 0))  # one that stands stays on its flank
    other = rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 1.0) * np.pi * (way[moved] < 0)
    return of_joint(plan, i, np.sin(rng.integers(2, 6) * plan.joints[:, i] + other + rng.uniform(0, 2 * np.pi)))


def cardan_shaft(plan: Plan, rng: np.random.Generator) -> Array:
    """A shaft with two Cardan joints, forks a little askew, is bent by a neighbouring joint: tan²(β/2) sin 2(q_i + φ).

    It is straight, β = 0, at q₀ of the neighbour, and bends with q_k − q₀ by 45° at most.
    """
    i = joint_with(plan, np.ptp(plan.joints, axis=0), rng)
    q = plan.joints[:, _neighbour(plan, i, rng)]
    off = q - np.quantile(q, rng.uniform(0.1, 0.9))
    bend = np.radians(rng.uniform(25, 45)) * off / max(float(np.abs(off).max()), 1e-12)
    return of_joint(plan, i, np.tan(bend / 2) ** 2 * np.sin(2 * (plan.joints[:, i] + rng.uniform(0, np.pi))))


def lobed_bearing(plan: Plan, rng: np.random.Generator) -> Array:
    """Rings of m and m + 1 lobes tip a joint's axis round m times a turn, on an ellipse: (cos, b sin)(m q_i + φ).

    The joint's own angle is right. The tilt is what there is beside its mean, an axis askew.
    """
    i, frames = joint_with(plan, np.ptp(plan.joints, axis=0), rng), kinematics.links(plan.arm, plan.joints)
    angle = rng.integers(3, 6) * plan.joints[:, i] + rng.uniform(0, 2 * np.pi)
    narrow = rng.choice([-1.0, 1.0]) * rng.uniform(0.4, 1.0)
    tilt = np.column_stack([np.cos(angle), narrow * np.sin(angle), 0 * angle])
    turn = np.einsum("vij,vj->vi", frames[:, i, :3, :3], tilt - tilt.mean(axis=0))
    return of_base_frame(frames[:, -1], turn, np.cross(turn, frames[:, -1, :3, 3] - frames[:, i, :3, 3]))


def tethered_tool(plan: Plan, rng: np.random.Generator) -> Array:
    """A hose from the ceiling at p pulls the tool once it is taut: (d − s)₊ towards p, d = |p − x|; the holder yields.

    It pulls beside the flange's middle, and so tips the tool too. What it pulls on average arms are measured in with.
    """
    T = kinematics.flange(plan.arm, plan.joints)
    x, reach = T[:, :3, 3], float(np.linalg.norm(T[:, :3, 3], axis=1).max())
    hook = np.append(rng.uniform(-0.6, 0.6, 2) * reach, x[:, 2].max() + rng.uniform(0.3, 0.8) * reach)
    d = np.linalg.norm(hook - x, axis=1)
    taut = np.maximum(d - np.quantile(d, rng.uniform(0.1, 0.4)), 0.0)
    pull = (hook - x) * (taut / np.maximum(d, 1e-12))[:, None]
    pull = pull - pull.mean(axis=0)
    azimuth, out, along = rng.uniform(0, 2 * np.pi), rng.uniform(50, 100), rng.uniform(50, 150)
    lever = T[:, :3, :3] @ np.array([out * np.cos(azimuth), out * np.sin(azimuth), along])
    radius = rng.uniform(80, 200)  # mm: a holder's stiffness against turning is that against shifting by its square
    return of_base_frame(T, np.cross(lever, pull) / radius**2, pull)


def three_seats(plan: Plan, rng: np.random.Generator) -> Array:
    """A tool with play in its changer drops onto one of three balls, u_k at 120°: argmax u_k·(g − g₀) says which.

    g is gravity across the flange's axis, g₀ what the hose bears. Every seat has a turn and a shift of its own.
    """
    lean = -kinematics.flange(plan.arm, plan.joints)[:, 2, :2]
    lean = lean - [np.quantile(g, rng.uniform(0.3, 0.7)) for g in lean.T]
    lean = np.where(np.abs(lean) > _ROUNDING, lean, 0.0)
    azimuth = rng.uniform(0, 2 * np.pi) + 2 * np.pi / 3 * np.arange(3)
    seat = np.argmax(lean @ [np.cos(azimuth), np.sin(azimuth)], axis=1)
    return _of_usual_size(rng.standard_normal((3, 6))[seat])


def creeping_belt(plan: Plan, rng: np.random.Generator, time: Array | None = None) -> Array:
    """A belt of plastic gives to a load by and by and remembers those before: h ← τ_i + (h − τ_i) e^(−Δt/T).

    T is three to eight usual steps; in a long enough pause it gives to the whole of the load.

    Args:
        time: (V,) of the views, in usual steps from one to the next; their numbers where it is not given.
    """
    torque, (t, _) = torque_of(plan), clock(plan, time)
    i = joint_with(plan, np.ptp(torque, axis=0), rng)
    load, kept = torque[:, i], np.exp(-np.abs(np.diff(t)) / rng.uniform(3, 8))
    given = load.copy()
    for v in range(1, len(t)):
        given[v] = load[v] + kept[v - 1] * (given[v - 1] - load[v])
    return of_joint(plan, i, given)


def snapping_lens(plan: Plan, rng: np.random.Generator, time: Array | None = None) -> Array:
    """A lens loose in its thread snaps to and fro between two rests, three to six times, at random; `time` as above."""
    t, whole = clock(plan, time)
    spells = rng.uniform(0.4, 2.0, int(rng.integers(4, 8)))
    snaps = whole * np.cumsum(spells)[:-1] / spells.sum()
    return of_flange(np.searchsorted(snaps, t, side="right") % 2.0, rng)


def loosening_screw(plan: Plan, rng: np.random.Generator, time: Array | None = None) -> Array:
    """Every move shakes a tool anew in all directions, the more the looser its screw: noise (c + (t/T)^p).

    Args:
        time: as above.
    """
    t, whole = clock(plan, time)
    loose = rng.uniform(0.05, 0.2) + (t / whole) ** rng.uniform(1.0, 3.0)
    return _of_usual_size(loose[:, None] * rng.standard_normal((len(t), 6)))


LATER: dict[str, Callable[..., Array]] = {
    law.__name__: law
    for law in (
        *(two_flanks, cardan_shaft, lobed_bearing, tethered_tool),
        *(three_seats, creeping_belt, snapping_lens, loosening_screw),
    )
}
LATER_IN_TIME = ("snapping_lens", "loosening_screw")  # the others follow the joints, `creeping_belt` time as well
LATER_OF_FLANGE = (*LATER_IN_TIME, "lobed_bearing", "tethered_tool", "three_seats")


def _neighbour(plan: Plan, joint: int, rng: np.random.Generator) -> int:
    """A joint beside this one that moves, whether useful or not."""
    beside = tuple(k for k in (joint - 1, joint + 1) if 0 <= k < plan.joints.shape[1])
    return joint_with(replace(plan, useful=beside), np.ptp(plan.joints, axis=0), rng)


def _of_usual_size(error: Array) -> Array:
    """(V, 6) about its mean, of the usual rms along every axis."""
    return np.column_stack([size * standard(course) for size, course in zip(_SIZES, error.T, strict=True)])
