"""Laws of a scanner's mount that no library holds: a course over the views times one twist of the flange."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from data_synth import kinematics
from data_synth.moment import Moment, Plan
from data_synth.nature import LAWS, Law, Parameters
from stitch.numerics import frames

Array = NDArray[np.float64]
Course = Callable[[Plan, np.random.Generator], Array]
# Of the largest displacement from the mean of all views, at amplitude 1: rad, mm.
_TURN, _SHIFT = 2.5e-4, 0.05
_TWIST = ("rx", "ry", "rz", "tx", "ty", "tz")


def _gravity(plan: Plan, rng: np.random.Generator) -> Array:
    """(V,) component of gravity along a direction of the flange in which it changes."""
    down = np.einsum("vji,j->vi", kinematics.flange(plan.arm, plan.joints)[:, :3, :3], [0.0, 0.0, -1.0])
    axes = np.linalg.svd(down - down.mean(axis=0), full_matrices=False)[2]
    return down @ (axes[:2].T @ rng.standard_normal(2))


def _play(driven: Array, width: float) -> Array:
    """(V,) what is left behind by a clearance."""
    out, at = [], driven[0]
    for x in driven:
        at = min(max(at, x - width), x + width)
        out.append(at)
    return np.array(out)


def bracket_hysteresis(plan: Plan, rng: np.random.Generator) -> Array:
    """A screwed joint slips on friction: what it bends lags behind gravity."""
    g = _gravity(plan, rng)
    return g - _play(g, 0.6 * float(g.std()))


def two_seats(plan: Plan, rng: np.random.Generator) -> Array:
    """A loose screw: the scanner falls onto one seat or the other."""
    g = _gravity(plan, rng)
    return np.sign(g - np.quantile(g, rng.uniform(0.35, 0.65)))


def cubic_droop(plan: Plan, rng: np.random.Generator) -> Array:
    """A rubber mount that hardly yields at first: the cube of the load about its mean."""
    g = _gravity(plan, rng)
    return (g - g.mean()) ** 3


def rebound_stop(plan: Plan, rng: np.random.Generator) -> Array:
    """A plate that rests on a stop: it bends on one side alone."""
    g = _gravity(plan, rng)
    return np.maximum(g - np.quantile(g, 0.6), 0.0)


def cable_pull(plan: Plan, rng: np.random.Generator) -> Array:
    """The cable pulls at the scanner once the wrist has turned beyond its slack."""
    q = plan.joints[:, -1] - np.median(plan.joints[:, -1])
    return np.sign(q) * np.maximum(np.abs(q) - np.quantile(np.abs(q), 0.4), 0.0)


def hose_weight(plan: Plan, rng: np.random.Generator) -> Array:
    """A hose hangs from the scanner, the longer the farther it is out."""
    reach = np.linalg.norm(kinematics.flange(plan.arm, plan.joints)[:, :3, 3], axis=1)
    return reach**2


def travelling_slip(plan: Plan, rng: np.random.Generator) -> Array:
    """A magnetic foot creeps with every move, the more the farther it goes."""
    moved = np.abs(np.diff(plan.joints, axis=0, prepend=plan.joints[:1])).sum(axis=1)
    return np.asarray(np.cumsum(moved**2))


def swinging(plan: Plan, rng: np.random.Generator) -> Array:
    """The scanner still swings when it measures, by the size of the last move, in any phase."""
    moved = np.linalg.norm(np.diff(plan.joints, axis=0, prepend=plan.joints[:1]), axis=1)
    return moved * np.cos(rng.uniform(0, 2 * np.pi, len(moved)))


def fan_cycle(plan: Plan, rng: np.random.Generator) -> Array:
    """The bracket warms and cools as the hall's heating switches, four to six times."""
    at = np.arange(len(plan.joints)) / len(plan.joints)
    return np.asarray(np.sin(2 * np.pi * rng.uniform(4, 6) * at + rng.uniform(0, 2 * np.pi)))


def snapping(plan: Plan, rng: np.random.Generator) -> Array:
    """A sheet of metal that snaps to and fro, at any view."""
    jumps = rng.random(len(plan.joints)) < 0.25
    return np.where(np.cumsum(jumps) % 2, 1.0, -1.0)


COURSES: dict[str, Course] = {
    law.__name__: law
    for law in (
        *(bracket_hysteresis, two_seats, cubic_droop, rebound_stop, cable_pull),
        *(hose_weight, travelling_slip, swinging, fan_cycle, snapping),
    )
}


def course_of(p: Parameters) -> Array:
    """(V,) what a law follows, of a largest distance of 1 from its mean."""
    return np.array([value for name, value in p.items() if name not in _TWIST])


def _draw(course: Course) -> Callable[[float, Plan, np.random.Generator], Parameters]:
    def draw(amplitude: float, plan: Plan, rng: np.random.Generator) -> Parameters:
        turn, shift = (x / np.linalg.norm(x) for x in rng.standard_normal((2, 3)))
        values = course(plan, rng)
        values = values - values.mean()
        values = values / np.abs(values).max()
        twist = amplitude * np.concatenate([_TURN * turn, _SHIFT * shift])
        names = (*_TWIST, *(f"view_{v}" for v in range(len(values))))
        return dict(zip(names, map(float, (*twist, *values)), strict=True))

    return draw


def _act(p: Parameters, moment: Moment, T: Array) -> Array:
    return np.asarray(frames.exp(np.array([p[name] for name in _TWIST]) * p[f"view_{moment.index}"]) @ T)


def register() -> None:
    """Let nature know the laws, so that cells can be simulated with them."""
    LAWS.update({name: Law("mount", _draw(course), _act) for name, course in COURSES.items()})
