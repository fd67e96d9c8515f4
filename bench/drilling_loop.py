"""The whole drilling procedure on any cell: calibrate, servo onto the reference holes, compensate, turn upright.

`stitch drill` starts where the loop has ended; here the tool is driven, with `measure` in place of robot and sensors.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stitch.errors import NoResultError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.plugins.cells.drilling_sensors import (
    GroupCompensation,
    compensate_group,
    fit_homography,
    fit_ranger,
    hole_rotation,
    to_plane,
)


def drive_pose(position: Array, direction: Array) -> Array:
    """T_base_tool (..., 4, 4) that puts the tool on a hole."""
    return frames.make(hole_rotation(direction), position)


@dataclass(frozen=True)
class Rangers:
    """Beams of all rangers in the flange frame."""

    origins: Array  # (n, 3)
    directions: Array  # (n, 3)


@dataclass(frozen=True)
class RangedPlane:
    """The surface under the tool, in the flange frame."""

    normal: Array  # (3,) unit vector into the part, so close to +z
    height: float  # along the tool axis

    @property
    def tilt(self) -> float:
        """Angle (rad) between tool axis and normal."""
        return float(np.arctan2(np.hypot(self.normal[0], self.normal[1]), self.normal[2]))


def fit_ranged_plane(rangers: Rangers, readings: Array) -> RangedPlane:
    """Plane through the laser points of three or more readings (n,), and its height on the tool axis.

    The source takes the mean z of its four points, which is the same where the axis passes their centre.
    """
    points = rangers.origins + np.asarray(readings)[:, None] * rangers.directions
    centre = points.mean(axis=0)
    normal = np.linalg.svd(points - centre)[2][2]
    normal = normal * np.sign(normal[2])
    return RangedPlane(normal, float(centre @ normal / normal[2]))


# Moves to a pose T_base_tool and returns the ranges (n,) and the hole's image point (2,).
Measure = Callable[[Array], tuple[Array, Array]]
_MOST_STEPS = 30


@dataclass(frozen=True)
class Thresholds:
    """When the tool counts as placed; the source's values, in rad and mm."""

    tilt: float = float(np.radians(0.35))
    height: float = 0.5
    offset: float = 0.2


@dataclass(frozen=True)
class FlangeSensors:
    """The calibrated sensors of the flange."""

    rangers: Rangers
    H: Array  # (3, 3) work plane to image
    height: float  # h, of the work plane
    thresholds: Thresholds = Thresholds()


@dataclass(frozen=True)
class HoleSight:
    """What the sensors say at one pose: hole against tool, in the flange frame."""

    normal: Array  # (3,)
    tilt: float
    offset: Array  # (3,): x', y', h' − h


@dataclass(frozen=True)
class ServoResult:
    """The end of a servo loop."""

    T_base_tool: Array  # (4, 4)
    final_sight: HoleSight
    steps: int

    @property
    def hole(self) -> Array:
        """Drive coordinate (3,) of the hole: p + R'·(x', y', h' − h) (source, formula 14)."""
        return self.T_base_tool[:3, 3] + self.T_base_tool[:3, :3] @ self.final_sight.offset


def measure_hole(sensors: FlangeSensors, ranges: Array, uv: Array) -> HoleSight:
    """One measurement in the flange frame, from the rangers' readings and an image point (2,)."""
    seen = fit_ranged_plane(sensors.rangers, ranges)
    xy = to_plane(sensors.H, np.asarray(uv)[None])[0]
    return HoleSight(seen.normal, seen.tilt, np.append(xy, seen.height - sensors.height))


def align_tool_axis(T_base_tool: Array, normal: Array) -> Array:
    """The pose turned about the tool's origin so that its axis lies along `normal` (3,), given in the flange frame."""
    z = np.array([0.0, 0.0, 1.0])
    axis = np.cross(z, normal)
    size = np.linalg.norm(axis)
    turn = axis / size * np.arctan2(size, normal[2]) if size > 0 else axis
    R = T_base_tool[:3, :3] @ Rotation.from_rotvec(turn).as_matrix()
    return frames.make(R, T_base_tool[:3, 3])


def servo_to_hole(measure: Measure, sensors: FlangeSensors, T_base_tool: Array) -> ServoResult:
    """Tilt, then height, then camera offset, and again until all three are below their thresholds; starts at a pose
    (4, 4).

    Raises:
        NoResultError: the loop does not converge.
    """
    limits = sensors.thresholds
    for step in range(_MOST_STEPS):
        sight = measure_hole(sensors, *measure(T_base_tool))
        x, y, dh = sight.offset
        R = T_base_tool[:3, :3]
        if sight.tilt >= limits.tilt:
            T_base_tool = align_tool_axis(T_base_tool, sight.normal)
        elif abs(dh) >= limits.height:
            T_base_tool = frames.make(R, T_base_tool[:3, 3] + R @ [0.0, 0.0, dh])
        elif np.hypot(x, y) >= limits.offset:
            T_base_tool = frames.make(R, T_base_tool[:3, 3] + R @ [x, y, 0.0])
        else:
            return ServoResult(T_base_tool, sight, step)
    raise NoResultError(
        f"the tool did not converge on the hole in {_MOST_STEPS} steps: tilt {np.degrees(sight.tilt):.2f}°, height "
        f"{dh:+.2f}, offset {np.hypot(x, y):.2f}; calibrate rangers and camera again"
    )


# Position (3,) and inward direction (3,) by hole name.
Holes = Mapping[str, tuple[Array, Array]]
# Moves to T_base_tool over the named hole; ranges (n,) and image point (2,).
MeasureHole = Callable[[str, Array], tuple[Array, Array]]


@dataclass(frozen=True)
class HoleGroup:
    """One group after compensation."""

    placed: dict[str, ServoResult]  # reference holes
    compensation: GroupCompensation
    drives: dict[str, Array]  # T_base_tool (4, 4) of the holes to drill


def calibrate_sensors(
    plate_xyz: Array, plate_uv: Array, planes: Array, readings: Array, height: float
) -> FlangeSensors:
    """Sensors from the nine-hole plate (N, 3), (N, 2), and from planes (M, 4) with readings (rangers, M).

    Raises:
        NoResultError: too few or degenerate holes or planes.
    """
    beams = [fit_ranger(planes, row) for row in readings]
    rangers = Rangers(np.array([b.origin for b in beams]), np.array([b.direction for b in beams]))
    return FlangeSensors(rangers, fit_homography(plate_xyz[:, :2], plate_uv), height)


def run_group(
    measure: MeasureHole, sensors: FlangeSensors, nominal: Holes, references: Sequence[str], targets: Sequence[str]
) -> HoleGroup:
    """Servo onto the references, compensate the targets, then turn each target upright by the rangers.

    Raises:
        NoResultError: a servo loop does not converge, or the references fix no rigid motion.
    """
    placed = {
        name: servo_to_hole(lambda T, name=name: measure(name, T), sensors, drive_pose(*nominal[name]))  # type: ignore[misc]
        for name in references
    }
    actual = np.array([placed[name].hole for name in references])
    found = compensate_group(np.array([nominal[name][0] for name in references]), actual)
    positions, directions = found.apply(*(np.array([nominal[name][i] for name in targets]) for i in (0, 1)))
    drives = {
        name: turn_upright(lambda T, name=name: measure(name, T), sensors, drive_pose(p, v))  # type: ignore[misc]
        for name, p, v in zip(targets, positions, directions, strict=True)
    }
    return HoleGroup(placed, found, drives)


def turn_upright(measure: Callable[[Array], tuple[Array, Array]], sensors: FlangeSensors, T_base_tool: Array) -> Array:
    """The pose (4, 4) turned twice by what the rangers see: the second turn takes up what the first one's size left."""
    for _ in range(2):
        T_base_tool = align_tool_axis(T_base_tool, measure_hole(sensors, *measure(T_base_tool)).normal)
    return T_base_tool
