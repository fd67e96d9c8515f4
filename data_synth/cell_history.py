"""A cell over weeks, at the level of what its runs find: a thermal cycle, noise, a knocked mount, a joint that wears.

What a run finds of a parameter is the truth at that hour, an error that all runs share (same arm, same poses), and one
of its own. The mount's motion is a turn and a shift about the middle of the part.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

HAND_EYE = ("rx", "ry", "rz", "x", "y", "z")
JOINTS = 6
COMPLIANCE = 1.2e-6  # rad/(N m)
# Stated sigmas: of the mount's turn (rad) and shift (mm), and of a compliance as a share of it.
_TURN, _SHIFT, _SHARE = 2.5e-5, 0.02, 0.02
# Share of a stated sigma that is a session's own: 0.8² + 0.6² = 1.
_OWN, _COMMON = 0.8, 0.6
_T_MOUNT = (Rotation.from_euler("xyz", [160, 10, 35], degrees=True).as_matrix(), np.array([1450.0, -220.0, 900.0]))
_MIDDLE = np.array([15.0, -10.0, 420.0])  # of the part, scanner frame


@dataclass(frozen=True)
class CellPlan:
    """What happens in the cell."""

    days: int = 30
    per_day: int = 20
    knock_day: float | None = 17.0
    knock: tuple[float, ...] = (0.0, 1.5e-4, 5e-5, 0.10, -0.04, 0.02)  # rad, mm; axes of the mount frame
    growth: float = 0.01  # of the second joint's compliance, per day
    growth_day: float = 0.0
    thermal: float = 1.0  # swing of the parameters with the day, in stated sigmas
    lag_hours: float = 2.0  # in which structures take up all but 1/e of a change of the air


@dataclass(frozen=True)
class CellHistory:
    """n sessions, P parameters: those of the hand-eye, then the compliances of the joints."""

    time: Array  # (n,) s since 1970
    air_temperature_c: Array  # (n,)
    truth: Array  # (n, P)
    common: Array  # (P,) error that all sessions share
    found: Array  # (n, P)
    sigma: Array  # (P,) as stated
    T_mount: Array  # (n, 4, 4) as found
    covariance: Array  # (6, 6) of the right perturbation, scanner frame
    middle_scanner: Array = field(default_factory=lambda: _MIDDLE.copy())  # (3,)


def cell_history(seed: int, plan: CellPlan | None = None, hall: int | None = None) -> CellHistory:
    """A simulated cell.

    Args:
        hall: cells of one hall are measured at the same hours in the same air; None: a hall of its own.
    """
    plan = plan or CellPlan()
    rng = np.random.default_rng(seed)
    own, n = rng, plan.days * plan.per_day
    if hall is not None:
        rng = np.random.default_rng([hall, 1])
    day = (np.arange(n) + rng.uniform(0.2, 0.8, n)) / plan.per_day
    sigma = np.concatenate([[_TURN] * 3, [_SHIFT] * 3, [_SHARE * COMPLIANCE] * JOINTS])
    air, behind = _hall(day, plan, rng)
    shown = air + 0.1 * rng.normal(size=n)
    rng = own
    truth = np.outer((behind - 22) / 4, rng.uniform(-1, 1, len(sigma)) * plan.thermal * sigma)
    if plan.knock_day is not None:
        truth[day >= plan.knock_day, :6] += np.array(plan.knock)
    worn = (1 + plan.growth) ** np.maximum(day - plan.growth_day, 0.0)
    truth[:, 6:] += COMPLIANCE
    truth[:, 7] += COMPLIANCE * (worn - 1)
    common = _COMMON * sigma * rng.normal(size=len(sigma))
    found = truth + common + _OWN * sigma * rng.normal(size=(n, len(sigma)))
    return CellHistory(
        time=1.79e9 + day * 86400.0,
        air_temperature_c=shown,
        truth=truth,
        common=common,
        found=found,
        sigma=sigma,
        T_mount=_placed(found[:, :6]),
        covariance=_in_scanner_frame(sigma[:6] ** 2),
    )


def _hall(day: Array, plan: CellPlan, rng: np.random.Generator) -> tuple[Array, Array]:
    """(n,) temperature of the air at some times, and of structures that take it up by Newton's law of cooling."""
    step = 0.25 / 24
    grid = np.arange(-2.0, plan.days + 1.0, step)
    # Weather wanders by 1 °C in a day and is gone after a few.
    weather, fade = rng.normal(size=len(grid)) * np.sqrt(step), np.exp(-step / 2)
    for k in range(1, len(grid)):
        weather[k] += fade * weather[k - 1]
    air = 22 + 4 * np.sin(2 * np.pi * grid) * (1 + 0.2 * np.sin(grid / 3.1)) + weather
    behind, share = air.copy(), -np.expm1(-24 * step / plan.lag_hours)
    for k in range(1, len(grid)):
        behind[k] = behind[k - 1] + share * (air[k] - behind[k - 1])
    return np.interp(day, grid, air), np.interp(day, grid, behind)


def _placed(moved: Array) -> Array:
    """(n, 4, 4) the mount after motions (n, 6) about the middle of the part."""
    R0, t0 = _T_MOUNT
    middle = R0 @ _MIDDLE + t0
    turned = Rotation.from_rotvec(moved[:, :3]).as_matrix()
    T = np.tile(np.eye(4), (len(moved), 1, 1))
    T[:, :3, :3] = turned @ R0
    T[:, :3, 3] = middle + moved[:, 3:] + turned @ (t0 - middle)
    return T


def _in_scanner_frame(square: Array) -> Array:
    """(6, 6) of a right perturbation, from variances (6,) of turn and shift about the middle."""
    R0, _ = _T_MOUNT
    turn = R0.T @ np.diag(square[:3]) @ R0
    shift = R0.T @ np.diag(square[3:]) @ R0
    # The scanner's origin moves by the shift, and by the turn about the middle.
    x, y, z = _MIDDLE
    lever = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.block([[turn, turn @ lever.T], [lever @ turn, shift + lever @ turn @ lever.T]])
