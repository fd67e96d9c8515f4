"""Bring the tool onto a reference hole by what rangers and camera see, and read where the hole truly is."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stitch import frames
from stitch.cells.drilling.homography import to_plane
from stitch.cells.drilling.rangers import Rangers, fit_ranged_plane
from stitch.errors import NoResultError
from stitch.frames import Array

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
        return hole_coordinate(self.T_base_tool, self.final_sight.offset)


def hole_coordinate(T_base_tool: Array, offset: Array) -> Array:
    """Drive coordinate (3,) of a hole seen at `offset` (3,) from the tool."""
    return np.asarray(T_base_tool[:3, 3] + T_base_tool[:3, :3] @ offset)


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
