"""What was measured, as models and effects see it: everything that a model needs to place the points.

    x_ref = part⁻¹( robot(q*) · mount* · sensor⁻¹(x) )

`T_reference_mount` of a capture holds what stands left of the hand-eye, `T_behind_mount` what stands right of it, and
the points are those that sensor and part would have shown without effects. Effects may know of the views: of all of
them at once (`Views`), or of one with its points (`ScanView`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices
from stitch.session.axes import Axes
from stitch.session.axis_poses import axes_of
from stitch.session.capture import Capture
from stitch.session.robot import Robot
from stitch.session.scanners import Scanners, scanners_of
from stitch.session.session import Mount, SensorKind, SessionData
from stitch.session.torques import Torques, no_torques, torque_columns, torques_of_views
from stitch.system.values import take_rows

TURNED = 0.02  # rad by which gravity turns at the least: of what holds still it is a part of the hand-eye
# Columns of temperatures of which each may bend an arm, by their number in a model.
TEMPERATURES = (
    "robot_temperature_c",
    "ambient_c",
    "ambient_temperature_c",
    "scanner_temperature_c",
    "part_temperature_c",
)
# Beyond 84° of incidence 1/cos α is noise of the normal; such points are not used anyway.
MIN_COSINE = 0.1
# Share of the points' own spread within which points on the flange stand still in it, if sensor and base are one frame.
_SAME_FRAME = 0.05
# Cosine of the angle from the axis beyond which no lens shows anything that measures, 75°.
_WIDEST = 0.26
# Points of a view that say where a sensor looks.
_ENOUGH = 1000
# Fields of `Views` with a row a view.
_OF_VIEWS = ("time", "joints", "previous", "approach", "velocity", "covariates", "number", "T_base_flange")


@dataclass(frozen=True)
class Views:
    """All V views of a session, in the order of time; rad, s, length_unit."""

    count: int
    time: Array  # (V,) since the first view; NaN where the session has no time
    joints: Array  # (V, n); n = 0 without joints or robot
    previous: Array  # (V, n) joints of the row before, its own for the first
    approach: Array  # (V, n) −1, 0, +1
    velocity: Array | None  # (V, n) from columns jN_velocity_deg_s
    torques: Torques
    covariates: dict[str, Array]  # (V,) each, without gaps
    standoff: float
    first: dict[str, float]  # the covariates at the session's first view
    number: Indices  # (V,) of the view in its session, from 0
    path: Array  # (W, n) joints of all views of the session, by their number
    T_base_flange: Array  # (V, 4, 4) reported
    gravity: Array  # (3,) unit vector, base frame; (V, 3) where an axis turns what is left of the robot; zero: unknown
    eye_to_hand: bool
    names: tuple[str, ...] = ()  # of the session's views
    T_mount: Array = field(default_factory=lambda: np.eye(4))  # (4, 4) hand-eye, coarse
    axes: Axes = field(default_factory=Axes)
    scanners: Scanners = field(default_factory=Scanners)
    own_first: tuple[dict[str, float], ...] = ()  # the covariates at the first view of each scanner

    @cached_property
    def by_scanner(self) -> tuple["Views", ...]:
        """Return all views as the effects of each scanner know them: its hand-eye, standoff and first view."""
        every = zip(self.scanners.T_first, self.scanners.standoff, self.own_first, strict=True)
        return tuple(
            replace(self, T_mount=self.T_mount @ T, standoff=standoff or self.standoff, first=first)
            for T, standoff, first in every
        )

    @cached_property
    def gravity_at_mount(self) -> Array:
        """Return (V, 3) unit vectors in the mount frame: the flange where it carries the scanner, else the base."""
        return self._gravity_in_base if self.eye_to_hand else self._gravity_in_flange

    @cached_property
    def gravity_at_part(self) -> Array:
        """Return (V, 3) unit vectors in the reference frame: the flange where it carries the part, else the base."""
        return self._gravity_in_flange if self.eye_to_hand else self._gravity_in_base

    @property
    def _gravity_in_flange(self) -> Array:
        down = self.gravity[None] if self.gravity.ndim == 1 else self.gravity[:, None]
        return frames.rotate(frames.inverse(self.T_base_flange), down)[:, 0]

    @property
    def _gravity_in_base(self) -> Array:
        return np.tile(self.gravity, (self.count, 1)) if self.gravity.ndim == 1 else self.gravity

    def at_scanner(self, twists: Array) -> Array:
        """Return (V, 6) twists of the mount frame about its origin, as an effect of the mount returns them."""
        return twists @ frames.adjoint(frames.inverse(self.T_mount)).T

    def sag(self, c: Array) -> Array:
        """Return (V, n) joint angles of the compliances c (m,) under the gravity torques."""
        sag = np.zeros_like(self.joints)
        for k, joint in enumerate(self.torques.joint):
            sag[:, joint] += c[k] * self.torques.values[:, k]
        return sag

    def tilt(self, c: Array) -> Array:
        """Return (V, 6) twists of the base that yields by c (k,) under the moments of arm and load."""
        twists = np.zeros((self.count, 6))
        for k, axis in enumerate(self.torques.base_axis):
            twists[:, axis] += c[k] * self.torques.base[:, k]
        return twists

    def since_first(self, covariate: str) -> Array:
        """Return (V,) a covariate less its value at the first view."""
        return self.covariates[covariate] - self.first[covariate]

    def behind(self, joint: int, play: float) -> Array:
        """Return (V,) rad by which what a joint drives stays behind it where friction holds it within ± `play`.

        It follows the last reversals and not only the last direction: the play operator (Krejčí 1996, "Hysteresis,
        Convexity and Dissipation in Hyperbolic Equations", ch. II), at rest in the first view of the session.
        """
        states = np.append(np.nan, self.path[:, joint])  # before the first view, and after each
        for v, at in enumerate(self.path[1:, joint], start=2):
            states[v] = min(max(states[v - 1], at - play), at + play)
        q = self.joints[:, joint]
        before = states[self.number]
        return np.where(self.number > 0, np.clip(before, q - play, q + play) - q, 0.0)

    @property
    def hours(self) -> Array:
        """Return (V,) since the first view."""
        return self.time / 3600.0

    @property
    def temperatures(self) -> tuple[int, ...]:
        """Return the numbers of those of `TEMPERATURES` that were measured and change."""
        measured = [i for i, name in enumerate(TEMPERATURES) if name in self.covariates]
        return tuple(i for i in measured if np.ptp(self.covariates[TEMPERATURES[i]]) > 0)

    def only(self, keep: Sequence[int]) -> "Views":
        """Return some of the views; their numbers, rows before them and first values stay those of the session."""
        return replace(
            take_rows(self, keep, *_OF_VIEWS, *(["gravity"] if self.gravity.ndim > 1 else [])),
            count=len(keep),
            torques=self.torques.only(keep),
            axes=self.axes.only(keep) if self.axes else self.axes,
            scanners=self.scanners.only(keep),
        )

    def has(self, need: str) -> bool:
        """Return True if joints, time, torque, velocity or a covariate is known for every view, or if gravity turns."""
        known = {
            "joints": self.joints.shape[1] > 0,
            "torque": len(self.torques.names) > 0,
            "moment": len(self.torques.base_names) > 0,
            "temperature": len(self.temperatures) > 0,
            "velocity": self.velocity is not None,
            "axis": bool(self.axes),
            "scanners": bool(self.scanners),
            "rotary_axis": bool(self.axes.rotary.any()),
            "linear_axis": bool((~self.axes.rotary).any()),
            "time": bool(np.isfinite(self.time).all()) and self.count > 1 and float(np.ptp(self.time)) > 0,
            "gravity_at_mount": float(np.ptp(self.gravity_at_mount, axis=0).max()) > TURNED,
            "gravity_at_part": float(np.ptp(self.gravity_at_part, axis=0).max()) > TURNED,
        }
        return bool(known.get(need, need in self.covariates))


@dataclass(frozen=True)
class ScanView:
    """One view for the functions of points: N of them in the scanner frame, or the reference frame for `shape`."""

    index: int
    views: Views
    cosine: Array  # (N,) of incidence, 0 … 1
    intensity: Array | None  # (N,) standardised over the session
    size: float  # of the part: lengths of shape effects may be counted in it
    origin: Array = field(default_factory=lambda: np.zeros(3))  # (3,) about which the part grows, reference frame
    eye: Array = field(default_factory=lambda: np.zeros(3))  # (3,) from where the scanner looks, its own frame

    def along(self, points: Array) -> Array:
        """Return (N, 3) unit rays from the scanner's eye to points."""
        away = self.away(points)
        return away / np.sqrt(np.einsum("ij,ij->i", away, away))[:, None]

    def away(self, points: Array) -> Array:
        """Return (N, 3) from the scanner's eye to the points."""
        return points - self.eye

    def rho2(self, points: Array) -> Array:
        """Return (N,) ρ² = a² + b² of (a, b) = (x/z, y/z)."""
        x, y, z = self.away(points).T
        return (x**2 + y**2) / z**2

    def since_first(self, covariate: str) -> float:
        """Return a covariate of this view less its value at the first one."""
        return float(self.views.since_first(covariate)[self.index])

    @property
    def gravity(self) -> Array:
        """(3,) unit vector in the reference frame."""
        return self.views.gravity_at_part[self.index]

    @property
    def hours(self) -> float:
        """Since the first view."""
        return float(self.views.hours[self.index])


@dataclass(frozen=True)
class Measurement:
    """What was measured: everything that a model needs to place the points."""

    capture: Capture  # without any effect
    T_base_flange: Array  # (V, 4, 4) reported
    eye_to_hand: bool
    robot: Robot | None
    views: Views
    scan_views: tuple[ScanView, ...]
    length_unit: str
    target_views: tuple[ScanView, ...] = ()  # the same as `scan_views` for labelled points
    sensor: SensorKind | None = None  # as the session states it, or as its points show

    @property
    def mount(self) -> Mount:
        """eye_to_hand | eye_in_hand"""
        return "eye_to_hand" if self.eye_to_hand else "eye_in_hand"

    @property
    def has_intensity(self) -> bool:
        """True if every point has an intensity."""
        return bool(self.scan_views) and all(view.intensity is not None for view in self.scan_views)

    @cached_property
    def has_optics(self) -> bool:
        """True unless the sensor has no lens: a tracker, or the probe that it follows; if it is not stated, one that
        shows points where no lens looks, beside it or behind."""
        if self.sensor is not None:
            return self.sensor not in ("tracker", "probe")
        return all_ahead(self.capture.point_sets)

    @property
    def has_surfaces(self) -> bool:
        """True unless the sensor is known to see no surfaces, at no slant: a camera sees marks."""
        return self.sensor in (None, "area", "line")

    def without(self, left_out: Sequence[int]) -> "Measurement":
        """Return the measurement less some views; numbers, rows before and first values of the others stay."""
        keep = [v for v in range(self.views.count) if v not in set(left_out)]
        views = self.views.only(keep)

        def kept(of: tuple[ScanView, ...]) -> tuple[ScanView, ...]:
            return tuple(replace(of[v], index=i, views=views) for i, v in enumerate(keep)) if of else ()

        return replace(
            self,
            capture=self.capture.without(np.array(sorted(left_out), np.int64)),
            T_base_flange=self.T_base_flange[keep],
            views=views,
            scan_views=kept(self.scan_views),
            target_views=kept(self.target_views),
        )

    def __repr__(self) -> str:
        return f"Measurement({self.capture.name!r}, {self.views.count} views)"


def measurement_of(session: SessionData, capture: Capture) -> Measurement:
    """Return what was measured: a session and its prepared scans."""
    views = views_of(session)
    intensity = _intensities(session)
    size = float(np.median([np.ptp(points, axis=0).max() for points in capture.point_sets])) or 1.0
    scan_views = [
        ScanView(v, views, np.maximum(scan.confidence, MIN_COSINE), intensity[v], size=size, eye=scan.eye)
        for v, scan in enumerate(capture.scans)
    ]
    target_views: list[ScanView] = []
    if capture.sightings is not None:
        # Nobody knows at what slant a target was seen, or how bright: effects of these have nothing to say about it.
        straight = np.ones(capture.sightings.used.shape[1])
        usual = None if intensity[0] is None else np.zeros(len(straight))
        target_views = [ScanView(v, views, straight, usual, size=size) for v in range(views.count)]
    return Measurement(
        capture=capture,
        T_base_flange=views.T_base_flange,
        eye_to_hand=views.eye_to_hand,
        robot=session.robot,
        views=views,
        scan_views=tuple(scan_views),
        length_unit=session.length_unit,
        target_views=tuple(target_views),
        sensor=sensor_kind(session),
    )


def _intensities(session: SessionData) -> list[Array | None]:
    """Return the intensities of each view, standardised over the session: (I − Ī)/σ_I; None without."""
    scale = intensity_scale(session)
    if scale is None:
        return [None] * len(session.views)
    mean, deviation = scale
    return [None if v.cloud is None else (v.cloud.scalars["intensity"] - mean) / deviation for v in session.views]


def intensity_scale(session: SessionData) -> tuple[float, float] | None:
    """Return mean and standard deviation of the intensity over all points in memory.

    None where some points have none, or all the same.
    """
    scalars = [view.cloud.scalars for view in session.views if view.cloud is not None]
    by_view = [of_cloud["intensity"] for of_cloud in scalars if "intensity" in of_cloud]
    if len(by_view) < len(session.views):
        return None
    values = np.concatenate(by_view)
    # One value that is not finite would spoil the mean of all: intensity then counts as absent, in every view.
    if not np.isfinite(values).all() or values.std() <= 0:
        return None
    return float(values.mean()), float(values.std())


def require_rising_times(session: SessionData) -> None:
    """Refuse views whose times fall: a folder's are when it is read, a program may have changed those of a session.

    Raises:
        InputError: times fall from view to view.
    """
    time = np.array([np.nan if view.time_s is None else view.time_s for view in session.views])
    if (falls := np.flatnonzero(time < np.fmax.accumulate(time))).size:
        name = session.views[falls[0]].name
        raise InputError(f"{session.name}: time_s of view {name} falls; to fix: sort the views by time")


def views_of(session: SessionData) -> Views:
    """Collect what effects may know; joints count only where the robot's kinematics are known too."""
    views = session.views
    axes = axes_of(session)
    scanners = scanners_of(session)
    count = len(views)
    has_joints = session.robot is not None and all(view.joints is not None for view in views)
    joints = np.array([view.joints for view in views]) if has_joints else np.zeros((count, 0))
    approach = np.array([view.approach for view in views]) if has_joints else np.zeros((count, 0))
    time = np.array([np.nan if view.time_s is None else view.time_s for view in views])
    # A column with a gap does not count.
    complete = set.intersection(*(set(view.covariates) for view in views))
    covariates = {name: np.array([view.covariates[name] for view in views]) for name in sorted(complete)}
    speeds = [f"j{i + 1}_velocity_deg_s" for i in range(joints.shape[1])]
    velocity = None
    if speeds and all(name in covariates for name in speeds):
        velocity = np.radians(np.column_stack([covariates.pop(name) for name in speeds]))
    torques = no_torques(count)
    if session.robot is not None and has_joints:
        torques = torques_of_views(session.robot, joints, covariates)
    if torques.measured:
        for name in torque_columns(joints.shape[1]):
            del covariates[name]
    return Views(
        count=count,
        time=time - time[0],
        joints=joints,
        previous=np.vstack([joints[:1], joints[:-1]]),
        approach=approach,
        velocity=velocity,
        torques=torques,
        covariates=covariates,
        standoff=session.scanner.standoff or _median_range(session),
        first={name: float(values[0]) for name, values in covariates.items()},
        number=np.arange(count),
        path=joints,
        T_base_flange=np.array([view.T_base_flange for view in views]),
        gravity=_gravity_left_of(axes, session),
        axes=axes,
        eye_to_hand=session.mount == "eye_to_hand",
        names=tuple(session.names),
        scanners=scanners,
        own_first=tuple(
            {name: float(values[of_view][0]) for name, values in covariates.items()}
            for of_view in scanners.masks(count)
        ),
    )


def _gravity_left_of(axes: Axes, session: SessionData) -> Array:
    """Return gravity in the frame left of the effective poses: (3,), or (V, 3) where an axis turns it."""
    if not session.has_poses:
        return np.zeros(3)
    gravity = gravity_of(session.robot)
    turned = frames.rotate(frames.inverse(axes.sides()[0]), gravity[None, None])[:, 0] if axes else gravity[None]
    return gravity if np.allclose(turned, gravity) else turned


def gravity_of(robot: Robot | None) -> Array:
    """Return (3,) unit vector, base frame: as the robot's table states it, else downwards."""
    if robot is None or not np.linalg.norm(robot.gravity) > 0:
        return np.array([0.0, 0.0, -1.0])
    return robot.gravity / np.linalg.norm(robot.gravity)


def _median_range(session: SessionData) -> float:
    points = [view.cloud.points for view in session.views if view.cloud]
    points += [view.sighting.points for view in session.views if view.sighting]
    ranges = [np.median(np.linalg.norm(of_view, axis=1)) for of_view in points]
    return float(np.median(ranges)) if ranges else 1.0


def with_part_origin(measurement: Measurement, T_mount: Array) -> Measurement:
    """Return the measurement with the origin about which a part grows, and the place of the scanner on its mount.

    A coarse hand-eye is enough. On the flange that origin is the flange, which holds the part; in the cell it is the
    middle of what the views show.
    """
    views = replace(measurement.views, T_mount=T_mount)
    origin = np.zeros(3)
    if not measurement.eye_to_hand:
        shown = zip(measurement.capture.poses(T_mount), measurement.capture.visible_points, strict=True)
        origin = np.mean([frames.transform(T, points).mean(axis=0) for T, points in shown if len(points)], axis=0)
    return replace(
        measurement,
        views=views,
        scan_views=tuple(replace(view, views=views, origin=origin) for view in measurement.scan_views),
        target_views=tuple(replace(view, views=views, origin=origin) for view in measurement.target_views),
    )


def sensor_kind(session: SessionData) -> SensorKind | None:
    """Return the kind as stated, or a tracker where its points are given in the robot's base; None if unknown.

    No scanner stands inside the robot. Points on the flange stand still in its frame if the sensor's frame is the base.
    """
    if session.scanner.kind is not None or session.mount != "eye_to_hand":
        return session.scanner.kind
    sighted = [(view.T_base_flange, view.sighting) for view in session.views if view.sighting is not None]
    if not sighted:
        return None
    in_base = [sighting.points for _, sighting in sighted]
    on_flange = [frames.transform(frames.inverse(T), sighting.points) for T, sighting in sighted]
    target = np.unique(np.concatenate([sighting.targets for _, sighting in sighted]), return_inverse=True)[1]
    spread = _variance_within(np.concatenate(in_base), target)
    strays = _variance_within(np.concatenate(on_flange), target)
    return "tracker" if strays < _SAME_FRAME**2 * spread else None


def _variance_within(points: Array, group: Indices) -> float:
    """Return the variance of points (N, 3) about the mean of their group (N,)."""
    count = np.bincount(group)[:, None]
    mean = np.stack([np.bincount(group, x) for x in points.T], axis=1) / count
    return float(np.mean((points - mean[group]) ** 2))


def all_ahead(point_sets: Sequence[Array]) -> bool:
    """Return True if a lens may have seen all points, sensor frame: none beside it or behind."""
    some = [points[:: 1 + len(points) // _ENOUGH] for points in point_sets]
    if not some:
        return True
    shown = np.concatenate(some)
    ahead = shown[:, 2] / np.maximum(np.linalg.norm(shown, axis=1), 1e-300)
    # A stray point in a hundred says nothing.
    least, most = np.quantile(ahead, [0.01, 0.99])
    return bool(least > _WIDEST or most < -_WIDEST)
