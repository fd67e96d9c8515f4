"""The chain of frames with effects in it: everything that a model needs to place the points.

    x_ref = part⁻¹( robot(q*) · mount* · sensor⁻¹(x) )

A capture keeps this form: `T_reference_mount` holds what stands left of the hand-eye, `T_behind_mount`
what stands right of it, and the points are those that sensor and part would have shown without effects.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices
from stitch.session import robot as kinematics
from stitch.session.capture import Capture
from stitch.session.robot import Robot
from stitch.session.session import Mount, SensorKind, SessionData

# Columns of views.csv that do not count, since in some views nothing stands there.


def gaps_note(session: SessionData) -> str:
    """In one sentence, with a view that lacks each; empty where there is no gap."""
    lacking = dict[str, list[str]]()
    columns = sorted({name for view in session.views for name in view.covariates})
    for name, view in zip(session.names, session.views, strict=True):
        gaps = [column for column in columns if column not in view.covariates]
        gaps += ["time_s"] if view.time_s is None else []
        gaps += ["joint angles"] if view.joints is None else []
        for column in gaps:
            lacking.setdefault(column, []).append(name)
    # What no view has is no gap.
    found = [
        f"{column} ({views[0]}{f' and {len(views) - 1} more' if len(views) > 1 else ''} without)"
        for column, views in lacking.items()
        if len(views) < len(session.views)
    ]
    return f"Not used, since some views have none: {', '.join(found)}." if found else ""


# Torques that bend the joints of an arm at its views: measured, or of gravity with masses or without.

PAYLOAD = "payload_kg"  # column: what the flange carries, at the centre of mass of [robot] payload, else at the flange
# Joint angles that show which torques of an arm differ.
_ANYWHERE = 100
STILL = 1e-3  # N·m of 1 kg: an axis that gravity does not bend
TURNED = 0.02  # rad by which gravity turns at the least: of what holds still it is a part of the hand-eye


@dataclass(frozen=True)
class Torques:
    """Torques under which joints sag: with masses one a joint, without them one a joint and a link beyond."""

    names: tuple[str, ...]
    joint: tuple[int, ...]  # that the torque bends
    values: Array  # (V, m) N·m about +z of that joint; of 1 kg at the link's frame where masses are unknown
    measured: bool = False


def torques_of(robot: Robot, joints: Array, payload: Array | None = None) -> Torques:
    """Gravity torques at joint angles (V, n); which ones there are is the arm's own, whatever the angles.

    Args:
        payload: (V,) kg, in place of the mass in [robot] payload.
    """
    if payload is None and robot.has_masses:
        return _each_joint(kinematics.gravity_torques(robot, joints))
    if payload is None and not robot.payload_mass:
        return _unit_link_torques(robot, joints)
    payload = np.full(len(joints), robot.payload_mass) if payload is None else payload
    carried = payload[:, None] * kinematics.payload_torques(robot, joints)
    if robot.has_masses:
        return _each_joint(kinematics.gravity_torques(replace(robot, payload_mass=0.0), joints) + carried)
    # What the links weigh nobody knows, what they carry is known: a coefficient of its own for every joint it bends.
    links = _unit_link_torques(robot, joints)
    bent = np.flatnonzero(np.ptp(kinematics.payload_torques(robot, _sample_joints(robot)), axis=0) > STILL)
    names = (*links.names, *(str(i + 1) for i in bent))
    return Torques(names, (*links.joint, *(int(i) for i in bent)), np.hstack([links.values, carried[:, bent]]))


def measured_torques(drives: Array) -> Torques:
    """Of drives (V, n), N·m, as controllers report them: a drive holds the opposite of what bends its joint."""
    return replace(_each_joint(-drives), measured=True)


def torque_columns(covariates: Mapping[str, Array], joints: int) -> Array | None:
    """(V, n) the columns jN_torque_nm of all joints, or None where one is missing."""
    names = [f"j{i + 1}_torque_nm" for i in range(joints)]
    whole = bool(names) and all(name in covariates for name in names)
    return np.column_stack([covariates[name] for name in names]) if whole else None


def payload_note(session: SessionData) -> str:
    """Where a payload counts whose centre of mass nobody states; empty where one is stated, or nothing is carried."""
    robot = session.robot
    if robot is None or not robot.carries_at_flange or any(view.joints is None for view in session.views):
        return ""
    columns = [view.covariates for view in session.views]
    if all("j1_torque_nm" in column for column in columns):
        return ""  # drives report what bends the joints
    loads = [column.get(PAYLOAD, robot.payload_mass) for column in columns]
    if not any(loads):
        return ""
    return (
        f"The payload, up to {max(loads):g} kg, counts at the flange's origin: [robot] payload states no other centre "
        "of mass (com)."
    )


def _each_joint(values: Array) -> Torques:
    n = values.shape[1]
    return Torques(tuple(str(i + 1) for i in range(n)), tuple(range(n)), values)


def _sample_joints(robot: Robot) -> Array:
    """(N, n) joint angles from everywhere: a coefficient must mean the same in every session of an arm."""
    return np.random.default_rng(0).uniform(-np.pi, np.pi, (_ANYWHERE, robot.n_joints))


def _unit_link_torques(robot: Robot, joints: Array) -> Torques:
    """Of 1 kg at each link's frame, as far as they differ: without masses the geometry gives their shapes alone."""
    n = robot.n_joints
    shapes = kinematics.unit_torques(robot, _sample_joints(robot))
    keep = [(i, k) for i in range(n) for k in _independent_links(shapes[:, i], range(i, n))]
    unit = kinematics.unit_torques(robot, joints)
    values = np.array([unit[:, i, k] for i, k in keep]).T.reshape(len(joints), len(keep))
    return Torques(tuple(f"{i + 1}_{k + 1}" for i, k in keep), tuple(i for i, _ in keep), values)


def _independent_links(torques: Array, links: Sequence[int]) -> list[int]:
    """The links whose unit torque (V, n) about one joint changes and is no combination of those before it.

    Frames of a wrist share their origin: a second torque from the same place would only make both unknown.
    """
    chosen, basis = list[int](), np.zeros((len(torques), 0))
    for k in links:
        own = torques[:, k]
        rest = own - basis @ (basis.T @ own)
        if np.ptp(own) > STILL and np.linalg.norm(rest) > 1e-6 * np.linalg.norm(own):
            chosen.append(k)
            basis = np.column_stack([basis, rest / np.linalg.norm(rest)])
    return chosen


# What is said of a session before anything is fitted: how a stated payload counts, and what does not count.


def session_notes(session: SessionData) -> list[str]:
    """A sentence each; `check` and `run` say the same."""
    return [note for note in (payload_note(session), gaps_note(session), sensor_note(session)) if note]


def sensor_note(session: SessionData) -> str:
    """Return what the sensor of labelled points is taken for, where session.toml does not state it; else nothing."""
    shown = [view.sighting.points for view in session.views if view.sighting is not None]
    if session.scanner.kind is not None or session.has_clouds or not shown:
        return ""
    if sensor_kind(session) == "tracker":
        return "The sensor is taken for a tracker, since its points are given in the robot's base."
    if not _all_ahead(shown):
        return "The sensor is taken for one without a lens, since it shows points beside or behind itself."
    return (
        "The sensor's kind is not stated, so errors of a scanner are tried too; "
        'to leave them out, write kind = "tracker" under [scanner] in session.toml.'
    )


# Share of the points' own spread within which points on the flange stand still in it, if sensor and base are one frame.
_SAME_FRAME = 0.05


def sensor_kind(session: SessionData) -> SensorKind | None:
    """Return the kind as stated, or a tracker where its points are given in the robot's base; None if unknown.

    No scanner stands inside the robot. Points on the flange stand still in its frame if the sensor's frame is the base.
    """
    if session.scanner.kind is not None or session.mount != "eye_to_hand":
        return session.scanner.kind
    seen = [(view.T_base_flange, view.sighting) for view in session.views if view.sighting is not None]
    if not seen:
        return None
    names = np.concatenate([sighting.targets for _, sighting in seen])
    in_base = [sighting.points for _, sighting in seen]
    on_flange = [frames.transform(frames.inverse(T), sighting.points) for T, sighting in seen]
    of = np.unique(names, return_inverse=True)[1]
    strays, spread = (_variance_within(np.concatenate(points), of) for points in (on_flange, in_base))
    return "tracker" if strays < _SAME_FRAME**2 * spread else None


def _variance_within(points: Array, group: Indices) -> float:
    """Return the variance of points (N, 3) about the mean of their group (N,)."""
    count = np.bincount(group)[:, None]
    mean = np.stack([np.bincount(group, x) for x in points.T], axis=1) / count
    return float(np.mean((points - mean[group]) ** 2))


# Cosine of the angle from the axis beyond which no lens shows anything that measures, 75°.
_WIDEST = 0.26
# Points of a view that say where a sensor looks.
_ENOUGH = 1000


def _all_ahead(point_sets: Sequence[Array]) -> bool:
    """True if a lens may have seen all points, sensor frame: none beside it or behind."""
    some = [points[:: 1 + len(points) // _ENOUGH] for points in point_sets]
    if not some:
        return True
    shown = np.concatenate(some)
    ahead = shown[:, 2] / np.maximum(np.linalg.norm(shown, axis=1), 1e-300)
    # A stray point in a hundred says nothing.
    least, most = np.quantile(ahead, [0.01, 0.99])
    return bool(least > _WIDEST or most < -_WIDEST)


# What effects may know of the views: all of them at once (`Views`), or one with its points (`ScanView`).


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
    gravity: Array  # (3,) unit vector, base frame
    eye_to_hand: bool
    names: tuple[str, ...] = ()  # of the session's views
    T_mount: Array = field(default_factory=lambda: np.eye(4))  # (4, 4) hand-eye, coarse

    @cached_property
    def gravity_at_mount(self) -> Array:
        """(V, 3) unit vector in the mount frame: of the flange where it carries the scanner, else of the base."""
        return self._gravity_in_base if self.eye_to_hand else self._gravity_in_flange

    @cached_property
    def gravity_at_part(self) -> Array:
        """(V, 3) unit vector in the reference frame: of the flange where it carries the part, else of the base."""
        return self._gravity_in_flange if self.eye_to_hand else self._gravity_in_base

    @property
    def _gravity_in_flange(self) -> Array:
        return np.asarray(frames.rotate(frames.inverse(self.T_base_flange), self.gravity[None])[:, 0])

    @property
    def _gravity_in_base(self) -> Array:
        return np.tile(self.gravity, (self.count, 1))

    def at_scanner(self, twists: Array) -> Array:
        """(V, 6) twists of the mount frame about its origin, as an effect of the mount returns them."""
        return np.asarray(twists @ frames.adjoint(frames.inverse(self.T_mount)).T)

    def sag(self, c: Array) -> Array:
        """(V, n) joint angles of the compliances c (m,) under the gravity torques."""
        out = np.zeros_like(self.joints)
        for k, joint in enumerate(self.torques.joint):
            out[:, joint] += c[k] * self.torques.values[:, k]
        return out

    def since_first(self, covariate: str) -> Array:
        """(V,) a covariate less its value at the first view."""
        return np.asarray(self.covariates[covariate] - self.first[covariate])

    def behind(self, joint: int, play: float) -> Array:
        """(V,) rad by which what a joint drives stays behind it where friction holds it within ± `play`.

        It follows the last reversals and not only the last direction: the play operator (Krejčí 1996, "Hysteresis,
        Convexity and Dissipation in Hyperbolic Equations", ch. II), at rest in the first view of the session.
        """
        states = np.append(np.nan, self.path[:, joint])  # before the first view, and after each
        for v, at in enumerate(self.path[1:, joint], start=2):
            states[v] = min(max(states[v - 1], at - play), at + play)
        q, before = self.joints[:, joint], states[self.number]
        return np.where(self.number > 0, np.clip(before, q - play, q + play) - q, 0.0)

    @property
    def hours(self) -> Array:
        """(V,) since the first view."""
        return self.time / 3600.0

    def only(self, keep: Sequence[int]) -> "Views":
        """Some of the views; their numbers, the rows before them and the first values stay those of the session."""
        rows = ("time", "joints", "previous", "approach", "number", "T_base_flange")
        of_views = {name: getattr(self, name)[keep] for name in rows}
        return replace(
            self,
            count=len(keep),
            velocity=None if self.velocity is None else self.velocity[keep],
            torques=replace(self.torques, values=self.torques.values[keep]),
            covariates={name: values[keep] for name, values in self.covariates.items()},
            **of_views,
        )

    def has(self, need: str) -> bool:
        """True if joints, time, torque, velocity or a covariate is known for every view, or if gravity turns."""
        known = {
            "joints": self.joints.shape[1] > 0,
            "torque": len(self.torques.names) > 0,
            "velocity": self.velocity is not None,
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
        """(N, 3) unit rays."""
        away = self.away(points)
        return np.asarray(away / np.sqrt(np.einsum("ij,ij->i", away, away))[:, None])

    def away(self, points: Array) -> Array:
        """(N, 3) from the scanner's eye to the points."""
        return points - self.eye

    def rho2(self, points: Array) -> Array:
        """(N,) ρ² = a² + b² of (a, b) = (x/z, y/z)."""
        x, y, z = self.away(points).T
        return np.asarray((x**2 + y**2) / z**2)

    def since_first(self, covariate: str) -> float:
        """A covariate of this view less its value at the first one."""
        return float(self.views.since_first(covariate)[self.index])

    @property
    def gravity(self) -> Array:
        """(3,) unit vector in the reference frame."""
        return np.asarray(self.views.gravity_at_part[self.index])

    @property
    def hours(self) -> float:
        """Since the first view."""
        return float(self.views.hours[self.index])


def views_of(session: SessionData) -> Views:
    """Collect what effects may know; joints count only where the robot's kinematics are known too."""
    rows = session.views
    count = len(rows)
    use = session.robot is not None and all(row.joints is not None for row in rows)
    joints = np.array([row.joints for row in rows]) if use else np.zeros((count, 0))
    approach = np.array([row.approach for row in rows]) if use else np.zeros((count, 0))
    previous = np.vstack([joints[:1], joints[:-1]])
    time = np.array([np.nan if row.time_s is None else row.time_s for row in rows])
    names = {name for row in rows for name in row.covariates}
    covariates = {
        name: np.array([row.covariates[name] for row in rows])
        for name in sorted(names)
        if all(name in row.covariates for row in rows)
    }
    speeds = [f"j{i + 1}_velocity_deg_s" for i in range(joints.shape[1])]
    moving = bool(speeds) and all(name in covariates for name in speeds)
    velocity = np.radians(np.column_stack([covariates.pop(name) for name in speeds])) if moving else None
    standoff = session.scanner.standoff or _median_range(session)
    torques = _torques(session.robot, joints, covariates) if use and session.robot else no_torques(count)
    first = {name: float(course[0]) for name, course in covariates.items()}
    return Views(
        count=count,
        time=time - time[0],
        joints=joints,
        previous=previous,
        approach=approach,
        velocity=velocity,
        torques=torques,
        covariates=covariates,
        standoff=standoff,
        first=first,
        number=np.arange(count),
        path=joints,
        T_base_flange=np.array([row.T_base_flange for row in rows]),
        gravity=gravity_of(session.robot),
        eye_to_hand=session.mount == "eye_to_hand",
        names=tuple(session.names),
    )


def no_torques(count: int) -> Torques:
    """Of an arm that nobody knows."""
    return Torques((), (), np.zeros((count, 0)))


def _torques(robot: Robot, joints: Array, covariates: dict[str, Array]) -> Torques:
    """As drives report them, where they do; else of gravity, with what the flange carries where that is a column."""
    drives = torque_columns(covariates, joints.shape[1])
    if drives is not None:
        for i in range(joints.shape[1]):
            del covariates[f"j{i + 1}_torque_nm"]
        return measured_torques(drives)
    return torques_of(robot, joints, covariates.get(PAYLOAD))


def _median_range(session: SessionData) -> float:
    ranges = [np.median(np.linalg.norm(v.cloud.points, axis=1)) for v in session.views if v.cloud]
    ranges += [np.median(np.linalg.norm(v.sighting.points, axis=1)) for v in session.views if v.sighting]
    return float(np.median(ranges)) if ranges else 1.0


# Beyond 84° of incidence 1/cos α is noise of the normal; such points are not used anyway.
MIN_COSINE = 0.1


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
        return _all_ahead(self.capture.point_sets)

    @property
    def has_surfaces(self) -> bool:
        """True unless the sensor is known to see no surfaces, at no slant: a camera sees marks."""
        return self.sensor in (None, "area", "line")

    def without(self, left_out: Sequence[int]) -> "Measurement":
        """The measurement less some views; of the others numbers, rows before and first values stay as they were."""
        keep = [v for v in range(self.views.count) if v not in set(left_out)]
        views = self.views.only(keep)
        scan_views, target_views = (
            tuple(replace(own[v], index=i, views=views) for i, v in enumerate(keep)) if own else ()
            for own in (self.scan_views, self.target_views)
        )
        return replace(
            self,
            capture=self.capture.without(np.array(sorted(left_out), np.int64)),
            T_base_flange=self.T_base_flange[keep],
            views=views,
            scan_views=scan_views,
            target_views=target_views,
        )

    def __repr__(self) -> str:
        return f"Measurement({self.capture.name!r}, {self.views.count} views)"


def measurement_of(session: SessionData, capture: Capture) -> Measurement:
    """Collect a session and its prepared scans."""
    views = views_of(session)
    intensity = _intensities(session)
    size = float(np.median([np.ptp(points, axis=0).max() for points in capture.point_sets])) or 1.0
    like = [ScanView(v, views, np.zeros(0), intensity[v], size=size) for v in range(views.count)]
    scan_views = [
        replace(like[v], cosine=np.maximum(scan.confidence, MIN_COSINE), eye=scan.eye)
        for v, scan in enumerate(capture.scans)
    ]
    target_views: list[ScanView] = []
    if capture.sightings is not None:
        # Nobody knows at what slant a target was seen, or how bright: effects of these have nothing to say about it.
        straight = np.ones(capture.sightings.used.shape[1])
        usual = None if intensity[0] is None else np.zeros(len(straight))
        target_views = [replace(view, cosine=straight, intensity=usual) for view in like]
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


def gravity_of(robot: Robot | None) -> Array:
    """(3,) unit vector, base frame: as the robot's table states it, else downwards."""
    if robot is None or not np.linalg.norm(robot.gravity) > 0:
        return np.array([0.0, 0.0, -1.0])
    return np.asarray(robot.gravity / np.linalg.norm(robot.gravity))


def with_part_origin(measurement: Measurement, T_mount: Array) -> Measurement:
    """The measurement with the origin about which a part grows, and the place of the scanner on its mount; a coarse
    hand-eye is enough.

    On the flange that origin is the flange, which holds the part; in the cell it is the middle of what the views show.
    """
    views, origin = replace(measurement.views, T_mount=T_mount), np.zeros(3)
    if not measurement.eye_to_hand:
        seen = zip(measurement.capture.poses(T_mount), measurement.capture.visible_points, strict=True)
        origin = np.mean([frames.transform(T, points).mean(axis=0) for T, points in seen if len(points)], axis=0)
    scan_views, target_views = (
        tuple(replace(v, views=views, origin=origin) for v in own)
        for own in (measurement.scan_views, measurement.target_views)
    )
    return replace(measurement, views=views, scan_views=scan_views, target_views=target_views)


def intensity_scale(session: SessionData) -> tuple[float, float] | None:
    """Mean and standard deviation over all points in memory; None where some have none, or all the same."""
    raw = [None if v.cloud is None else v.cloud.scalars.get("intensity") for v in session.views]
    if any(values is None for values in raw):
        return None
    everything = np.concatenate([values for values in raw if values is not None])
    # One value that is not finite would spoil the mean of all: intensity then counts as absent, in every view.
    if not np.isfinite(everything).all() or everything.std() <= 0:
        return None
    return float(everything.mean()), float(everything.std())


def _intensities(session: SessionData) -> list[Array | None]:
    """Standardised over the session: (I − Ī)/σ_I."""
    scale = intensity_scale(session)
    clouds = [None if scale is None else view.cloud for view in session.views]
    return [None if c is None or scale is None else (c.scalars["intensity"] - scale[0]) / scale[1] for c in clouds]
