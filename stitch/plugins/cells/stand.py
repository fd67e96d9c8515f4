"""The stand, what was read on it, a check of the readings, and two solutions: least squares and the source's.

Stand frame S: origin at slide zero, x along the rail away from P1, z the pivot axis of the rod, y = z × x.
At angle 0 the rod lies on the rail and points back to P1, towards −x.

The check compares distances that two instruments give independently: where they differ, one of them is wrong. The
distance between two settings of the rod follows from slide, angle and length alone, whatever the bases are; the second
robot measures the same distance by its joints. So the comparison needs no fit and names its pair of points.

The source projects the polyhedron of points and origins onto X-Y, X-Z and Y-Z (formulas 5 to 11). It solves the X-Y
plane by the cosine rule, which is here letter for letter but for two misprints: |O2R2| is printed with the coordinates
of R1, and |O1e| with |O1P1| where its triangle has the side |O1P2|. Both pairs are equal in the source's experiments.
The source's γ counts clockwise; `project` returns right-handed angles, so its γ is −γz.

For X-Z and Y-Z the source says "likewise"; there its rules are 0/0 in its own experiments, where P1 and P2 fall on one
point of the X-Z plane. So these planes are taken from the vectors R1R2 that rod and second robot give, which is the
same triangle; an angle whose R1R2 falls on a point of its plane is taken as level.
"""

from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from stitch.errors import NoResultError
from stitch.numerics import frames
from stitch.numerics.distributions import chi2_tail
from stitch.numerics.frames import Array
from stitch.session.robot import elementary

_TOLERANCES = {"xtol": 1e-10, "ftol": 1e-10, "gtol": 1e-10}
# The formulas hold for the source's arrangement only, and elsewhere give any number without a sign of it. So the
# solution must carry R1 and R2 onto the rod's cup within this share of the rod's length: far above all noise.
_GAP = 0.05
# R1R2 shorter in a plane than this share of its length gives no angle there.
_SHORT = 0.05
_ARRANGEMENT = "check the rod and joint readings, and that the stand is placed as the source places it"


@dataclass(frozen=True)
class TouchedPoints:
    """Points that one robot touched, in its own base frame, with their covariance."""

    names: tuple[str, ...]
    points: Array  # (N, 3), length unit
    covariance: Array  # (N, 3, 3)
    rpy: Array | None = None  # (N, 3) α, β, γ of the flange, R = Rz(γ) Ry(β) Rx(α), where joint angles gave the points


@dataclass(frozen=True)
class Stand:
    """Everything that was read. Lengths in length_unit, angles in rad.

    `rail` holds the points of the main robot, listed along the rail from P1 on; `rail_slide` the slide reading of the
    cup touched there, NaN where none was read. `rod` holds the points of the second robot, one per rod setting.
    """

    length_unit: str
    rail: TouchedPoints
    rail_slide: Array  # (N,)
    rod: TouchedPoints
    slide: Array  # (M,) position of the pivot along the rail
    angle: Array  # (M,) from the rail
    length: Array  # (M,) pivot to cup
    turn: float  # +1: the angle grows clockwise seen from above, −1: anticlockwise
    sigma_slide: float
    sigma_angle: float
    sigma_length: float
    sigma_level_stand: float  # how well the rod's swing is horizontal across the rail
    sigma_level_base: float | None  # how well the two bases are parallel in tilt; None: not known
    file: Path | None = None  # that was read

    @property
    def cups(self) -> Array:
        """(M, 3) rod cup in the stand frame, as it was read."""
        return rod_points(self.slide, self.angle, self.length, self.turn)


def cylinder_points(joint1: Array | float, radius: Array | float, height: Array | float) -> Array:
    """Return points (..., 3) that a robot reaches by joint 1 (right-handed about z), `radius` and `height`."""
    return np.stack([radius * np.cos(joint1), radius * np.sin(joint1), height], axis=-1)


def cylinder_covariance(joint1: float, radius: float, sigma: tuple[float, float, float]) -> Array:
    """Return the covariance (3, 3) of one of `cylinder_points` from the sigmas of joint 1 (rad), radius and height."""
    c = np.cos(joint1)
    s = np.sin(joint1)
    jacobian = np.array([[-radius * s, c, 0.0], [radius * c, s, 0.0], [0.0, 0.0, 1.0]])
    return jacobian @ np.diag(np.square(sigma)) @ jacobian.T


@dataclass(frozen=True)
class DhArm:
    """A chain of turning and sliding joints by DH rows; lengths in length unit, angles in rad."""

    a: Array  # (n,)
    alpha: Array
    d: Array
    theta: Array
    slides: NDArray[np.bool_]  # joints that slide along z instead of turning about it
    modified: bool = False  # Craig's rows; else those of Denavit and Hartenberg
    tip: Array = field(default_factory=lambda: np.zeros(3))  # in the flange frame

    def flange(self, joints: Array) -> Array:
        """Return T_base_flange (..., 4, 4) at joints (..., n)."""
        T = np.eye(4)
        for i, q in enumerate(np.moveaxis(joints, -1, 0)):
            turn, shift = (0.0, q) if self.slides[i] else (q, 0.0)
            joint = elementary("z", self.theta[i] + turn, self.d[i] + shift)
            link = elementary("x", self.alpha[i], self.a[i])
            T = T @ (link @ joint if self.modified else joint @ link)
        return T

    def touched(self, joints: Array, sigma: Array) -> tuple[Array, Array, Array]:
        """Return tips (N, 3), their covariance (N, 3, 3) by joints' sigmas (n,), and the flange's α, β, γ (N, 3)."""
        steps = 1e-5 * np.eye(len(sigma))
        ahead, back = (self._tips(joints[:, None] + sign * steps) for sign in (1, -1))
        slopes = (ahead - back) / 2e-5 * sigma[:, None]
        angles = Rotation.from_matrix(self.flange(joints)[:, :3, :3]).as_euler("ZYX")[:, ::-1]
        return self._tips(joints), np.einsum("nki,nkj->nij", slopes, slopes), angles

    def _tips(self, joints: Array) -> Array:
        T = self.flange(joints)
        return T[..., :3, 3] + T[..., :3, :3] @ self.tip


def rod_points(slide: Array, angle: Array, length: Array, turn: float) -> Array:
    """Return the rod's cup (M, 3) in the stand frame (formulas 5 and 6 of the source, with the slide added)."""
    across = turn * length * np.sin(angle)
    return np.stack([slide - length * np.cos(angle), across, np.zeros_like(slide)], axis=-1)


def level_stand(rail: Array, rail_slide: Array) -> Array:
    """Return T_base1_stand (4, 4) from points (N, 3) on the rail, with the rod's swing horizontal across the rail.

    The source's choice: the line R–S of its figure 6 is perpendicular to the vertical plane through the rail.
    """
    x = rail_direction(rail)
    y = np.cross([0.0, 0.0, 1.0], x)
    y /= np.linalg.norm(y)
    known = np.isfinite(rail_slide)
    origin = np.mean(rail[known] - rail_slide[known, None] * x, axis=0)
    return frames.make(np.stack([x, y, np.cross(x, y)], axis=-1), origin)


def rail_direction(rail: Array) -> Array:
    """Return the unit direction (3,) of growing slide, in which the points (N, 3) are listed."""
    line = np.linalg.svd(rail - rail.mean(axis=0), full_matrices=False)[2][0]
    return line * np.sign(line @ (rail[-1] - rail[0]))


@dataclass(frozen=True)
class DistanceComparison:
    """One distance, by the stand and by a robot's joints."""

    pair: tuple[str, str]
    by_stand: float
    by_robot: float
    sigma: float  # of the difference

    @property
    def difference(self) -> float:
        """By robot minus by stand."""
        return self.by_robot - self.by_stand

    @property
    def sigmas(self) -> float:
        """|difference| over its sigma."""
        return abs(self.difference) / self.sigma


def compare_distances(stand: Stand) -> tuple[DistanceComparison, ...]:
    """Compare every pair of rod settings, and of rail points whose slide was read; largest contradiction first."""
    comparisons = [_compare_rod_pair(stand, i, j) for i, j in combinations(range(len(stand.slide)), 2)]
    known = np.flatnonzero(np.isfinite(stand.rail_slide)).tolist()
    for i, j in combinations(known, 2):
        distance = abs(float(stand.rail_slide[j] - stand.rail_slide[i]))
        comparisons.append(_distance_comparison(stand.rail, i, j, distance, 2 * stand.sigma_slide**2))
    return tuple(sorted(comparisons, key=lambda c: -c.sigmas))


def _compare_rod_pair(stand: Stand, i: int, j: int) -> DistanceComparison:
    """Compare one pair. Both slides count as one reading where they are equal: the pivot was not moved."""
    apart = stand.cups[j] - stand.cups[i]
    distance = float(np.linalg.norm(apart))
    unit = apart / max(distance, np.finfo(float).tiny)
    variance = 0.0 if stand.slide[i] == stand.slide[j] else 2 * (unit[0] * stand.sigma_slide) ** 2
    for k in (i, j):
        along = np.array([-np.cos(stand.angle[k]), stand.turn * np.sin(stand.angle[k]), 0.0])
        across = np.array([-along[1], along[0], 0.0])
        variance += (unit @ along * stand.sigma_length) ** 2
        variance += (unit @ across * stand.length[k] * stand.sigma_angle) ** 2
    return _distance_comparison(stand.rod, i, j, distance, variance)


def _distance_comparison(
    touched: TouchedPoints, i: int, j: int, by_stand: float, variance: float
) -> DistanceComparison:
    apart: Array = touched.points[j] - touched.points[i]
    by_robot = float(np.linalg.norm(apart))
    unit = apart / max(by_robot, np.finfo(float).tiny)
    variance += float(unit @ (touched.covariance[i] + touched.covariance[j]) @ unit)
    return DistanceComparison((touched.names[i], touched.names[j]), by_stand, by_robot, float(np.sqrt(variance)))


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
        return chi2_tail(self.chi_square, self.redundancy) if self.redundancy else 1.0

    @property
    def sigma(self) -> Array:
        """(6,) sigmas of rotation (rad) and translation."""
        return np.sqrt(np.diag(self.covariance))


def fit_stand(stand: Stand) -> BaseFit:
    """Fit by maximum likelihood over both base poses and over the true values of all rod readings.

    Raises:
        NoResultError: the readings leave a direction of the second base open.
    """
    start = _initial_poses(stand)
    scales = _unknown_scales(stand)
    steps = np.diag(1e-2 * scales)

    def jacobian_at(x: Array) -> Array:
        """Return central differences, all columns in one evaluation; a step is a hundredth of a typical error."""
        ahead, back = _residuals(stand, start, x + np.stack([steps, -steps]))
        return (ahead - back).T / (2e-2 * scales)

    solution = least_squares(
        lambda x: _residuals(stand, start, x),
        np.zeros(len(scales)),
        jac=jacobian_at,
        x_scale=scales,
        method="trf",
        **_TOLERANCES,
    )
    jacobian = solution.jac * scales
    U, values, Vt = np.linalg.svd(jacobian, full_matrices=False)
    if len(U) < len(Vt) or values[-1] < 1e-7 * values[0]:
        raise NoResultError(
            "turning the second base about the line through its points changes no reading; to fix: touch a third point "
            "off that line, or state level.second_base"
        )
    covariance = (Vt.T / values**2) @ Vt * np.outer(scales, scales)
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
    """Return the level stand, and the second base from its points; bases upright where the points leave that open."""
    T_stand = level_stand(stand.rail.points, stand.rail_slide)
    here = frames.transform(T_stand, stand.cups)
    there = stand.rod.points
    # The upright pair only decides what two points leave open: a thousandth of the points' spread.
    up = 1e-3 * np.linalg.norm(there - there.mean(axis=0)) * np.array([[0.0, 0.0, 1.0]])
    turn = Rotation.align_vectors(
        np.vstack([here - here.mean(axis=0), up]), np.vstack([there - there.mean(axis=0), up])
    )[0]
    R = turn.as_matrix()
    return T_stand, frames.make(R, here.mean(axis=0) - R @ there.mean(axis=0))


def _unknown_scales(stand: Stand) -> Array:
    """Return the typical size of each unknown's error, for conditioning: rad for rotations, length elsewhere."""
    length = max(stand.sigma_length, stand.sigma_slide)
    pose = np.repeat([stand.sigma_angle, length], 3)
    along = np.full(len(stand.rail.points), length)
    rod = np.repeat([stand.sigma_slide, stand.sigma_angle, stand.sigma_length], len(stand.slide))
    return np.concatenate([pose, pose, along, rod])


def _unpack(stand: Stand, start: tuple[Array, Array], x: Array) -> tuple[Array, ...]:
    """Return poses, positions along the rail, and corrections of slide, angle and length; x is (..., n)."""
    N = len(stand.rail.points)
    M = len(stand.slide)
    poses = []
    for T0, step in zip(start, (x[..., :6], x[..., 6:12]), strict=True):
        turn = frames.exp(np.concatenate([step[..., :3], np.zeros_like(step[..., :3])], axis=-1))[..., :3, :3]
        poses.append(frames.make(turn @ T0[:3, :3], T0[:3, 3] + step[..., 3:]))
    along = frames.transform(frames.inverse(start[0]), stand.rail.points)[:, 0] + x[..., 12 : 12 + N]
    return poses[0], poses[1], along, *np.moveaxis(x[..., 12 + N :].reshape(*x.shape[:-1], 3, M), -2, 0)


def _point_misfits(stand: Stand, start: tuple[Array, Array], x: Array) -> tuple[Array, Array]:
    """Return touched minus fitted points, each in the base of the robot that touched them."""
    T_stand, T_base, along, slide, angle, length = _unpack(stand, start, x)
    rail = frames.transform(T_stand, along[..., None] * np.array([1.0, 0.0, 0.0]))
    cup = rod_points(stand.slide + slide, stand.angle + angle, stand.length + length, stand.turn)
    rod = frames.transform(frames.inverse(T_base) @ T_stand, cup)
    return stand.rail.points - rail, stand.rod.points - rod


def _residuals(stand: Stand, start: tuple[Array, Array], x: Array) -> Array:
    """Return everything over its sigma: touched points, rod readings, level of the stand and of the second base."""
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


def _whiten(residuals: Array, covariance: Array) -> Array:
    white = np.linalg.solve(np.linalg.cholesky(covariance), residuals[..., None])
    return white.reshape(*residuals.shape[:-2], -1)


@dataclass(frozen=True)
class Projection:
    """What the three planes give; angles in rad, right-handed; NaN where a plane shows no angle."""

    T_base1_base2: Array  # (4, 4), formula 11
    gamma_beta_alpha: Array  # (3,)
    offsets: Array  # (3, 2): px1, py1; px2, pz1; py2, pz2
    flange_beta_alpha: Array | None  # (2,) from pins that stand upright in their cups; None without flange angles


def project(stand: Stand) -> Projection:
    """Return T_base1_base2 from exactly two points per robot by the source's three projections.

    Raises:
        NoResultError: other than two points per robot, a slide that moved between R1 and R2, or triangles that do
            not close as in the source's arrangement.
    """
    if len(stand.rail.points) != 2 or len(stand.rod.points) != 2 or np.ptp(stand.slide) > 0:
        raise NoResultError("the projection takes two points per robot and one slide; to fix: use the least squares")
    T_stand = level_stand(stand.rail.points, stand.rail_slide)
    pivot, *cups = frames.transform(T_stand, np.vstack([[stand.slide[0], 0.0, 0.0], stand.cups]))
    R_base1 = np.array(cups)
    gamma, p_xy = _cosine_rules(stand, pivot, R_base1)
    turned = stand.rod.points @ _rotation(2, gamma).T
    beta, p_xz = _plane(R_base1, turned, (2, 0), 1)
    turned = stand.rod.points @ (_rotation(2, gamma) @ _rotation(1, beta)).T
    alpha, p_zy = _plane(R_base1, turned, (1, 2), 0)
    rotation = _rotation(2, gamma) @ _rotation(1, beta) @ _rotation(0, alpha)
    offsets = np.array([p_xy, p_xz[::-1], p_zy])
    mean = [(p_xy[0] + p_xz[1]) / 2, (p_xy[1] + p_zy[0]) / 2, (p_xz[0] + p_zy[1]) / 2]
    T = frames.make(rotation, np.array(mean))
    gap = float(np.linalg.norm(frames.transform(T, stand.rod.points) - R_base1, axis=1).max())
    if not gap < _GAP * stand.length.max():
        raise NoResultError(f"the projection misses the rod's cup by {gap:.3g}; to fix: {_ARRANGEMENT}")
    return Projection(T, np.array([gamma, beta, alpha]), offsets, _flange_tilt(stand, gamma))


def _flange_tilt(stand: Stand, gamma: float) -> Array | None:
    """Return β and α (2,) that make both flanges' z axes parallel; None where their angles are not known."""
    if stand.rail.rpy is None or stand.rod.rpy is None:
        return None
    main, second = (
        Rotation.from_euler("ZYX", rpy[:, ::-1]).as_matrix()[:, :, 2].mean(axis=0)
        for rpy in (stand.rail.rpy, stand.rod.rpy)
    )
    # Both upwards; the turn about x alone changes y, then that about y the angle from z to x.
    here, there = (axis * np.sign(axis[2]) for axis in (_rotation(2, -gamma) @ main, second))
    reach = np.hypot(there[1], there[2])
    alpha = np.arctan2(there[1], there[2]) - np.arcsin(np.clip(here[1] / reach, -1, 1))
    turned = _rotation(0, float(alpha)) @ there
    return np.array([np.arctan2(here[0], here[2]) - np.arctan2(turned[0], turned[2]), alpha])


def _cosine_rules(stand: Stand, pivot: Array, R_base1: Array) -> tuple[float, Array]:
    """Return γ and the offsets (2,) in X-Y by formulas 5 to 10 and the cosine rules after them.

    Written for the source's side: seen from above, the rod turns clockwise. Else all is mirrored.

    Args:
        pivot: (3,) of the rod, base 1.
        R_base1: (2, 3) where the rod's cup stood, base 1.
    """
    mirror = np.array([1.0, stand.turn])
    P, R, e, cups = (points[..., :2] * mirror for points in (stand.rail.points, stand.rod.points, pivot, R_base1))
    # Formulas 5 to 10: the rod's length, and its angle against the rail.
    length = np.linalg.norm(cups - e, axis=1)
    theta = _angles_between(P[0] - P[1], cups - e)
    P2e = float(np.linalg.norm(e - P[1]))
    Pr = np.arctan2(P[:, 1], P[:, 0])
    Rr = -np.arctan2(R[:, 1], R[:, 0])
    O1P = np.hypot(P[:, 0], P[:, 1])
    O2R = np.hypot(R[:, 0], R[:, 1])
    P1P2 = _third_side(O1P[0], O1P[1], abs(Pr[0] - Pr[1]))
    R1R2 = _third_side(O2R[0], O2R[1], abs(Rr[0] - Rr[1]))
    C1 = _angle(O1P[0], P1P2, O1P[1])
    C3 = _angle(O2R[0], R1R2, O2R[1])
    C2 = np.pi - (C1 + Pr[0])
    C4 = np.pi - (C3 + Rr[0])
    C7 = np.pi - (C3 + abs(Rr[0] - Rr[1]))
    C5 = _angle(length[0], R1R2, length[1])
    C6 = _angle(R1R2, length[1], length[0])
    gamma_z = C2 + C4 + theta[0] - C5
    O2e = _third_side(O2R[1], length[1], C7 + C6)
    C8 = _angle(O2e, length[1], O2R[1])
    C13 = C1 + abs(Pr[0] - Pr[1])
    O1e = _third_side(P2e, O1P[1], C13)
    C10 = _angle(P2e, O1e, O1P[1])
    sign = np.sign(Pr[1])
    er = sign * (np.pi - (C13 + C10)) + Pr[1]
    C9 = C10 + theta[1] - C8
    O1O2 = _third_side(O2e, O1e, C9)
    C11 = _angle(O1O2, O1e, O2e)
    bearing = sign * (abs(er) - C11)
    gamma = float(np.arctan2(np.sin(-gamma_z), np.cos(-gamma_z))) * stand.turn
    return gamma, O1O2 * np.array([np.cos(bearing), np.sin(bearing)]) * mirror


def _angles_between(a: Array, b: Array) -> Array:
    """Return the angles (N,) of vectors b (N, 2) against a (2,), without sign."""
    return np.abs(np.arctan2(a[0] * b[:, 1] - a[1] * b[:, 0], b @ a))


def _third_side(a: float, b: float, between: float) -> float:
    return float(np.sqrt(a * a + b * b - 2 * a * b * np.cos(between)))


def _angle(a: float, b: float, opposite: float) -> float:
    """Return the angle between the sides a and b of a triangle."""
    cosine = (a * a + b * b - opposite * opposite) / (2 * a * b) if a * b > 0 else np.nan
    # A triangle that lies flat may miss ±1 by rounding; one that misses more does not close.
    if not abs(cosine) < 1 + 1e-12:
        raise NoResultError(
            f"projection: sides {a:.4f}, {b:.4f} and {opposite:.4f} make no triangle; to fix: {_ARRANGEMENT}"
        )
    return float(np.arccos(np.clip(cosine, -1, 1)))


def _plane(R_base1: Array, R_turned: Array, axes: tuple[int, int], normal: int) -> tuple[float, Array]:
    """Return the angle about the axis `normal` and the two offsets, from the direction of R1R2 in the plane `axes`."""
    d1 = (R_base1[1] - R_base1[0])[list(axes)]
    d2 = (R_turned[1] - R_turned[0])[list(axes)]
    angle = float("nan")
    if np.linalg.norm(d2) > _SHORT * np.linalg.norm(R_turned[1] - R_turned[0]):
        angle = float(np.arctan2(d2[0] * d1[1] - d2[1] * d1[0], d2 @ d1))
    turned = R_turned @ _rotation(normal, angle).T
    return angle, (R_base1 - turned).mean(axis=0)[list(axes)]


def _rotation(axis: int, angle: float) -> Array:
    """Return the turn (3, 3) about an axis; of an angle that a plane does not show, no turn."""
    angle = 0.0 if np.isnan(angle) else angle
    return frames.exp(np.concatenate([angle * np.eye(3)[axis], np.zeros(3)]))[:3, :3]
