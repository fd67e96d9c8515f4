"""How large the errors of a good arm are, and what laws of arms are put together from.

Sizes are about 0.15 mrad or 0.05 mm rms. Errors are of the joints (V, n) in rad, or of the flange in its own frame
(V, 6) in rad and mm.
"""

import numpy as np
from numpy.typing import NDArray

from data_synth.moment import Plan

Array = NDArray[np.float64]
SIZE, SHIFT = 1.5e-4, 0.05


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


def standard(course: Array) -> Array:
    """About its mean, of rms 1; 0 where it does not change."""
    return np.asarray((course - course.mean()) / max(float(course.std()), 1e-12))
