"""Laws that bend the arm: true joint angles q* and true DH rows from the reported ones."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from data_synth.arms import Arm
from data_synth.moment import Moment, Plan

Array = NDArray[np.float64]
Parameters = dict[str, float]


def draw_one(letter: str, size: float, sign: bool = False) -> Callable[[float, Plan, np.random.Generator], Parameters]:
    """One joint of those that this cell can show."""

    def draw(amplitude: float, plan: Plan, rng: np.random.Generator) -> Parameters:
        joint = int(rng.choice(plan.useful))
        return {f"{letter}{joint + 1}": size * amplitude * (rng.choice([-1.0, 1.0]) if sign else 1.0)}

    return draw


def draw_all(letter: str, size: float) -> Callable[[float, Plan, np.random.Generator], Parameters]:
    """All joints, each between half and one and a half times the size."""

    def draw(amplitude: float, plan: Plan, rng: np.random.Generator) -> Parameters:
        sizes = size * amplitude * rng.uniform(0.5, 1.5, plan.arm.joints)
        return {f"{letter}{i + 1}": float(x) for i, x in enumerate(sizes)}

    return draw


def draw_wave(size: float) -> Callable[[float, Plan, np.random.Generator], Parameters]:
    """One joint, any phase."""

    def draw(amplitude: float, plan: Plan, rng: np.random.Generator) -> Parameters:
        joint, phase = int(rng.choice(plan.useful)) + 1, rng.uniform(0, 2 * np.pi)
        return {f"A{joint}": size * amplitude * np.cos(phase), f"B{joint}": size * amplitude * np.sin(phase)}

    return draw


def draw_compliance(amplitude: float, plan: Plan, rng: np.random.Generator) -> Parameters:
    """Joints 2 and 3 carry the arm: 0.5 mrad at the largest torque of joint 2."""
    c = 5e-4 * amplitude / max(float(np.abs(plan.torque[:, 1]).max()), 1e-9)
    return {"c2": c * rng.uniform(0.8, 1.2), "c3": c * rng.uniform(0.8, 1.2)}


def draw_thermal(amplitude: float, plan: Plan, rng: np.random.Generator) -> Parameters:
    """One joint that follows the arm's temperature, the first of those that a library knows."""
    return {**draw_one("k", 6e-5, sign=True)(amplitude, plan, rng), "T": 0.0}


def draw_warm_link(amplitude: float, plan: Plan, rng: np.random.Generator) -> Parameters:
    """One of the long links ahead of the wrist, which follows the same."""
    long = [j for j in plan.useful if np.hypot(plan.arm.a[j], plan.arm.d[j]) > 100 and j + 1 < plan.arm.joints]
    return {f"g{int(rng.choice(long)) + 1}": 4e-5 * amplitude, "T": 0.0}


def draw_step(amplitude: float, plan: Plan, rng: np.random.Generator) -> Parameters:
    """One joint that loses counts in the middle third of the session."""
    views = len(plan.joints)
    lost = draw_one("d", 3e-4, sign=True)(amplitude, plan, rng)
    return {**lost, "v": float(rng.integers(views // 3, 2 * views // 3 + 1))}


def draw_link(amplitude: float, plan: Plan, rng: np.random.Generator) -> Parameters:
    """One length and one angle of a link between the base and the wrist are off."""
    joint = int(rng.choice([j for j in plan.useful if j + 1 < plan.arm.joints])) + 1
    sign = rng.choice([-1.0, 1.0], 2)
    return {f"da{joint}": 0.25 * amplitude * sign[0], f"dalpha{joint}": 3e-4 * amplitude * sign[1]}


def joint_offset(p: Parameters, moment: Moment, q: Array) -> Array:
    """q* = q + δ."""
    return q + _of(p, "d", len(q))


def joint_compliance(p: Parameters, moment: Moment, q: Array) -> Array:
    """q* = q + c τ(q)."""
    return q + _of(p, "c", len(q)) * moment.torque


def wave(order: int) -> Callable[[Parameters, Moment, Array], Array]:
    """q* = q + A sin(k q) + B cos(k q)."""

    def act(p: Parameters, moment: Moment, q: Array) -> Array:
        angle = order * moment.joints
        return q + _of(p, "A", len(q)) * np.sin(angle) + _of(p, "B", len(q)) * np.cos(angle)

    return act


def backlash(p: Parameters, moment: Moment, q: Array) -> Array:
    """q* = q − b·approach."""
    return q - _of(p, "b", len(q)) * moment.approach


def settling(p: Parameters, moment: Moment, q: Array) -> Array:
    """q* = q + s (q − q of the view before)."""
    return q + _of(p, "s", len(q)) * (moment.joints - moment.previous)


def joint_thermal(p: Parameters, moment: Moment, q: Array) -> Array:
    """q* = q + k (T − T₀)."""
    warmer = moment.covariates["robot_temperature_c"] - moment.start["robot_temperature_c"]
    return q + _of(p, "k", len(q)) * warmer


def joint_step(p: Parameters, moment: Moment, q: Array) -> Array:
    """From view v on one joint stands elsewhere than it reports."""
    return q + _of(p, "d", len(q)) if moment.index >= p["v"] else q


def latency(p: Parameters, moment: Moment, q: Array) -> Array:
    """q* = q + q̇ Δt."""
    return q + moment.velocity * p["dt"]


def link_geometry(p: Parameters, moment: Moment, arm: Arm) -> Arm:
    """DH rows off by da, dd, dalpha."""
    n = arm.joints
    return replace(arm, a=arm.a + _of(p, "da", n), d=arm.d + _of(p, "dd", n), alpha=arm.alpha + _of(p, "dalpha", n))


def link_thermal(p: Parameters, moment: Moment, arm: Arm) -> Arm:
    """The lengths of one link × (1 + g ΔT) since the first view."""
    warmer = moment.covariates["robot_temperature_c"] - moment.start["robot_temperature_c"]
    factor = 1 + _of(p, "g", arm.joints) * warmer
    return replace(arm, a=arm.a * factor, d=arm.d * factor)


def robot_thermal_growth(p: Parameters, moment: Moment, arm: Arm) -> Arm:
    """All lengths × (1 + g ΔT) since the first view."""
    warmer = moment.covariates["robot_temperature_c"] - moment.start["robot_temperature_c"]
    factor = 1 + p["g"] * warmer
    return replace(arm, a=arm.a * factor, d=arm.d * factor)


def _of(p: Parameters, letter: str, joints: int) -> Array:
    return np.array([p.get(f"{letter}{i + 1}", 0.0) for i in range(joints)])
