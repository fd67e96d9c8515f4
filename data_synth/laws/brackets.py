"""Laws of brackets: a beam from the flange bends and twists under the weight at its end.

Euler and Bernoulli's beam, its slope and deflection added up along its length. What bends it turns with the flange.
"""

import numpy as np
from numpy.typing import NDArray

from data_synth import kinematics
from data_synth.moment import Moment, Plan
from stitch.numerics import frames

Array = NDArray[np.float64]
Parameters = dict[str, float]
# Rad by which the end of a beam turns at amplitude 1, from the mean of all views to the one where it turns most.
_TURN = 2.5e-4
_PIECES = 64
# What says where the beam and the weight are, and not how much it gives way.
GEOMETRY = tuple(f"{vector}{axis}" for vector in ("end_", "load_", "weak_") for axis in "xyz")


def draw(amplitude: float, plan: Plan, rng: np.random.Generator) -> Parameters:
    """A beam of 80 to 160 mm about along the flange's axis, up to four times as stiff about one axis as about another,
    the weight's centre off its end by a quarter to a half of its length."""
    return _draw_along(np.array([0.0, 0.0, 1.0]) + 0.4 * rng.standard_normal(3), amplitude, plan, rng)


def draw_oblique(amplitude: float, plan: Plan, rng: np.random.Generator) -> Parameters:
    """The same at 30 to 80° from the flange's axis."""
    off, around = np.radians(rng.uniform(30, 80)), rng.uniform(0, 2 * np.pi)
    end = np.array([np.sin(off) * np.cos(around), np.sin(off) * np.sin(around), np.cos(off)])
    return _draw_along(end, amplitude, plan, rng)


def _draw_along(end: Array, amplitude: float, plan: Plan, rng: np.random.Generator) -> Parameters:
    end *= rng.uniform(80, 160) / np.linalg.norm(end)
    load = rng.standard_normal(3)
    load *= rng.uniform(0.25, 0.5) * np.linalg.norm(end) / np.linalg.norm(load)
    weak = np.cross(end, rng.standard_normal(3))
    vectors = np.concatenate([end, load, weak / np.linalg.norm(weak)])
    p = dict(zip(GEOMETRY, map(float, vectors), strict=True))
    strong = 1 / rng.uniform(1, 4)
    p |= {"bend_weak": 1.0, "bend_strong": strong, "twist": float(rng.uniform(0.5, 1.5) * (1 + strong) / 2)}
    down = np.einsum("vji,j->vi", kinematics.flange(plan.arm, plan.joints)[:, :3, :3], [0.0, 0.0, -1.0])
    turns = np.array([end_twist(p, d)[:3] for d in down - down.mean(axis=0)])
    size = amplitude * _TURN / np.linalg.norm(turns, axis=1).max()
    return p | {name: size * p[name] for name in ("bend_weak", "bend_strong", "twist")}


def end_twist(p: Parameters, down: Array) -> Array:
    """(6,) twist of the beam's end about the flange's origin, where gravity points `down` in the flange's frame."""
    end, load, weak = np.array([p[name] for name in GEOMETRY]).reshape(3, 3)
    length = np.linalg.norm(end)
    along = end / length
    axes = np.column_stack([weak, np.cross(along, weak), along])
    softness = np.array([p["bend_weak"], p["bend_strong"], p["twist"]])
    turn, shift = np.zeros(3), np.zeros(3)
    for at in (np.arange(_PIECES) + 0.5) / _PIECES * length:
        moment = np.cross(end + load - at * along, down)
        bent = axes @ (softness * (axes.T @ moment)) * length / _PIECES
        turn += bent
        shift += np.cross(bent, end - at * along)
    return np.concatenate([turn, shift - np.cross(turn, end)])


def mount_droop(p: Parameters, moment: Moment, T: Array) -> Array:
    """The scanner sits at the end of the beam; of an oblique one this is `mount_bend`."""
    return np.asarray(frames.exp(end_twist(p, moment.gravity_mount)) @ T)


def fixture_droop(p: Parameters, moment: Moment, T: Array) -> Array:
    """The part sits at the end of the beam, in the reference frame; of an oblique one this is `fixture_bend`."""
    return np.asarray(frames.exp(end_twist(p, moment.gravity_reference)) @ T)
