"""What was measured, as models and effects see it: everything that a model needs to place the points.

    x_ref = part⁻¹( robot(q*) · mount* · sensor⁻¹(x) )

`T_reference_mount` of a capture holds what stands left of the hand-eye, `T_behind_mount` what stands right of it, and
the points are those that sensor and part would have shown without effects. Effects may know of the views: of all of
them at once (`Views`), or of one with its points (`ScanView`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices
from stitch.numerics.least_squares import less_group_means
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
_ROWS_OF_VIEWS = ("time", "joints", "previous", "approach", "velocity", "covariates", "number", "T_base_flange")


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
    number: Indices  # (V,) index of each view in its whole session, of W views, where these are some of them
    path: Array  # (W, n) joints of all views of the session
    T_base_flange: Array  # (V, 4, 4) reported
    gravity: Array  # (3,) unit vector, base frame; (V, 3) where an axis turns what is left of the robot; zero: unknown
    eye_to_hand: bool
    names: tuple[str, ...] = ()  # of the session's views
    T_mount: Array = field(default_factory=partial(np.eye, 4))  # (4, 4) hand-eye, coarse
    axes: Axes = field(default_factory=Axes)
    scanners: Scanners = field(default_factory=Scanners)
    own_first: tuple[dict[str, float], ...] = ()  # the covariates at the first view of each scanner

    @cached_property
    def by_scanner(self) -> tuple["Views", ...]:
        """All V views once for each scanner, with its hand-eye, standoff and first covariates; () for one scanner."""
        every = zip(self.scanners.T_first, self.scanners.standoff, self.own_first, strict=True)
        return tuple(
            replace(self, T_mount=self.T_mount @ T, standoff=standoff or self.standoff, first=first)
            for T, standoff, first in every
        )

    @cached_property
    def gravity_at_mount(self) -> Array:
        """Gravity as unit vectors (V, 3) in the mount frame: the flange where it carries the scanner, else the base."""
        return self._gravity_in_base if self.eye_to_hand else self._gravity_in_flange

    @cached_property
    def gravity_at_part(self) -> Array:
        """Gravity as unit vectors (V, 3) in the reference frame: the flange if it carries the part, else the base."""
        return self._gravity_in_flange if self.eye_to_hand else self._gravity_in_base

    @property
    def _gravity_in_flange(self) -> Array:
        """Gravity as unit vectors (V, 3) in the flange frame."""
        down = self.gravity[None] if self.gravity.ndim == 1 else self.gravity[:, None]
        return frames.rotate(frames.inverse(self.T_base_flange), down)[:, 0]

    @property
    def _gravity_in_base(self) -> Array:
        """Gravity as unit vectors (V, 3) in the base frame, or in that of the part which axes carry."""
        return np.tile(self.gravity, (self.count, 1)) if self.gravity.ndim == 1 else self.gravity

    def at_scanner(self, twists: Array) -> Array:
        """Return twists (V, 6) of the mount frame, about its origin, as twists in the scanner frame: Ad(T_mount⁻¹) ξ.

        Effects of the mount return the latter.
        """
        return twists @ frames.adjoint(frames.inverse(self.T_mount)).T

    def sag(self, c: Array) -> Array:
        """Return the deflections (V, n) of the joints, rad, under the m gravity torques.

        Args:
            c: (m,) compliances, rad/(N m), of the joint that each torque bends.
        """
        sag = np.zeros_like(self.joints)
        for k, joint in enumerate(self.torques.joint):
            sag[:, joint] += c[k] * self.torques.values[:, k]
        return sag

    def tilt(self, c: Array) -> Array:
        """Return twists (V, 6) of the base under the k moments of arm and load: rotations about its x and y.

        Args:
            c: (k,) compliances, rad/(N m).
        """
        twists = np.zeros((self.count, 6))
        for k, axis in enumerate(self.torques.base_axis):
            twists[:, axis] += c[k] * self.torques.base[:, k]
        return twists

    def since_first(self, covariate: str) -> Array:
        """Return a covariate (V,) less its value at the session's first view."""
        return self.covariates[covariate] - self.first[covariate]

    def behind(self, joint: int, play: float) -> Array:
        """Return the lag (V,) rad of a joint with friction and play: angle of its driven side less that of its motor.

        The driven side rests until the joint is `play` away, then follows at that distance: the play operator (Krejčí
        1996, "Hysteresis, Convexity and Dissipation in Hyperbolic Equations", ch. II). So it depends on all reversals,
        not only on the last direction. It has no lag in the first view of the session.

        Args:
            joint: counted from 0.
            play: half width of the dead band, rad.
        """
        # The driven side's angle before the first view, and after each view of the whole session.
        driven = np.append(np.nan, self.path[:, joint])
        for v, angle in enumerate(self.path[1:, joint], start=2):
            driven[v] = min(max(driven[v - 1], angle - play), angle + play)
        q = self.joints[:, joint]
        before = driven[self.number]
        return np.where(self.number > 0, np.clip(before, q - play, q + play) - q, 0.0)

    @property
    def hours(self) -> Array:
        """Return (V,) since the first view."""
        return self.time / 3600.0

    @property
    def temperatures(self) -> tuple[int, ...]:
        """The indices into `TEMPERATURES` of those that were measured in every view and change."""
        measured = [i for i, name in enumerate(TEMPERATURES) if name in self.covariates]
        return tuple(i for i in measured if np.ptp(self.covariates[TEMPERATURES[i]]) > 0)

    def only(self, keep: Sequence[int]) -> "Views":
        """Return the views at the indices `keep`.

        `number`, `previous`, `path` and `first` still refer to the whole session: history does not change with a
        selection.
        """
        return replace(
            take_rows(self, keep, *_ROWS_OF_VIEWS, *(["gravity"] if self.gravity.ndim > 1 else [])),
            count=len(keep),
            torques=self.torques.only(keep),
            axes=self.axes.only(keep) if self.axes else self.axes,
            scanners=self.scanners.only(keep),
        )

    def has(self, need: str) -> bool:
        """Return True if the views know an input that an effect needs: it is given in every view and, partly, changes.

        Args:
            need: a key of `known` below, or the name of a covariate.
        """
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
    """One view as effects of points know it: N points in the scanner frame, or in the reference frame for `shape`."""

    index: int  # of the view among `views`
    views: Views
    cosine: Array  # (N,) of incidence, 0 … 1
    intensity: Array | None  # (N,) standardised over the session
    size: float  # of the part, length_unit: lengths of shape effects may be counted in it
    origin: Array = field(default_factory=partial(np.zeros, 3))  # (3,) about which the part grows, reference frame
    eye: Array = field(default_factory=partial(np.zeros, 3))  # (3,) from where the scanner looks, scanner frame

    def along(self, points: Array) -> Array:
        """Return unit vectors (N, 3) from the scanner's eye to points (N, 3), scanner frame."""
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
        """True unless the sensor has no lens: a tracker, or the probe that it follows.

        Of a sensor that is not stated: True unless it shows points beside or behind itself, where no lens looks.
        """
        if self.sensor is not None:
            return self.sensor not in ("tracker", "probe")
        return all_ahead(self.capture.point_sets)

    def without(self, left_out: Sequence[int]) -> "Measurement":
        """Return the measurement without the views at the indices `left_out`.

        What the others know of the session's history stays (`Views.only`).
        """
        keep = [v for v in range(self.views.count) if v not in set(left_out)]
        views = self.views.only(keep)

        def remaining(of: tuple[ScanView, ...]) -> tuple[ScanView, ...]:
            """Return the views that stay, numbered anew; () where there were none."""
            return tuple(replace(of[v], index=i, views=views) for i, v in enumerate(keep)) if of else ()

        return replace(
            self,
            capture=self.capture.without(np.array(sorted(left_out), np.int64)),
            T_base_flange=self.T_base_flange[keep],
            views=views,
            scan_views=remaining(self.scan_views),
            target_views=remaining(self.target_views),
        )

    def __repr__(self) -> str:
        return f"Measurement({self.capture.name!r}, {self.views.count} views)"


def measurement_of(session: SessionData, capture: Capture) -> Measurement:
    """Return the measurement of a session: its capture, and what effects may know of its views.

    Args:
        capture: of the same session, from `prepare_capture`.
    """
    views = views_of(session)
    # Per view standardised over the session, (I − Ī)/σ_I.
    intensity: list[Array | None] = [None] * len(session.views)
    if (scale := intensity_scale(session)) is not None:
        mean, deviation = scale
        clouds = [view.cloud for view in session.views]
        intensity = [None if cloud is None else (cloud.scalars["intensity"] - mean) / deviation for cloud in clouds]
    size = float(np.median([np.ptp(points, axis=0).max() for points in capture.point_sets])) or 1.0
    scan_views = [
        ScanView(v, views, np.maximum(scan.confidence, MIN_COSINE), intensity[v], size=size, eye=scan.eye)
        for v, scan in enumerate(capture.scans)
    ]
    target_views: list[ScanView] = []
    if capture.sightings is not None:
        # Slant and brightness of a target are not known: straight on and of mean intensity, effects of them are zero.
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


def intensity_scale(session: SessionData) -> tuple[float, float] | None:
    """Return mean and standard deviation of the intensity over all points in memory.

    None where a view has no intensity, one value is not finite, or all are the same.
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
    """Refuse a session whose views are not in the order of time; views without a time are passed over.

    Folders are checked as they are read; sessions made in a program are checked here.

    Raises:
        InputError: the time of a view is before that of one listed earlier.
    """
    time = np.array([np.nan if view.time_s is None else view.time_s for view in session.views])
    if (falls := np.flatnonzero(time < np.fmax.accumulate(time))).size:
        name = session.views[falls[0]].name
        raise InputError(f"{session.name}: time_s of view {name} falls; to fix: sort the views by time")


def views_of(session: SessionData) -> Views:
    """Return what effects may know of the V views of a session.

    Joints count only where every view has them and the robot's kinematics are known; a covariate only if every view has
    it. Velocities and torques of drives, which are columns too, are taken out of the covariates.
    """
    views = session.views
    axes = axes_of(session)
    scanners = scanners_of(session)
    count = len(views)
    joints = approach = np.zeros((count, 0))
    torques = no_torques(count)
    # Those columns of views.csv that have a number in every view.
    complete = set.intersection(*(set(view.covariates) for view in views))
    columns = {name: np.array([view.covariates[name] for view in views]) for name in sorted(complete)}
    if session.robot is not None and all(view.joints is not None for view in views):
        joints = np.array([view.joints for view in views])
        approach = np.array([view.approach for view in views])
        torques = torques_of_views(session.robot, joints, columns)
    speeds = [f"j{i + 1}_velocity_deg_s" for i in range(joints.shape[1])]
    has_velocity = bool(speeds) and columns.keys() >= set(speeds)
    known_otherwise = (speeds if has_velocity else []) + (torque_columns(joints.shape[1]) if torques.measured else [])
    covariates = {name: values for name, values in columns.items() if name not in known_otherwise}
    time = np.array([np.nan if view.time_s is None else view.time_s for view in views])
    return Views(
        count=count,
        time=time - time[0],
        joints=joints,
        previous=np.vstack([joints[:1], joints[:-1]]),
        approach=approach,
        velocity=np.radians(np.column_stack([columns[name] for name in speeds])) if has_velocity else None,
        torques=torques,
        covariates=covariates,
        standoff=session.scanner.standoff or _median_range(session),
        first={name: float(values[0]) for name, values in covariates.items()},
        number=np.arange(count),
        path=joints,
        T_base_flange=np.array([view.T_base_flange for view in views]),
        gravity=_gravity_of_views(axes, session),
        axes=axes,
        eye_to_hand=session.mount == "eye_to_hand",
        names=tuple(session.names),
        scanners=scanners,
        own_first=tuple(
            {name: float(values[of_view][0]) for name, values in covariates.items()}
            for of_view in scanners.masks(count)
        ),
    )


def _gravity_of_views(axes: Axes, session: SessionData) -> Array:
    """Return gravity as unit vectors in the frame to which the effective poses map the flange: (3,), or (V, 3).

    Without external axes it is the base's, (3,). Where axes carry the part it is the part's: A_left⁻¹ · gravity in each
    view. Zero without a robot, where the direction is not known.
    """
    if not session.has_poses:
        return np.zeros(3)
    gravity = gravity_of(session.robot)
    turned = frames.rotate(frames.inverse(axes.sides()[0]), gravity[None, None])[:, 0] if axes else gravity[None]
    return gravity if np.allclose(turned, gravity) else turned


def gravity_of(robot: Robot | None) -> Array:
    """Return gravity as a unit vector (3,) in the base frame: as [robot] states it, else along −z."""
    if robot is None or not np.linalg.norm(robot.gravity) > 0:
        return np.array([0.0, 0.0, -1.0])
    return robot.gravity / np.linalg.norm(robot.gravity)


def _median_range(session: SessionData) -> float:
    """Return the median over views of the median distance of points from the sensor, length_unit; 1 without points."""
    points = [view.cloud.points for view in session.views if view.cloud]
    points += [view.sighting.points for view in session.views if view.sighting]
    ranges = [np.median(np.linalg.norm(of_view, axis=1)) for of_view in points]
    return float(np.median(ranges)) if ranges else 1.0


def with_part_origin(measurement: Measurement, T_mount: Array) -> Measurement:
    """Return the measurement with what effects need of the hand-eye: itself, and the origin about which a part grows.

    The origin is that of the reference frame where the flange carries the part, since it is held there; else the mean
    of what the views show.

    Args:
        T_mount: (4, 4) hand-eye; a coarse one is enough.
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
    """Return the kind of sensor as stated; else "tracker" where its points are given in the robot's base; else None.

    If the sensor's frame is the base, points mapped to the flange by the robot's pose stand still there. No scanner has
    its origin in the robot's base, so such points come from a tracker.
    """
    if session.scanner.kind is not None or session.mount != "eye_to_hand":
        return session.scanner.kind
    sighted = [(view.T_base_flange, view.sighting) for view in session.views if view.sighting is not None]
    if not sighted:
        return None
    in_base = [sighting.points for _, sighting in sighted]
    on_flange = [frames.transform(frames.inverse(T), sighting.points) for T, sighting in sighted]
    target = np.unique(np.concatenate([sighting.targets for _, sighting in sighted]), return_inverse=True)[1]
    # Mean squares about the mean of each target.
    spread = np.mean(less_group_means(np.concatenate(in_base), target) ** 2)
    strays = np.mean(less_group_means(np.concatenate(on_flange), target) ** 2)
    return "tracker" if strays < _SAME_FRAME**2 * spread else None


def all_ahead(point_sets: Sequence[Array]) -> bool:
    """Return True if one lens along ±z can have seen the points: 98 % within 75° of that axis.

    Args:
        point_sets: arrays (N, 3), sensor frame.
    """
    some = [points[:: 1 + len(points) // _ENOUGH] for points in point_sets]
    if not some:
        return True
    shown = np.concatenate(some)
    ahead = shown[:, 2] / np.maximum(np.linalg.norm(shown, axis=1), 1e-300)
    # A stray point in a hundred says nothing.
    least, most = np.quantile(ahead, [0.01, 0.99])
    return bool(least > _WIDEST or most < -_WIDEST)
