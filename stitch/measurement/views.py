"""What effects may know of the views: all of them at once (`Views`), or one with its points (`ScanView`)."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from stitch.frames import Array, Indices
from stitch.measurement.robot import Robot
from stitch.measurement.session import Session
from stitch.measurement.torques import PAYLOAD, Torques, measured_torques, torque_columns, torques_of


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
    names: tuple[str, ...] = ()  # of those

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
        of_views = {name: getattr(self, name)[keep] for name in ("time", "joints", "previous", "approach", "number")}
        return replace(
            self,
            count=len(keep),
            velocity=None if self.velocity is None else self.velocity[keep],
            torques=replace(self.torques, values=self.torques.values[keep]),
            covariates={name: values[keep] for name, values in self.covariates.items()},
            **of_views,
        )

    def has(self, need: str) -> bool:
        """True if joints, time, torque, velocity or a covariate is known for every view."""
        known = {
            "joints": self.joints.shape[1] > 0,
            "torque": len(self.torques.names) > 0,
            "velocity": self.velocity is not None,
            "time": bool(np.isfinite(self.time).all()) and self.count > 1 and float(np.ptp(self.time)) > 0,
        }
        return bool(known.get(need, need in self.covariates))


@dataclass(frozen=True)
class ScanView:
    """One view for the functions of points: N of them in the scanner frame, or the reference frame for `shape`."""

    index: int
    views: Views
    cosine: Array  # (N,) of incidence, 0 … 1
    intensity: Array | None  # (N,) standardised over the session
    gravity: Array  # (3,) unit vector in the reference frame
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
    def hours(self) -> float:
        """Since the first view."""
        return float(self.views.hours[self.index])


def views_of(session: Session) -> Views:
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


def _median_range(session: Session) -> float:
    ranges = [np.median(np.linalg.norm(v.cloud.points, axis=1)) for v in session.views if v.cloud]
    ranges += [np.median(np.linalg.norm(v.sighting.points, axis=1)) for v in session.views if v.sighting]
    return float(np.median(ranges)) if ranges else 1.0
