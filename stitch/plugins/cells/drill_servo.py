"""`stitch drill --servo COMMAND`: the tool is driven onto the reference holes and made upright over those to drill.

The command moves the robot and reads the sensors. It gets one JSON object on standard input and prints one:

    {"hole": "101", "pose": {"x": …, "y": …, "z": …, "a_deg": …, "b_deg": …, "c_deg": …}}      T_base_tool to drive to
    {"rangers": {"L1": 132.07, "L2": 131.88, …}, "uv": [1221.4, 1030.2]}        or "image": "101.png" in place of "uv"

It ends with exit code 0, or 3 where the robot cannot reach the pose. On a reference hole the loop of the source runs:
tilt, then height, then the camera's offset, and again, until all three are below their thresholds.
"""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from stitch.errors import InputError, NoResultError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.plugins.cells.drill_job import DrillJob, PlacedTool, Thresholds
from stitch.plugins.cells.drilling_sensors import (
    FlangeSensors,
    HoleSight,
    fit_homography,
    fit_ranger,
    hole_at_tool,
    hole_rotation,
    select_effects,
)
from stitch.plugins.cells.job_files import POSE_COLUMNS, rows_from_poses, write_columns
from stitch.system.files import whole_file
from stitch.system.programs import call_program

_MOST_STEPS = 30
SOURCE_THRESHOLDS = Thresholds()


def calibrate_sensors(job: DrillJob) -> FlangeSensors:
    """Return the flange's sensors from the job's plate, check holes and planes.

    Raises:
        NoResultError: too few or degenerate holes or planes.
    """
    beams = {name: fit_ranger(*readings) for name, readings in job.rangers.items()}
    camera = () if job.checks is None else select_effects(job.checks)
    return FlangeSensors(fit_homography(job.plate_xyz[:, :2], job.plate_uv), beams, job.height, *camera)


def drive_onto_references(job: DrillJob, command: str) -> DrillJob:
    """Return the job with the tool driven by `command` onto all reference holes that it was not placed on yet.

    The table `placed` is written after each hole, so that a call that was cut short goes on where it ended.

    Raises:
        InputError: fewer than three rangers, or a command that cannot be started.
        NoResultError: the command fails, a pose cannot be reached, or a servo loop does not converge; names the hole.
    """
    sensors = calibrate_sensors(job)
    if len(sensors.beams) < 3:
        raise InputError(f"{job.file}: --servo needs three rangers for a normal; to fix: name the rangers' table")
    placed = dict(job.placed)
    for hole in job.holes:
        if hole.reference and hole.name not in placed:
            start = drive_pose(hole.position, hole.direction)
            T_base_tool, sight, _ = servo_to_hole(looker(job, sensors, command, hole.name), start, job.thresholds)
            placed[hole.name] = PlacedTool(T_base_tool, sight.uv, float(sight.offset[2]) + job.height)
            _write_placed_tools(placed, job.placed_file)
    return replace(job, placed=placed)


def _write_placed_tools(placed: dict[str, PlacedTool], file: Path) -> None:
    poses = rows_from_poses(np.array([tool.T_base_tool for tool in placed.values()]))
    pixels = np.array([tool.uv for tool in placed.values()])
    columns = {name: poses[:, i] for i, name in enumerate(POSE_COLUMNS.split())}
    columns |= {"u": pixels[:, 0], "v": pixels[:, 1], "height": np.array([tool.height for tool in placed.values()])}
    with whole_file(file) as scratch:
        write_columns(scratch, {"hole": list(placed), **columns})


def looker(job: DrillJob, sensors: FlangeSensors, command: str, hole: str) -> Callable[[Array], HoleSight]:
    """Return what drives the tool to a pose (4, 4) over a hole and says what the sensors see there."""
    return lambda T_base_tool: sensors.see(*_drive_and_read(job, sensors, command, hole, T_base_tool))


def drive_pose(position: Array, direction: Array) -> Array:
    """Return T_base_tool (..., 4, 4) that puts the tool on a hole."""
    return frames.make(hole_rotation(direction), position)


def align_tool_axis(T_base_tool: Array, normal: Array) -> Array:
    """Return the pose (4, 4) turned about the tool's origin until its axis lies along `normal` (3,), flange frame."""
    z = np.array([0.0, 0.0, 1.0])
    axis = np.cross(z, normal)
    size = np.linalg.norm(axis)
    turn = axis / size * np.arctan2(size, normal[2]) if size > 0 else axis
    return frames.make(T_base_tool[:3, :3] @ Rotation.from_rotvec(turn).as_matrix(), T_base_tool[:3, 3])


def servo_to_hole(
    look: Callable[[Array], HoleSight], T_base_tool: Array, limits: Thresholds = SOURCE_THRESHOLDS
) -> tuple[Array, HoleSight, int]:
    """Return the pose (4, 4) at which all thresholds are met, what is seen there, and the number of moves.

    Raises:
        NoResultError: the loop does not converge.
    """
    for moves in range(_MOST_STEPS):
        sight = look(T_base_tool)
        x, y, dh = sight.offset
        R = T_base_tool[:3, :3]
        if sight.tilt >= limits.tilt:
            T_base_tool = align_tool_axis(T_base_tool, sight.normal)
        elif abs(dh) >= limits.height:
            T_base_tool = frames.make(R, T_base_tool[:3, 3] + R @ [0.0, 0.0, dh])
        elif sight.in_plane >= limits.offset:
            T_base_tool = frames.make(R, T_base_tool[:3, 3] + R @ [x, y, 0.0])
        else:
            return T_base_tool, sight, moves
    raise NoResultError(
        f"the tool did not converge on the hole in {_MOST_STEPS} steps: tilt {np.degrees(sight.tilt):.2f}°, height "
        f"{dh:+.2f}, offset {sight.in_plane:.2f}; to fix: calibrate rangers and camera again"
    )


def turn_upright(look: Callable[[Array], HoleSight], T_base_tool: Array) -> Array:
    """Return the pose (4, 4) turned twice by what the rangers see; the second turn takes up what the first one left."""
    for _ in range(2):
        T_base_tool = align_tool_axis(T_base_tool, look(T_base_tool).normal)
    return T_base_tool


def _drive_and_read(
    job: DrillJob, sensors: FlangeSensors, command: str, hole: str, T_base_tool: Array
) -> tuple[Array, Array]:
    """Drive the tool to a pose (4, 4); return the ranges (n,) and the hole's image point (2,)."""
    pose = dict(zip(POSE_COLUMNS.split(), rows_from_poses(T_base_tool[None])[0].tolist(), strict=True))
    try:
        printed = call_program("--servo", command, {"hole": hole, "pose": pose}, job.thresholds.seconds)
    except NoResultError as error:
        raise NoResultError(f"hole {hole}: {error}") from None
    try:
        answer = json.loads(printed)
        ranges = np.array([float(answer["rangers"][name]) for name in sensors.beams])
        uv = hole_at_tool(Path(answer["image"]), sensors.H) if "image" in answer else np.array(answer["uv"], float)
    except (ValueError, KeyError, TypeError):
        ranges = uv = np.array([np.nan])
    if uv.shape != (2,) or not np.isfinite([*uv, *ranges]).all():
        names = ", ".join(f'"{name}": …' for name in sensors.beams)
        raise NoResultError(
            f"hole {hole}: --servo {command} printed {printed.strip()[:80]!r}; to fix: let it print "
            f'{{"rangers": {{{names}}}, "uv": [u, v]}}'
        )
    return ranges, uv
