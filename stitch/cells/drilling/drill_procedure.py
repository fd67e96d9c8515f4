"""The whole procedure on any cell: calibrate, servo onto the reference holes, compensate, set the holes upright."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from stitch.cells.drilling.compensation import GroupCompensation, compensate_group
from stitch.cells.drilling.hole_frame import drive_pose
from stitch.cells.drilling.homography import fit_homography
from stitch.cells.drilling.rangers import Rangers, fit_ranger
from stitch.cells.drilling.servo import FlangeSensors, ServoResult, align_tool_axis, measure_hole, servo_to_hole
from stitch.frames import Array

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
