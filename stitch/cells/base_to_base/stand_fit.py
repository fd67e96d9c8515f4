"""All readings of the stand as one least-squares problem, every reading with its own sigma."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from stitch import frames
from stitch.cells.base_to_base.stand import Stand, level_stand, rod_points
from stitch.errors import NoResultError
from stitch.frames import Array

_TOLERANCES = {"xtol": 1e-10, "ftol": 1e-10, "gtol": 1e-10}


@dataclass(frozen=True)
class BaseFit:
    """T_base1_base2 with its uncertainty about the axes of base 1."""

    T_base1_base2: Array  # (4, 4)
    T_base1_stand: Array  # (4, 4)
    covariance: Array  # (6, 6): rotation (rad) and translation, T = Trans(t + δ) · Rot(φ) · R
    rail_residuals: Array  # (N, 3) touched minus fitted, base 1
    rod_residuals: Array  # (M, 3) touched minus fitted, base 2
    chi_square: float
    redundancy: int  # readings beyond what the unknowns need

    @property
    def p_value(self) -> float:
        """Chance of so large a misfit if the stated sigmas hold; 1 without redundancy."""
        return float(chi2.sf(self.chi_square, self.redundancy)) if self.redundancy else 1.0

    @property
    def sigma(self) -> Array:
        """(6,) sigmas of rotation (rad) and translation."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def fit_stand(stand: Stand) -> BaseFit:
    """Maximum likelihood over both base poses and over the true values of all rod readings.

    Raises:
        NoResultError: the readings leave a direction of the second base open.
    """
    start = _initial_poses(stand)
    solution = least_squares(
        lambda x: _residuals(stand, start, x),
        np.zeros(_unknown_count(stand)),
        jac=lambda x: _jacobian(stand, start, x),
        x_scale=_unknown_scales(stand),
        method="trf",
        **_TOLERANCES,
    )
    jacobian = solution.jac * _unknown_scales(stand)
    U, values, Vt = np.linalg.svd(jacobian, full_matrices=False)
    if len(U) < len(Vt) or values[-1] < 1e-7 * values[0]:
        raise NoResultError(
            "turning the second base about the line through its points changes no reading; touch a third point "
            "off that line, or state level.second_base"
        )
    covariance = (Vt.T / values**2) @ Vt * np.outer(_unknown_scales(stand), _unknown_scales(stand))
    T_stand, T_base, *_ = _unpack(stand, start, solution.x)
    rail, rod = _point_misfits(stand, start, solution.x)
    return BaseFit(
        T_base,
        T_stand,
        covariance[6:12, 6:12],
        rail_residuals=rail,
        rod_residuals=rod,
        chi_square=float(2 * solution.cost),
        redundancy=len(U) - len(Vt),
    )


def _initial_poses(stand: Stand) -> tuple[Array, Array]:
    """Level stand, and the second base from its points; bases upright where the points leave that open."""
    T_stand = level_stand(stand.rail.points, stand.rail_slide)
    here = frames.transform(T_stand, _corrected_rod_points(stand.slide, stand))
    there = stand.rod.points
    # The upright pair only decides what two points leave open: a thousandth of the points' spread.
    up = 1e-3 * np.linalg.norm(there - there.mean(axis=0)) * np.array([[0.0, 0.0, 1.0]])
    turn = Rotation.align_vectors(
        np.vstack([here - here.mean(axis=0), up]), np.vstack([there - there.mean(axis=0), up])
    )[0]
    R = turn.as_matrix()
    return T_stand, frames.make(R, here.mean(axis=0) - R @ there.mean(axis=0))


def _corrected_rod_points(slide: Array, stand: Stand) -> Array:
    return rod_points(slide, stand.angle, stand.length, stand.turn)


def _unknown_count(stand: Stand) -> int:
    return 12 + len(stand.rail.points) + 3 * len(stand.slide)


def _unknown_scales(stand: Stand) -> Array:
    """Typical size of each unknown's error, for conditioning: rad for rotations, length elsewhere."""
    length = max(stand.sigma_length, stand.sigma_slide)
    pose = np.repeat([stand.sigma_angle, length], 3)
    along = np.full(len(stand.rail.points), length)
    rod = np.repeat([stand.sigma_slide, stand.sigma_angle, stand.sigma_length], len(stand.slide))
    return np.concatenate([pose, pose, along, rod])


def _unpack(stand: Stand, start: tuple[Array, Array], x: Array) -> tuple[Array, ...]:
    """Poses, positions along the rail, and corrections of slide, angle and length; x is (..., n)."""
    N, M = len(stand.rail.points), len(stand.slide)
    poses = []
    for T0, step in zip(start, (x[..., :6], x[..., 6:12]), strict=True):
        turn = frames.exp(np.concatenate([step[..., :3], np.zeros_like(step[..., :3])], axis=-1))[..., :3, :3]
        poses.append(frames.make(turn @ T0[:3, :3], T0[:3, 3] + step[..., 3:]))
    along = frames.transform(frames.inverse(start[0]), stand.rail.points)[:, 0] + x[..., 12 : 12 + N]
    return poses[0], poses[1], along, *np.moveaxis(x[..., 12 + N :].reshape(*x.shape[:-1], 3, M), -2, 0)


def _point_misfits(stand: Stand, start: tuple[Array, Array], x: Array) -> tuple[Array, Array]:
    """Touched minus fitted points, each in the base of the robot that touched them."""
    T_stand, T_base, along, slide, angle, length = _unpack(stand, start, x)
    rail = frames.transform(T_stand, along[..., None] * np.array([1.0, 0.0, 0.0]))
    cup = rod_points(stand.slide + slide, stand.angle + angle, stand.length + length, stand.turn)
    rod = frames.transform(frames.inverse(T_base) @ T_stand, cup)
    return stand.rail.points - rail, stand.rod.points - rod


def _residuals(stand: Stand, start: tuple[Array, Array], x: Array) -> Array:
    """Everything over its sigma: touched points, rod readings, level of the stand and of the second base."""
    T_stand, T_base, along, slide, angle, length = _unpack(stand, start, x)
    rail, rod = _point_misfits(stand, start, x)
    known = np.isfinite(stand.rail_slide)
    rows = [
        _whiten(rail, stand.rail.covariance),
        _whiten(rod, stand.rod.covariance),
        (along[..., known] - stand.rail_slide[known]) / stand.sigma_slide,
        slide / stand.sigma_slide,
        angle / stand.sigma_angle,
        length / stand.sigma_length,
        T_stand[..., 2, 1:2] / stand.sigma_level_stand,
    ]
    if stand.sigma_level_base is not None:
        rows.append(T_base[..., :2, 2] / stand.sigma_level_base)
    return np.concatenate(rows, axis=-1)


def _jacobian(stand: Stand, start: tuple[Array, Array], x: Array) -> Array:
    """Central differences, all columns in one evaluation; a step is a hundredth of a typical error."""
    steps = np.diag(1e-2 * _unknown_scales(stand))
    both = _residuals(stand, start, x + np.stack([steps, -steps]))
    return np.asarray((both[0] - both[1]).T / (2e-2 * _unknown_scales(stand)))


def _whiten(residuals: Array, covariance: Array) -> Array:
    white = np.linalg.solve(np.linalg.cholesky(covariance), residuals[..., None])
    return np.asarray(white.reshape(*residuals.shape[:-2], -1))
