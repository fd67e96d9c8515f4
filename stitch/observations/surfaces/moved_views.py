"""Views moved by one step of an iteration after another."""

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.observations.surfaces.gram import Gram
from stitch.statistics.acceleration import anderson_step

# The step (6V,) that was asked for, and the one that was taken, as displacements; None before the first.
LastStep = tuple[Array, Array] | None


def displacement_factors(g: Gram) -> Array:
    """(6,) factors that make a twist about the centre displacements: rotations count at the correspondences' lever."""
    return np.array([max(g.lever, 1e-300)] * 3 + [1.0] * 3)


def take_step(poses: Array, g: Gram, step: Array, last: LastStep) -> tuple[Array, LastStep]:
    """T_reference_scanner (V, 4, 4) after a step (V, 6) about the centre, which makes up for what the last one left."""
    unit = displacement_factors(g)
    asked = (step * unit).ravel()
    taken = asked if last is None else anderson_step(asked, *last)
    to_centre = frames.make(np.eye(3), -g.centre)
    return frames.inverse(to_centre) @ frames.exp(taken.reshape(-1, 6) / unit) @ to_centre @ poses, (asked, taken)


def has_converged(g: Gram, step: Array, share: float) -> bool:
    """True if a step (V, 6) moves the views by less than a share of the robust sigma, rms."""
    return bool(np.sqrt(np.mean(step[:, 3:] ** 2)) < share * g.scale)
