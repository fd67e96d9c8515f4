"""The global model of robots, tracker and panel: calibration, the panel's place, pose and shape, and errors to expect.

T_world_base · T_base_flange · T_flange_contact = T_world_contact. The clamp's pads are replaced by three reflectors
that the tracker measures while the robot moves; base and clamp are both unknown, and come with their covariance. Six
(or more) clamps of three pads each touch the panel on its equivalent cylinder. The source prints its formulas as
pictures; these are rebuilt from its text and its figures' captions.

The model's uncertainty makes the slaves err against the master along a motion. For a pure translation d the slave errs
by (δR)·d, so the position error grows with the distance and the direction error does not change; for a pure turn the
relative positions of the flanges enter too (source, eqs. 19-24).

One leg of a six-legged robot may have a hidden offset. The controller turns a flange pose into six leg lengths; a leg
that is δ longer than it believes moves the flange by the twist J⁻¹·e·δ. What of that is the same in all poses hides in
base and clamp; the rest stays in the residuals, where `find_leg_offset` looks for it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from stitch.errors import InputError, NoResultError
from stitch.numerics import frames
from stitch.numerics.distributions import chi2_tail
from stitch.numerics.feature_matching import align_points
from stitch.numerics.frames import Array, Indices
from stitch.numerics.hand_eye import park_martin
from stitch.plugins.cells.job_files import on_a_line

_MINIMUM = 4  # poses: 12 reflectors, 36 readings for 15 unknowns
# Chance of naming an offset that is not there, over all legs of all robots.
_FALSE_ALARM = 1e-3
# A leg whose effect base and clamp swallow to this share cannot be judged.
_SWALLOWED = 1e-6
# Legs in mm: 1e3 or so comes from mm against rad, more is a robot near a singular pose.
_SINGULAR = 1e7
# Of a contact frame's twist (rotation first): the panel is shaped by its z and by turns about x and y; the other axes
# give way to force control, because the panel is stiff in its plane.
SHAPE_AXES = np.array([True, True, False, False, False, True])


def contact_frame(points: Array) -> Array:
    """Return frames (..., 4, 4) in the frame of the points (..., 3, 3): the base's two pads, then the third one.

    Origin in the pads' centroid, x from the base's middle to the third pad, z along (p3 − p1) × (p2 − p1): into the
    panel if the base's pads are listed from −y to +y as the clamp sees it.
    """
    p1, p2, p3 = np.moveaxis(points, -2, 0)
    origin = (p1 + p2 + p3) / 3
    x = _unit(p3 - (p1 + p2) / 2)
    z = _unit(np.cross(p3 - p1, p2 - p1))
    return frames.make(np.stack([x, np.cross(z, x), z], axis=-1), origin)


def _unit(v: Array) -> Array:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def preposition(T_world_base: Array, T_world_panel: Array, T_panel_contact: Array, T_flange_contact: Array) -> Array:
    """Return T_base_flange (N, 4, 4) that brings every clamp to its place on a panel at T_world_panel (4, 4).

    T_Bi_Fi = T_W_Bi⁻¹ · T_W_P · T_P_CPi · T_Fi_CPi⁻¹.
    """
    return frames.inverse(T_world_base) @ T_world_panel @ T_panel_contact @ frames.inverse(T_flange_contact)


def follow(T_world_base: Array, T_base_flange: Array, master: int, T_base_flange_master: Array) -> Array:
    """Return all T_base_flange (N, 4, 4) once the master (index) goes to T_base_flange_master (4, 4).

    Clamps keep their relative poses: T_BiS_FiS' = T_BiS_BM · T_BM_FM' · T_FiS_FM⁻¹, where T_FiS_FM follows from the
    poses (N, 4, 4) at which the robots stand now and T_BiS_BM from the global model.
    """
    T_slave_master = frames.inverse(T_world_base) @ T_world_base[master]
    T_world_flange = T_world_base @ T_base_flange
    T_flange_master = frames.inverse(T_world_flange) @ T_world_flange[master]
    moved = T_slave_master @ T_base_flange_master @ frames.inverse(T_flange_master)
    moved[master] = T_base_flange_master
    return moved


def adjust_pose(
    T_world_base: Array, T_base_flange: Array, master: int, T_world_panel: Array, T_world_target: Array
) -> Array:
    """Return all T_base_flange (N, 4, 4) that take the panel from its measured pose to its target pose, both (4, 4).

    The panel rides on the master: T_BM_FM' = T_W_BM⁻¹ · (T_W_target · T_W_P⁻¹) · T_W_BM · T_BM_FM.
    """
    base = T_world_base[master]
    motion = T_world_target @ frames.inverse(T_world_panel)
    T_master = frames.inverse(base) @ motion @ base @ T_base_flange[master]
    return follow(T_world_base, T_base_flange, master, T_master)


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
        return chi2_tail(self.chi_square, self.redundancy)


def _initial_base(readings: ReflectorReadings) -> Array:
    """Return T_world_base (4, 4) in closed form: AX = XB over motions from the first pose, then the base."""
    if len(readings.T_base_flange) < _MINIMUM:
        raise NoResultError(
            f"robot {readings.name}: {len(readings.T_base_flange)} poses; to fix: measure at least {_MINIMUM}"
        )
    T_world_contact = contact_frame(readings.reflectors)
    A = frames.inverse(readings.T_base_flange[:1]) @ readings.T_base_flange[1:]
    B = frames.inverse(T_world_contact[:1]) @ T_world_contact[1:]
    try:
        T_flange_contact = park_martin(A, B)
    except NoResultError as error:
        raise NoResultError(f"robot {readings.name}: {error}") from None
    bases = T_world_contact @ frames.inverse(T_flange_contact) @ frames.inverse(readings.T_base_flange)
    offsets = frames.log(frames.inverse(bases[0]) @ bases)
    return bases[0] @ frames.exp(offsets.mean(axis=0))


def calibrate_robot(readings: ReflectorReadings) -> RobotModel:
    """Fit both unknowns at once, each reflector coordinate weighted by the tracker's sigma.

    The three reflectors are unknown points of the flange (9) beside the base (6), so nothing about the clamp need be
    known beforehand; the contact frame follows from them.

    Raises:
        NoResultError: too few poses, or motions about one axis only.
    """
    T_base = _initial_base(readings)
    inside = frames.inverse(T_base @ readings.T_base_flange)
    points = frames.transform(inside, readings.reflectors).mean(axis=0)

    def residuals(x: Array) -> Array:
        moved = T_base @ frames.exp(x[:6]) @ readings.T_base_flange
        fitted = frames.transform(moved, points + x[6:].reshape(3, 3))
        return ((fitted - readings.reflectors) / readings.sigma[..., None]).ravel()

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
    """Return the twist (6, 9) of the contact frame per mm of each reflector coordinate, by central differences."""
    step = 1e-3
    T_inverse = frames.inverse(contact_frame(points))
    changes = step * np.eye(9).reshape(9, 3, 3)
    ahead, back = (frames.log(T_inverse @ contact_frame(points + sign * changes)) for sign in (1, -1))
    return (ahead - back).T / (2 * step)


@dataclass(frozen=True)
class MotionErrors:
    """Rms, for D distances or angles along each of the three axes of the master's base."""

    steps: Array  # (D,) mm or rad
    position: Array  # (3, D, N) mm, contact frame of each robot against the master's
    angle: Array  # (3, D, N) rad


def errors_along_motion(
    models: Sequence[RobotModel], T_base_flange: Array, master: int, steps: Array, *, turn: bool
) -> MotionErrors:
    """Return the rms change of the relative pose of each slave's contact frame, per axis and step.

    In closed form, to first order (source, eqs. 19-24): with bases at T_world_base·exp(ξ) a contact frame C of its base
    is off by Ad(C⁻¹) ξ, of which a motion changes D = Ad(C'⁻¹) − Ad(C⁻¹). A slave errs by D ξ less the master's D ξ in
    its own frame; what the clamps are off is the same before and after.

    Args:
        T_base_flange: (N, 4, 4) where the robots stand.
        steps: (D,) distances in mm, or angles in rad if `turn`; a turn is about the master's flange.
    """
    T_world_base = np.array([model.T_world_base for model in models])
    T_flange_contact = np.array([model.T_flange_contact for model in models])
    covariance = np.array([model.covariance[:6, :6] for model in models])
    contact = T_world_base @ T_base_flange @ T_flange_contact
    from_master = frames.adjoint(frames.inverse(contact) @ contact[master])
    before = frames.adjoint(frames.inverse(T_base_flange @ T_flange_contact))
    position, angle = np.zeros((2, 3, len(steps), len(models)))
    for axis in range(3):
        for k, step in enumerate(steps):
            motion = frames.exp(step * np.eye(6)[axis if turn else 3 + axis])
            T_master = T_base_flange[master].copy()
            T_master[:3, :3] = motion[:3, :3] @ T_master[:3, :3]
            T_master[:3, 3] += motion[:3, 3]
            moved = follow(T_world_base, T_base_flange, master, T_master)
            D = frames.adjoint(frames.inverse(moved @ T_flange_contact)) - before
            spread = D @ covariance @ D.transpose(0, 2, 1)
            spread = spread + from_master @ spread[master] @ from_master.transpose(0, 2, 1)
            spread[master] = 0
            variance = np.diagonal(spread, axis1=1, axis2=2)
            position[axis, k] = np.sqrt(variance[:, 3:].sum(axis=1))
            angle[axis, k] = np.sqrt(variance[:, :3].sum(axis=1))
    return MotionErrors(steps, position, angle)


def errors_by_master(models: Sequence[RobotModel], T_base_flange: Array, distance: float, angle: float) -> Array:
    """Return the worst rms position error (N, 2), mm, of any slave after a distance (mm) and an angle, per master."""
    motions = ((np.array([distance]), False), (np.array([angle]), True))
    return np.array(
        [
            [errors_along_motion(models, T_base_flange, m, steps, turn=turn).position.max() for steps, turn in motions]
            for m in range(len(models))
        ]
    )


@dataclass(frozen=True)
class LaserTracker:
    """Lengths in mm. The maker's 10 µm + 5 µm/m is taken as one sigma of every coordinate, which is cautious."""

    position: Array  # (3,) in the world frame
    constant: float = 0.010
    per_length: float = 5e-6

    def sigma(self, points: Array) -> Array:
        """Return the sigma of each coordinate of points (..., 3) in the world frame -> (...)."""
        return self.constant + self.per_length * np.linalg.norm(points - self.position, axis=-1)


@dataclass(frozen=True)
class ClampLayout:
    """Lengths in mm. Panel frame: origin in the middle of the outer surface, x along the axis, z outwards."""

    radius: float  # R of the outer surface
    clamp_width: float  # W_c: chord between the two pads at a clamp's base, across the panel
    spacing: float  # D: chord between the facing pads of neighbouring clamps
    clamp_height: float  # H: from a clamp's base to its third pad
    edge: float  # D_E: from the panel's end to the pads next to it
    length: float  # L of the panel along its axis
    columns: int  # clamps side by side; there are two rows


@dataclass(frozen=True)
class Contacts:
    """Clamps row by row, each row from −y to +y."""

    pads: Array  # (N, 3, 3) the base's two, then the third one; panel frame
    T_panel_contact: Array  # (N, 4, 4); z into the panel, x from the base to the third pad
    tilt: float  # θ between a clamp's plane and the axis, rad


def clamp_contacts(layout: ClampLayout) -> Contacts:
    """Return pads and contact frames, symmetric about the panel's middle; the bases lie towards the ends.

    A clamp's chord W_c spans the angle 2·asin(W_c/2R), the free chord D the angle 2·asin(D/2R). The base's pads lie
    lower than the third one by the rise R·(1 − cos(α/2)), so the clamp's plane leans by sin θ = rise/H and covers
    H·cos θ of the axis: x = ∓(L/2 − D_E) and ∓(L/2 − D_E − H·cos θ).

    Raises:
        InputError: the clamps do not fit the panel.
    """
    half_chords = {"clamp_width": layout.clamp_width / 2, "spacing": layout.spacing / 2}
    for name, half in half_chords.items():
        if half >= layout.radius:
            raise InputError(f"layout: {name} is {2 * half:g} mm, wider than the cylinder; to fix: make it smaller")
    width, free = (2 * np.arcsin(half / layout.radius) for half in half_chords.values())
    rise = layout.radius * (1 - np.cos(width / 2))
    if rise >= layout.clamp_height:
        raise InputError(
            f"layout: clamp_height is below the arc's rise of {rise:.3g} mm under it; to fix: make it larger"
        )
    tilt = float(np.arcsin(rise / layout.clamp_height))
    outer = layout.length / 2 - layout.edge
    inner = outer - layout.clamp_height * np.cos(tilt)
    if inner <= 0:
        raise InputError(
            "layout: edge and clamp_height together reach over the panel's middle; to fix: make them smaller"
        )
    angles = (width + free) * (np.arange(layout.columns) - (layout.columns - 1) / 2)
    if np.abs(angles).max() + width / 2 >= np.pi / 2:
        raise InputError("layout: the clamps reach beyond a quarter turn; to fix: take fewer columns or less spacing")
    pads = np.array([_pads(layout.radius, a, width, side * outer, side * inner) for side in (-1, 1) for a in angles])
    return Contacts(pads, contact_frame(pads), tilt)


def _pads(radius: float, angle: float, width: float, x_base: float, x_third: float) -> Array:
    # Seen into the panel, the base's pads run from −y to +y of the contact frame on both rows.
    turn = np.sign(x_base) * width / 2
    at = np.array([angle - turn, angle + turn, angle])
    x = np.array([x_base, x_base, x_third])
    return np.column_stack([x, radius * np.sin(at), radius * (np.cos(at) - 1)])


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
    gain: float  # chi-square with one degree of freedom if there is no offset
    runner_up: int  # the leg that explains the data next best
    runner_up_gain: float
    found: bool  # beyond chance


def leg_lengths(legs: Legs, T_base_flange: Array) -> Array:
    """Return the lengths (M, 6), mm, that a controller sets for flange poses (M, 4, 4)."""
    ends = frames.transform(T_base_flange, legs.platform)
    return np.linalg.norm(ends - legs.base, axis=-1)


def leg_jacobian(legs: Legs, T_base_flange: Array) -> Array:
    """Return (M, 6, 6) the change of leg length per flange twist ξ in T·exp(ξ), rotation first; poses (M, 4, 4).

    From l = |R p + t − b|: ∂l/∂v = Rᵀu and ∂l/∂ω = p × Rᵀu, u the leg's unit direction (Merlet 2006, ch. 2).
    """
    direction = _unit(frames.transform(T_base_flange, legs.platform) - legs.base)
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
    local = _motion_of_points(model.reflectors)
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
        gain=float(drops[best]),
        runner_up=int(second) + 1,
        runner_up_gain=float(drops[second]),
        found=chi2_tail(drops[best], 1) * tests < _FALSE_ALARM,
    )


def _motion_of_points(points: Array) -> Array:
    """Return (N, 3, 6) the motion of points (N, 3) per unit of a twist, rotation first."""
    return np.concatenate([-frames.skew(points), np.tile(np.eye(3), (len(points), 1, 1))], axis=-1)


def true_flanges(legs: Legs, T_base_flange: Array, offsets: Sequence[tuple[int, float]]) -> Array:
    """Return where the flange (M, 4, 4) really is when legs (from 1) are longer than the controller believes, mm.

    Raises:
        NoResultError: the legs cannot hold the flange in a pose.
    """
    twists = _twists_per_leg(legs, T_base_flange)
    xi = sum((twists[..., leg - 1] * size for leg, size in offsets), np.zeros((len(T_base_flange), 6)))
    return T_base_flange @ frames.exp(xi)


def _twists_per_leg(legs: Legs, T_base_flange: Array) -> Array:
    """Return (M, 6, leg) the flange twist per mm of each leg."""
    lengths = leg_jacobian(legs, T_base_flange)
    finite = np.isfinite(lengths).all(axis=(1, 2), keepdims=True)
    condition = np.linalg.cond(np.where(finite, lengths, 0.0))
    loose = np.flatnonzero(~(condition < _SINGULAR))
    if len(loose):
        x, y, z = T_base_flange[loose[0], :3, 3]
        raise NoResultError(
            f"the legs leave the flange loose at {x:.1f} {y:.1f} {z:.1f} mm; to fix: correct that pose, or the "
            "joints in [legs]"
        )
    return np.asarray(np.linalg.inv(lengths), float)


@dataclass(frozen=True)
class RigidFit:
    """T_to_from and the residual of every point."""

    T: Array  # (4, 4)
    covariance: Array  # (6, 6) of the twist ξ in T·exp(ξ), rotation first, about the points' centroid
    residuals: Array  # (N, 3) measured minus fitted, frame `to`


def rigid_fit(nominal: Array, measured: Array, sigma: Array) -> RigidFit:
    """Return the motion that takes nominal points (N, 3) onto measured ones (N, 3), each with its sigma (N,).

    Kabsch/Wahba solution (Horn 1987). All points count alike: a body that is millimetres out of shape would move by
    more than its targets' noise if the targets near the tracker counted for more. The sigmas make the covariance.

    Raises:
        NoResultError: fewer than three points, or all on one line.
    """
    if len(nominal) < 3:
        raise NoResultError(f"{len(nominal)} points fix no pose; to fix: measure at least three that are not on a line")
    if on_a_line(nominal):
        raise NoResultError(
            "all points lie on one line: the turn about it is open; to fix: measure a point off the line"
        )
    T = align_points(nominal, measured)
    arms = nominal - nominal.mean(axis=0)
    gain = np.linalg.pinv(_motion_of_points(arms).reshape(-1, 6)) * np.repeat(sigma, 3)
    return RigidFit(T, gain @ gain.T, measured - frames.transform(T, nominal))


@dataclass(frozen=True)
class ShapeStep:
    """One step for all clamps."""

    T_base_flange: Array  # (N, 4, 4) to drive to
    twists: Array  # (N, 6) of the contact frames, rotation (rad) first; zero in compliant axes
    deviations: Array  # (K, 3) of the control points before the step, actual minus target, panel frame


@dataclass(frozen=True)
class ControlPoints:
    """Where the CAD has the points by which the shape is controlled."""

    nominal: Array  # (K, 3) panel frame
    clamp: Indices  # (K,) index of the clamp next to each point
    T_panel_contact: Array  # (N, 4, 4) nominal contact frames of the clamps


def shape_step(
    measured: Array, control: ControlPoints, T_base_flange: Array, T_flange_contact: Array, axes: Array = SHAPE_AXES
) -> ShapeStep:
    """Move every clamp as its own control points need it.

    Args:
        measured: (K, 3) the control points, panel frame (in its target pose).
        T_base_flange: (N, 4, 4) where the robots stand.
        T_flange_contact: (N, 4, 4) of the global model.
        axes: (6,) the axes of the twist that are driven; the rest stay where they are.

    With one or two points at a clamp only z is driven there: turns about x and y need three points.
    """
    deviations = measured - control.nominal
    twists = np.zeros((len(T_base_flange), 6))
    for i, T in enumerate(control.T_panel_contact):
        beside = control.clamp == i
        if not beside.any():
            continue
        local = frames.transform(frames.inverse(T), measured[beside])
        wanted = -frames.rotate(frames.inverse(T), deviations[beside])
        driven = axes if beside.sum() >= 3 else axes & np.array([False] * 5 + [True])
        design = _motion_of_points(local)
        if not axes[[2, 3, 4]].any():
            # Deviations within the panel's plane are left out where no driven axis can correct them.
            design, wanted = design[:, 2:], wanted[:, 2:]
        rows = design.reshape(-1, 6)[:, driven]
        twists[i, driven] = np.linalg.lstsq(rows, wanted.ravel(), rcond=None)[0]
    T_contact = T_base_flange @ T_flange_contact @ frames.exp(twists)
    return ShapeStep(T_contact @ frames.inverse(T_flange_contact), twists, deviations)


def largest_deviations(deviations: Array, control: ControlPoints) -> Array:
    """Return the largest deviation (N,) across the panel's surface (along a contact frame's z) at each clamp, mm."""
    across = np.einsum("ki,ki->k", deviations, control.T_panel_contact[control.clamp][:, :3, 2])
    clamps = range(len(control.T_panel_contact))
    return np.array([np.abs(across[control.clamp == i]).max(initial=0.0) for i in clamps])
