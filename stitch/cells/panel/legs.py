"""A hidden offset of one leg of a six-legged robot, found in the tracker's data.

The controller turns a flange pose into six leg lengths; a leg that is δ longer than it believes moves the flange by
the twist J⁻¹·e·δ. What of that is the same in all poses hides in base and clamp; the rest stays in the residuals.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from stitch import frames
from stitch.cells.panel.global_model import ReflectorReadings, RobotModel
from stitch.errors import NoResultError
from stitch.frames import Array

# Chance of naming an offset that is not there, over all legs of all robots.
_FALSE_ALARM = 1e-3
# A leg whose effect base and clamp swallow to this share cannot be judged.
_SWALLOWED = 1e-6
# Legs in mm: 1e3 or so comes from mm against rad, more is a robot near a singular pose.
_SINGULAR = 1e7


@dataclass(frozen=True)
class Legs:
    """Joints of the six legs, mm."""

    base: Array  # (6, 3) base frame
    platform: Array  # (6, 3) flange frame


@dataclass(frozen=True)
class LegOffset:
    """The offset of one leg that best explains one robot's residuals."""

    robot: str
    leg: int  # from 1
    offset: float  # mm, real length minus the one the controller believes
    sigma: float
    chi_square_drop: float  # chi-square with one degree of freedom if there is no offset
    runner_up: int  # the leg that explains the data next best
    runner_up_drop: float
    detected: bool  # beyond chance


def leg_lengths(legs: Legs, T_base_flange: Array) -> Array:
    """(M, 6) lengths, mm, that a controller sets for flange poses (M, 4, 4)."""
    ends = frames.transform(T_base_flange, legs.platform)
    return np.asarray(np.linalg.norm(ends - legs.base, axis=-1))


def leg_jacobian(legs: Legs, T_base_flange: Array) -> Array:
    """(M, 6, 6): change of leg length per flange twist ξ in T·exp(ξ), rotation first; poses (M, 4, 4).

    From l = |R p + t − b|: ∂l/∂v = Rᵀu and ∂l/∂ω = p × Rᵀu, u the leg's unit direction (Merlet 2006, ch. 2).
    """
    ends = frames.transform(T_base_flange, legs.platform)
    direction = ends - legs.base
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    inside = np.einsum("mji,mkj->mki", T_base_flange[:, :3, :3], direction)
    return np.concatenate([np.cross(legs.platform, inside), inside], axis=-1)


def find_leg_offset(readings: ReflectorReadings, model: RobotModel, legs: Legs, tests: int) -> LegOffset:
    """Score each leg on the residuals left by the fit, with base and clamp free to give way.

    Args:
        tests: legs of all robots together, for the chance of a false alarm.

    Raises:
        NoResultError: the legs cannot hold the flange in a pose.
    """
    twists = _twists_per_leg(legs, readings.T_base_flange)
    R = model.T_world_base[:3, :3] @ readings.T_base_flange[:, :3, :3]
    local = np.concatenate([-frames.skew(model.reflectors), np.tile(np.eye(3), (3, 1, 1))], axis=-1)
    moved = np.einsum("mij,kjc,mcl->mkil", R, local, twists) / readings.sigma[..., None, None]
    columns = moved.reshape(-1, 6)
    Q = np.linalg.qr(model.jacobian)[0]
    free = columns - Q @ (Q.T @ columns)
    power = np.maximum((free**2).sum(axis=0), _SWALLOWED * (columns**2).sum(axis=0))
    offsets = -(free.T @ model.residuals) / power
    drops = offsets**2 * power
    best, second = np.argsort(drops)[::-1][:2]
    return LegOffset(
        robot=model.name,
        leg=int(best) + 1,
        offset=float(offsets[best]),
        sigma=float(1 / np.sqrt(power[best])),
        chi_square_drop=float(drops[best]),
        runner_up=int(second) + 1,
        runner_up_drop=float(drops[second]),
        detected=bool(chi2.sf(drops[best], 1) * tests < _FALSE_ALARM),
    )


def true_flanges(legs: Legs, T_base_flange: Array, offsets: Sequence[tuple[int, float]]) -> Array:
    """Where the flange (M, 4, 4) really is when legs (from 1) are longer than the controller believes, mm.

    Raises:
        NoResultError: the legs cannot hold the flange in a pose.
    """
    twists = _twists_per_leg(legs, T_base_flange)
    xi = sum((twists[..., leg - 1] * size for leg, size in offsets), np.zeros((len(T_base_flange), 6)))
    return np.asarray(T_base_flange @ frames.exp(np.asarray(xi)))


def _twists_per_leg(legs: Legs, T_base_flange: Array) -> Array:
    """(M, 6, leg): flange twist per mm of each leg."""
    lengths = leg_jacobian(legs, T_base_flange)
    broken = np.logical_not(np.asarray(np.isfinite(lengths).all(axis=(1, 2))))
    condition = np.linalg.cond(np.where(broken[:, None, None], 0.0, lengths))
    loose = np.flatnonzero(np.logical_not(condition < _SINGULAR))
    if len(loose):
        x, y, z = T_base_flange[loose[0], :3, 3]
        raise NoResultError(
            f"the legs leave the flange loose at {x:.1f} {y:.1f} {z:.1f} mm; correct that pose, or the joints in [legs]"
        )
    return np.asarray(np.linalg.inv(lengths))
