"""What was measured: a session, its scanner and its views, each with a scan or with named points."""

from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from stitch.errors import InputError
from stitch.numerics.frames import Array, Indices, Mask
from stitch.session.axes import Axis
from stitch.session.robot import Robot
from stitch.session.scan import Scan, bounding_box
from stitch.system.values import Value, take_rows

Mount = Literal["eye_to_hand", "eye_in_hand"]
SensorKind = Literal["area", "line", "tracker", "probe", "camera"]
# ISO 9283: RP = l̄ + 3·S_l; for isotropic scatter σ a coordinate l̄ = 2σ√(2/π) and S_l = σ√(3 − 8/π).
_RP_OF_SIGMA = float(2 * np.sqrt(2 / np.pi) + 3 * np.sqrt(3 - 8 / np.pi))


@dataclass(frozen=True)
class Cloud:
    """One scan in the scanner frame, in the session's length_unit."""

    points: Array  # (N, 3)
    normals: Array | None = None  # (N, 3) if the file has them
    scalars: dict[str, Array] = field(default_factory=dict)  # name -> (N,), e.g. intensity, time
    whole: "WholeCloud | None" = None  # None: these are all points that were scanned
    codes: tuple[float, ...] = ()  # values in the file that mean "nothing measured"
    coded: int = 0  # points of the file with such a value, left out of `points`

    @property
    def count(self) -> int:
        """The number of points that were scanned, in memory or not."""
        return len(self.points) if self.whole is None else self.whole.count

    def within(self, box: Array) -> "Cloud":
        """Return the cloud of its points inside a box (2, 3), lowest and highest corner, scanner frame."""
        return self.at(((self.points >= box[0]) & (self.points <= box[1])).all(axis=1))

    def at(self, index: Indices | Mask) -> "Cloud":
        """Return the cloud of some of its points, and of nothing else."""
        return take_rows(Cloud(self.points, self.normals, self.scalars), index, "points", "normals", "scalars")


@dataclass(frozen=True)
class WholeCloud:
    """All points of a scan of which a cloud holds some; they stay where they are, mostly in a file."""

    reload: Callable[[], Cloud] = field(compare=False)  # reads them
    count: int
    box: Array  # (2, 3) its lowest and highest corner, scanner frame
    scan: Scan  # the points that the cloud holds, with the surface of all of them

    def read(self) -> Cloud:
        """Return every point, in the order in which they were scanned.

        Raises:
            InputError: the file is not what it was.
        """
        cloud = self.reload()
        if len(cloud.points) != self.count or not np.array_equal(bounding_box(cloud.points), self.box):
            raise InputError(f"the scan of view {self.scan.name} changed on disk during the run; to fix: run again")
        return cloud


@dataclass(frozen=True)
class Sighting:
    """What one view shows of named targets, sensor frame; a 6D probe is a target with an orientation."""

    targets: tuple[str, ...]  # k
    points: Array  # (k, 3) length_unit
    sigma: Array  # (k,) of a coordinate; NaN where nobody states it
    rotation: Array | None = None  # (3, 3) R_sensor_probe of the one target
    sigma_rotation: float = float("nan")  # rad


@dataclass(frozen=True)
class NominalTargets:
    """Where targets.csv puts the targets, part frame."""

    targets: tuple[str, ...]  # T
    points: Array  # (T, 3) length_unit
    sigma: Array  # (T,) of a coordinate; NaN where nobody states it


@dataclass(frozen=True)
class View:
    """One row of views.csv."""

    name: str
    cloud: Cloud | None
    T_base_flange: Array  # (4, 4), reported, or from the joints where no pose is reported; with the axes (`axes.py`)
    joints: Array | None  # (n,) rad
    approach: Array | None  # (n,) -1, 0, +1
    time_s: float | None
    covariates: dict[str, float]
    sighting: Sighting | None = None  # labelled points or a measured probe
    axis_approach: Array | None = None  # (K,) -1, 0, +1 of the session's axes; their readings are covariates
    scanner: int = 0  # index of its session among `parts`


@dataclass(frozen=True)
class Scanner:
    """The scanner as session.toml describes it."""

    T_mount: Array | None  # (4, 4) coarse hand-eye: T_base_scanner or T_flange_scanner
    noise: float | None
    standoff: float | None
    optical_axis: Array  # (3,) unit vector in the scanner frame
    kind: SensorKind | None = None  # None: nobody says; whatever a sensor may have can be asked for
    moving: bool = False  # points lie in the scanner's frame at their own time, not at that of the view
    name: str = ""  # sessions of other scanners have hand-eyes of their own

    def eye(self, points: Array) -> Array:
        """Return the point (3,), scanner frame, from which the scanner looks at points (N, 3).

        The origin, unless that lies in the measuring volume: the points' median distance from it is below half of the
        standoff. Then the scanner is one standoff behind the origin along its optical axis.
        """
        if self.standoff is None or not len(points):
            return np.zeros(3)
        amid = np.median(np.linalg.norm(points, axis=1)) < self.standoff / 2
        return -self.standoff * self.optical_axis if amid else np.zeros(3)


@dataclass(frozen=True)
class StatedRepeatability:
    """The arm's pose repeatability as a data sheet or a test by ISO 9283 states it."""

    position: float | None = None  # RP, length_unit
    rotation: float | None = None  # RP of an angle, rad

    @property
    def sigma_translation(self) -> float | None:
        """Of each coordinate: RP = mean + 3 standard deviations of distances that are Maxwell distributed."""
        return None if self.position is None else self.position / _RP_OF_SIGMA

    @property
    def sigma_rotation(self) -> float | None:
        """Of each angle: RP = ±3 standard deviations."""
        return None if self.rotation is None else self.rotation / 3.0


@dataclass(frozen=True, eq=False)
class SessionData(Value, document="stitch.api.check:session_summary"):
    """Measured data of one session. Lengths in length_unit, angles in rad."""

    path: Path = field(compare=False)
    name: str
    length_unit: str
    mount: Mount
    scanner: Scanner
    robot: Robot | None
    sphere_radius: float | None
    cad: Path | None
    cad_unit: str | None
    views: tuple[View, ...]
    warnings: tuple[str, ...] = field(default=())
    nominal: NominalTargets | None = None  # targets in the part frame
    repeatability: StatedRepeatability = field(default_factory=StatedRepeatability)
    axes: tuple[Axis, ...] = ()  # in the order of the chain
    has_poses: bool = True  # False: axes alone move what is scanned
    usual: dict[str, str] = field(default_factory=dict, compare=False)  # what was only guessed when it was made
    parts: tuple["SessionData", ...] = ()  # whole sessions of the scanners of which this one was joined

    @property
    def reference_frame(self) -> str:
        """Name of the frame in which the stitched cloud lies: "flange", "base", or without a robot that of an axis.

        The axis is the first rotary one, else the first (`Axes.frame_axis`).
        """
        if not self.has_poses:
            return next((axis for axis in self.axes if axis.is_rotary), self.axes[0]).name
        return "flange" if self.mount == "eye_to_hand" else "base"

    @property
    def has_clouds(self) -> bool:
        """True if every view has a cloud."""
        return all(view.cloud is not None for view in self.views)

    @property
    def has_sightings(self) -> bool:
        """True if some view shows labelled points or a probe."""
        return any(view.sighting is not None for view in self.views)

    @property
    def names(self) -> list[str]:
        """Of the views, in the session's order."""
        return [view.name for view in self.views]

    @property
    def states_hand_eye(self) -> bool:
        """True if session.toml states a hand-eye of one scanner on a robot; of axes alone it only places an axis."""
        return self.scanner.T_mount is not None and self.has_poses and not self.parts

    def without(self, names: Collection[str]) -> "SessionData":
        """Return the session less some views.

        Example:
            >>> session.without(["v000"]).names
            ['v001', 'v002', 'v003', 'v004']
        """
        return replace(self, views=tuple(view for view in self.views if view.name not in names))

    @property
    def joints(self) -> Array | None:
        """Joint angles (V, n) rad; None unless every view states them."""
        known = [view.joints for view in self.views if view.joints is not None]
        return np.array(known) if len(known) == len(self.views) else None

    def __repr__(self) -> str:
        shows = [word for word, has in (("clouds", self.has_clouds), ("labelled points", self.has_sightings)) if has]
        return f"Session({self.name!r}, {self.mount}, {len(self.views)} views of {' and '.join(shows) or 'nothing'})"
