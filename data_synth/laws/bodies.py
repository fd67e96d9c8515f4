"""Laws that move base, scanner or part, or change the part's shape."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from data_synth import kinematics
from data_synth.moment import Moment, Plan
from stitch.numerics import frames

Array = NDArray[np.float64]
Parameters = dict[str, float]
_NAMES = ("rx", "ry", "rz", "tx", "ty", "tz")
_HOUR = 3600.0


def draw_twist(rotation: float, translation: float) -> Callable[[float, Plan, np.random.Generator], Parameters]:
    """A twist of random direction; sizes in rad and mm."""

    def draw(amplitude: float, plan: Plan, rng: np.random.Generator) -> Parameters:
        directions = rng.standard_normal((2, 3))
        directions *= amplitude / np.linalg.norm(directions, axis=1, keepdims=True)
        twist = np.concatenate([directions[0] * rotation, directions[1] * translation])
        return dict(zip(_NAMES, map(float, twist), strict=True))

    return draw


def draw_warmup(amplitude: float, plan: Plan, rng: np.random.Generator) -> Parameters:
    """Settles with a time constant of 8 to 15 minutes."""
    return {**draw_twist(4e-4, 0.12)(amplitude, plan, rng), "T_c": float(rng.uniform(480, 900))}


def draw_creep(amplitude: float, plan: Plan, rng: np.random.Generator) -> Parameters:
    """Fast in the first half minute to two minutes, ever slower after."""
    return {**draw_twist(1.2e-4, 0.04)(amplitude, plan, rng), "tau": float(rng.uniform(30, 120))}


def draw_base(amplitude: float, plan: Plan, rng: np.random.Generator) -> Parameters:
    """A foundation that tilts by 0.15 mrad under the largest moment of this plan."""
    largest = float(np.abs(kinematics.base_moments(plan.arm, plan.joints)).max())
    softness = 1.5e-4 * amplitude * rng.uniform(0.7, 1.3, 2) / max(largest, 1e-9)
    return dict(zip(("c_x", "c_y"), map(float, softness), strict=True))


def draw_slip(rotation: float, translation: float) -> Callable[[float, Plan, np.random.Generator], Parameters]:
    """A twist at a view in the middle third of the session."""

    def draw(amplitude: float, plan: Plan, rng: np.random.Generator) -> Parameters:
        views = len(plan.joints)
        twist = draw_twist(rotation, translation)(amplitude, plan, rng)
        return {"v": float(rng.integers(views // 3, 2 * views // 3 + 1)), **twist}

    return draw


def mount_drift(p: Parameters, moment: Moment, T: Array) -> Array:
    """M·exp(ξ t / 1 h)."""
    return T @ frames.exp(_twist(p) * moment.time / _HOUR)


def mount_warmup(p: Parameters, moment: Moment, T: Array) -> Array:
    """M·exp(ξ (1 − e^(−t/T_c)))."""
    return T @ frames.exp(_twist(p) * (1 - np.exp(-moment.time / p["T_c"])))


def mount_creep(p: Parameters, moment: Moment, T: Array) -> Array:
    """M·exp(ξ log(1 + t/τ))."""
    return T @ frames.exp(_twist(p) * np.log(1 + moment.time / p["tau"]))


def base_compliance(p: Parameters, moment: Moment, T: Array) -> Array:
    """The base gives way to the moment of arm and load: (..., 4, 4) of the flange turn about the base's origin."""
    moments = kinematics.base_moments(moment.arm, moment.joints)
    return np.asarray(frames.exp(np.array([p["c_x"] * moments[0], p["c_y"] * moments[1], 0, 0, 0, 0])) @ T)


def mount_step(p: Parameters, moment: Moment, T: Array) -> Array:
    """From view v on the scanner sits displaced."""
    return T @ frames.exp(_twist(p)) if moment.index >= p["v"] else T


def fixture_drift(p: Parameters, moment: Moment, T: Array) -> Array:
    """The part creeps in the reference frame: exp(ξ t / 1 h)."""
    return np.asarray(frames.exp(_twist(p) * moment.time / _HOUR) @ T)


def part_slip(p: Parameters, moment: Moment, T: Array) -> Array:
    """From view v on the part sits displaced in the reference frame."""
    return np.asarray(frames.exp(_twist(p)) @ T) if moment.index >= p["v"] else T


def part_growth(p: Parameters, moment: Moment, vertices: Array) -> Array:
    """Scaled about the part frame's origin, 1 + g ΔT since the first view."""
    warmer = moment.covariates["part_temperature_c"] - moment.start["part_temperature_c"]
    return vertices * (1 + p["g"] * warmer)


def part_sag(p: Parameters, moment: Moment, vertices: Array) -> Array:
    """A point at height h above the clamp plane moves κ h² along gravity."""
    return vertices + p["kappa"] * vertices[:, 2:] ** 2 * moment.gravity_part


def _twist(p: Parameters) -> Array:
    return np.array([p[name] for name in _NAMES])
