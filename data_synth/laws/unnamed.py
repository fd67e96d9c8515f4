"""What arms do that no library of effects has: laws for the unknown.

Each is drawn for one arm and returns errors of the joints (V, n) in rad, or of the flange in its own frame (V, 6) in
rad and mm. Sizes are about 0.15 mrad or 0.05 mm rms, what a good arm is off by.
"""

from collections.abc import Callable

import numpy as np

from data_synth.laws.sizes import SIZE, Array, at_joint, direction, of_joint
from data_synth.moment import Plan

_RMS_OF_WAVE, _RMS_OF_SAW = float(np.sqrt(2.0)), float(np.sqrt(12.0))


def coupling(plan: Plan, rng: np.random.Generator) -> Array:
    """Two joints drag each other: sin q_i sin 2q_k, of 0.15 mrad."""
    i, k = rng.choice(plan.useful, 2, replace=False)
    return at_joint(plan, i, SIZE * np.sin(plan.joints[:, i]) * np.sin(2 * plan.joints[:, k]))


def dress_pack(plan: Plan, rng: np.random.Generator) -> Array:
    """Hoses pull one joint the harder, the farther two others are from where the hoses hang free."""
    i, k, m = rng.choice(plan.useful, 3, replace=False)
    off = [plan.joints[:, j] - rng.uniform(*_range(plan, j)) for j in (k, m)]
    return of_joint(plan, i, np.hypot(*off) ** 1.5 * np.sign(np.sin(off[0])))


def spall(plan: Plan, rng: np.random.Generator) -> Array:
    """A damaged tooth: a bump of 10° in the angle of one joint."""
    i = int(rng.choice(plan.useful))
    middle = rng.uniform(*_range(plan, i))
    return at_joint(plan, i, 3 * SIZE * np.exp(-0.5 * ((plan.joints[:, i] - middle) / np.radians(10)) ** 2))


def hysteresis(plan: Plan, rng: np.random.Generator) -> Array:
    """A gear with friction and a spring (Prandtl's play): it follows the last reversals, not the last direction."""
    i = int(rng.choice(plan.useful))
    q, low_high = plan.joints[:, i], 0.25 * float(np.ptp(plan.joints[:, i]))
    state = np.empty_like(q)
    state[0] = q[0]
    for v in range(1, len(q)):
        state[v] = np.clip(state[v - 1], q[v] - low_high, q[v] + low_high)
    return of_joint(plan, i, state - q)


def ripple(plan: Plan, rng: np.random.Generator) -> Array:
    """A wave generator: seven periods a turn of one joint."""
    i, phase = int(rng.choice(plan.useful)), rng.uniform(0, 2 * np.pi)
    return at_joint(plan, i, SIZE * _RMS_OF_WAVE * np.sin(7 * plan.joints[:, i] + phase))


def cogging(plan: Plan, rng: np.random.Generator) -> Array:
    """A belt that creeps and jumps a tooth on: a saw of 12 to 25° along one joint."""
    i, phase = int(rng.choice(plan.useful)), rng.uniform()
    teeth = plan.joints[:, i] / np.radians(rng.uniform(12, 25)) + phase
    return at_joint(plan, i, SIZE * _RMS_OF_SAW * (teeth - np.floor(teeth) - 0.5))


def stiffening(plan: Plan, rng: np.random.Generator) -> Array:
    """What a spring that stiffens yields beside one that does not: of the cube of a joint's torque no line's part."""
    borne = [i for i in plan.useful if np.ptp(plan.torque[:, i]) > 0]
    i = int(rng.choice(borne))
    torque = plan.torque[:, i] / np.abs(plan.torque[:, i]).max()
    line = np.polynomial.Polynomial.fit(torque, torque**3, 1)
    return of_joint(plan, i, torque**3 - line(torque))


def thermal_cycle(plan: Plan, rng: np.random.Generator, time: Array | None = None) -> Array:
    """A cabinet that cools in turns: the flange swings to and fro every four to nine views.

    Args:
        time: (V,) of the views, in usual steps from one to the next; their numbers where it is not given.
    """
    steps = np.arange(len(plan.joints)) if time is None else time
    swing = np.sin(2 * np.pi * steps / rng.uniform(4, 9) + rng.uniform(0, 2 * np.pi))
    return _RMS_OF_WAVE * swing[:, None] * direction(rng)


def gust(plan: Plan, rng: np.random.Generator, time: Array | None = None) -> Array:
    """For a stretch of views the arm stands in a draught, and comes back; `time` as above."""
    steps = np.arange(len(plan.joints)) if time is None else time
    whole = float(np.ptp(steps)) + 1.0
    middle, width = rng.uniform(0.25, 0.75) * whole, rng.uniform(0.08, 0.16) * whole
    return 2 * np.exp(-0.5 * ((steps - middle) / width) ** 2)[:, None] * direction(rng)


UNNAMED: dict[str, Callable[..., Array]] = {
    law.__name__: law
    for law in (coupling, dress_pack, spall, hysteresis, ripple, cogging, stiffening, thermal_cycle, gust)
}
IN_TIME = ("thermal_cycle", "gust")  # the others follow the joints


def _range(plan: Plan, joint: int) -> tuple[float, float]:
    q = plan.joints[:, joint]
    return float(q.min()), float(q.max())
