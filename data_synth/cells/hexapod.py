"""A six-legged parallel robot: from leg lengths to the flange, by Newton's method."""

import numpy as np
from numpy.typing import NDArray

from stitch.numerics import frames

Array = NDArray[np.float64]
HOME_HEIGHT = 760.0


def ring(radius: float, half_gap_deg: float, first_deg: float) -> Array:
    """(6, 3) joints in three pairs on a circle in the plane z = 0, mm."""
    pairs = np.radians(np.repeat(first_deg + 120.0 * np.arange(3), 2))
    angles = pairs + np.radians(half_gap_deg) * np.tile([-1.0, 1.0], 3)
    return np.column_stack([radius * np.cos(angles), radius * np.sin(angles), np.zeros(6)])


# Neighbouring joints of base and platform belong to one leg.
BASE = ring(620.0, 48.0, 0.0)
PLATFORM = ring(330.0, 12.0, 0.0)


def lengths(T_base_flange: Array, base: Array = BASE, platform: Array = PLATFORM) -> Array:
    """(6,) leg lengths, mm, between joints (6, 3) of base and platform."""
    ends = platform @ T_base_flange[:3, :3].T + T_base_flange[:3, 3]
    return np.asarray(np.linalg.norm(ends - base, axis=1))


def forward(leg_lengths: Array, guess: Array, base: Array = BASE, platform: Array = PLATFORM) -> Array:
    """T_base_flange (4, 4) of six leg lengths, near a guess."""
    T = np.array(guess, float)
    for _ in range(20):
        miss = leg_lengths - lengths(T, base, platform)
        if np.abs(miss).max() < 1e-10:
            break
        ahead, back = (
            np.array([lengths(T @ frames.exp(sign * d), base, platform) for d in 1e-6 * np.eye(6)]) for sign in (1, -1)
        )
        T = T @ frames.exp(np.linalg.solve((ahead - back).T / 2e-6, miss))
    return T
