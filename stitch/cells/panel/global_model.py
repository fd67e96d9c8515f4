"""The global model of robot and tracker: where each robot stands and where its clamp sits, with covariance.

T_world_base · T_base_flange · T_flange_contact = T_world_contact. The clamp's pads are replaced by three reflectors
that the tracker measures while the robot moves; base and clamp are both unknown.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import chi2

from stitch import frames
from stitch.cells.panel.contact_frame import contact_frame
from stitch.closed_form.axxb import park_martin
from stitch.errors import NoResultError
from stitch.frames import Array

_MINIMUM = 4  # poses: 12 reflectors, 36 readings for 15 unknowns


@dataclass(frozen=True)
class ReflectorReadings:
    """One robot's calibration: M poses, three reflectors each; mm."""

    name: str
    T_base_flange: Array  # (M, 4, 4) from the controller
    reflectors: Array  # (M, 3, 3) world frame; the base's two, then the third
    sigma: Array  # (M, 3) of every coordinate


@dataclass(frozen=True)
class RobotModel:
    """The two unknowns of one robot, and what the fit leaves."""

    name: str
    T_world_base: Array  # (4, 4)
    T_flange_contact: Array  # (4, 4)
    reflectors: Array  # (3, 3) flange frame
    covariance: Array  # (12, 12) of (ξ_base, ξ_contact), T·exp(ξ), rotation (rad) first
    jacobian: Array  # (9M, 15) of the weighted residuals: base twist, then reflectors
    residuals: Array  # (9M,) fitted minus measured, in sigmas
    redundancy: int

    @property
    def chi_square(self) -> float:
        """Sum of the squared residuals in sigmas; its mean is `redundancy` if the model holds."""
        return float(self.residuals @ self.residuals)

    @property
    def p_value(self) -> float:
        """Chance of so large a misfit if robot and tracker are as good as stated."""
        return float(chi2.sf(self.chi_square, self.redundancy))


def initial_guess(readings: ReflectorReadings) -> tuple[Array, Array]:
    """T_world_base, T_flange_contact (4, 4) in closed form: AX = XB over motions from the first pose, then the base.

    Raises:
        NoResultError: too few poses, or motions about one axis only.
    """
    if len(readings.T_base_flange) < _MINIMUM:
        raise NoResultError(f"robot {readings.name}: {len(readings.T_base_flange)} poses; measure at least {_MINIMUM}")
    T_world_contact = contact_frame(readings.reflectors)
    A = frames.inverse(readings.T_base_flange[:1]) @ readings.T_base_flange[1:]
    B = frames.inverse(T_world_contact[:1]) @ T_world_contact[1:]
    try:
        T_flange_contact = park_martin(A, B)
    except NoResultError as error:
        raise NoResultError(f"robot {readings.name}: {error}") from None
    bases = T_world_contact @ frames.inverse(T_flange_contact) @ frames.inverse(readings.T_base_flange)
    offsets = frames.log(frames.inverse(bases[0]) @ bases)
    return bases[0] @ frames.exp(offsets.mean(axis=0)), T_flange_contact


def calibrate_robot(readings: ReflectorReadings) -> RobotModel:
    """Both unknowns at once, each reflector coordinate weighted by the tracker's sigma.

    The three reflectors are unknown points of the flange (9) beside the base (6), so nothing about the clamp need be
    known beforehand; the contact frame follows from them.

    Raises:
        NoResultError: too few poses, or motions about one axis only.
    """
    T_base, _T_contact = initial_guess(readings)
    inside = frames.inverse(T_base @ readings.T_base_flange)
    points = frames.transform(inside, readings.reflectors).mean(axis=0)

    def residuals(x: Array) -> Array:
        moved = T_base @ frames.exp(x[:6]) @ readings.T_base_flange
        fitted = frames.transform(moved, points + x[6:].reshape(3, 3))
        return np.asarray(((fitted - readings.reflectors) / readings.sigma[..., None]).ravel())

    solution = least_squares(residuals, np.zeros(15), jac="3-point", x_scale="jac", xtol=1e-12, ftol=1e-12)
    spread = np.linalg.inv(solution.jac.T @ solution.jac)
    reflectors = points + solution.x[6:].reshape(3, 3)
    to_twists = np.zeros((12, 15))
    to_twists[:6, :6] = np.eye(6)
    to_twists[6:, 6:] = _contact_jacobian(reflectors)
    return RobotModel(
        name=readings.name,
        T_world_base=T_base @ frames.exp(solution.x[:6]),
        T_flange_contact=contact_frame(reflectors),
        reflectors=reflectors,
        covariance=to_twists @ spread @ to_twists.T,
        jacobian=solution.jac,
        residuals=solution.fun,
        redundancy=solution.fun.size - 15,
    )


def _contact_jacobian(points: Array) -> Array:
    """(6, 9): twist of the contact frame per mm of each reflector coordinate, by central differences."""
    step = 1e-3
    T_inverse = frames.inverse(contact_frame(points))
    columns = []
    for k in range(9):
        change = np.zeros(9)
        change[k] = step
        ahead, back = (contact_frame(points + sign * change.reshape(3, 3)) for sign in (1, -1))
        columns.append((frames.log(T_inverse @ ahead) - frames.log(T_inverse @ back)) / (2 * step))
    return np.column_stack(columns)
