"""`stitch drill`: a drilling job from its readings to the corrected drives."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from stitch.cli.terminal import say, show_table
from stitch.errors import NoResultError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.units import value_uncertainty_text
from stitch.output.session_files import SessionFiles, pose_columns
from stitch.plugins.cells.drill_checks import STAGES, PlatePlace, TrialError, plate_place, trial_error
from stitch.plugins.cells.drill_job import DrillJob, Hole, read_drill_job
from stitch.plugins.cells.drill_servo import calibrate_sensors, drive_onto_references, looker, turn_upright
from stitch.plugins.cells.drilling_sensors import (
    CameraEffectTest,
    FlangeSensors,
    GroupCompensation,
    ToolAxis,
    base_frame,
    compensate_group,
    euler_zyx,
    find_tool_axis,
    hole_rotation,
    leave_one_out,
)
from stitch.plugins.cells.job_files import Wanted, fixed_digits, hand_out, points_table, write_columns

_ABSENT_EFFECTS = {"plate_height": "No error of the plate's height", "k1": "No distortion of the lens"}


@dataclass(frozen=True)
class Drive:
    """Where the robot is sent to drill one hole."""

    hole: Hole
    position: Array  # (3,)
    direction: Array  # (3,) of the hole
    rotation: Array  # (3, 3) reported orientation of the tool

    @property
    def angles(self) -> Array:
        """(3,) in rad about z, y', x''."""
        return euler_zyx(self.rotation)


@dataclass(frozen=True)
class DrillResult:
    """Everything a job gives. Lengths in length_unit."""

    sensors: FlangeSensors
    leave_one_out_errors: Array  # (N, 2) of the plate's holes, in the work plane
    groups: dict[str, GroupCompensation]
    drives: tuple[Drive, ...]
    T_measuring_base: Array | None
    tool_axis: ToolAxis | None
    plate: PlatePlace
    trials: tuple[TrialError, ...]


def solve_drill_job(job: DrillJob) -> DrillResult:
    """Return compensation of every group, the drives, and what else the job holds readings for.

    What the check holes show of the camera is taken out of the reference holes' places.

    Raises:
        NoResultError: a step has too few or degenerate readings; names the step.
    """
    sensors = calibrate_sensors(job)
    xy = job.plate_xyz[:, :2]
    groups: dict[str, GroupCompensation] = {}
    for group in dict.fromkeys(hole.group for hole in job.holes):
        references = [hole for hole in job.holes if hole.group == group and hole.reference]
        if len(references) < 3:
            raise NoResultError(f"group {group}: {len(references)} reference holes; to fix: give it three or more")
        actual = np.array([_measured_hole(job, sensors, hole.name) for hole in references])
        groups[group] = compensate_group(np.array([hole.position for hole in references]), actual)
    # The tool's axis from each reference hole once, whatever number of groups it serves.
    once = {hole.name: hole for hole in job.holes if hole.reference}
    tool_axis = find_tool_axis(
        np.array([job.placed[name].T_base_tool[:3, :3] for name in once]),
        np.array([groups[h.group].T_actual_nominal[:3, :3] @ h.direction for h in once.values()]),
    )
    return DrillResult(
        sensors,
        leave_one_out_errors=leave_one_out(xy, job.plate_uv) if len(xy) > 4 else np.empty((0, 2)),
        groups=groups,
        drives=tuple(
            _corrected_drive(hole, groups[hole.group].T_actual_nominal, tool_axis)
            for hole in job.holes
            if not hole.reference
        ),
        T_measuring_base=base_frame(*job.marker_paths, job.joint6_height) if job.marker_paths else None,
        tool_axis=tool_axis,
        plate=plate_place(job.plate_xyz, job.height, job.locating_rms),
        trials=tuple(_trial_errors(job, sensors)),
    )


def make_drives_upright(job: DrillJob, result: DrillResult, command: str) -> DrillResult:
    """Return the result with each drive turned along its hole's normal by the rangers.

    Single holes stray from their stated direction, which nothing but the rangers over each hole can see. What was seen
    there joins the trials: at the corrected drive, and at the levelled one.

    Raises:
        InputError, NoResultError: as `drive_onto_references`.
    """
    drives: list[Drive] = []
    trials = list(result.trials)
    for drive in result.drives:
        look = looker(job, result.sensors, command, drive.hole.name)
        corrected = frames.make(drive.rotation, drive.position)
        levelled = turn_upright(look, corrected)
        drives.append(replace(drive, rotation=levelled[:3, :3]))
        for stage, T_base_tool in zip(STAGES[1:], (corrected, levelled), strict=True):
            trials.append(trial_error(drive.hole.name, stage, look(T_base_tool)))
    return replace(result, drives=tuple(drives), trials=tuple(trials))


def _trial_errors(job: DrillJob, sensors: FlangeSensors) -> Iterator[TrialError]:
    """Yield the error of each trial drive; a pin bounds those of levelled ones."""
    trials = job.trials
    if trials is None:
        return
    for row in range(trials.rows):
        ranges = np.array([trials.numbers[name][row] for name in sensors.beams])
        stage = trials.texts["stage"][row]
        pin = None
        if job.pin is not None and stage == STAGES[-1]:
            pin = (float(trials.numbers["diameter"][row]) - job.pin[0], job.pin[1])
        yield trial_error(trials.texts["hole"][row], stage, sensors.see(ranges, trials.stack("u v")[row]), pin)


def _corrected_drive(hole: Hole, T_actual_nominal: Array, tool_axis: ToolAxis | None) -> Drive:
    direction = frames.rotate(T_actual_nominal, hole.direction[None])[0]
    R = hole_rotation(direction)
    position = frames.transform(T_actual_nominal, hole.position[None])[0]
    return Drive(hole, position, direction, R if tool_axis is None else tool_axis.orient(R))


def _measured_hole(job: DrillJob, sensors: FlangeSensors, name: str) -> Array:
    """Return the drive coordinate (3,) of a reference hole from where the robot ended and what it saw there."""
    placed = job.placed[name]
    offset = np.append(sensors.in_plane(placed.uv, placed.height), placed.height - job.height)
    return placed.T_base_tool[:3, 3] + placed.T_base_tool[:3, :3] @ offset


def write_drives(result: DrillResult, file: Path) -> None:
    """Write the holes to drill as CSV: position, angles in degrees, and the shift against the drawing."""
    columns: dict[str, list[str]] = {
        "hole": [drive.hole.name for drive in result.drives],
        "group": [drive.hole.group for drive in result.drives],
    }
    numbers = [[*d.position, *np.degrees(d.angles), *(d.position - d.hole.position)] for d in result.drives]
    names = ("x", "y", "z", "a_deg", "b_deg", "c_deg", "dx", "dy", "dz")
    columns |= {name: [f"{row[i]:.5f}" for row in numbers] for i, name in enumerate(names)}
    write_columns(file, columns)


def drill_document(result: DrillResult) -> dict[str, Any]:
    """Return plain numbers for JSON: lengths in length_unit, angles in degrees."""
    measuring = result.T_measuring_base
    tool = result.tool_axis
    return {
        "homography": result.sensors.H.tolist(),
        "leave_one_out": np.linalg.norm(result.leave_one_out_errors, axis=1).tolist(),
        "groups": {
            name: {
                "T_actual_nominal": c.T_actual_nominal.tolist(),
                "drive_errors": np.linalg.norm(c.errors, axis=1).tolist(),
                "residuals": np.linalg.norm(c.residuals, axis=1).tolist(),
            }
            for name, c in result.groups.items()
        },
        "drives": [
            {
                "hole": d.hole.name,
                "group": d.hole.group,
                "position": d.position.tolist(),
                "direction": d.direction.tolist(),
                "angles_deg": np.degrees(d.angles).tolist(),
            }
            for d in result.drives
        ],
        "rangers": {
            name: {"origin": r.origin.tolist(), "direction": r.direction.tolist(), "rms": r.rms}
            for name, r in result.sensors.beams.items()
        },
        "T_measuring_base": None if measuring is None else measuring.tolist(),
        "tool_axis": tool
        and {
            "axis": tool.axis.tolist(),
            "tilt_deg": float(np.degrees(tool.tilt)),
            "sigma_deg": float(np.degrees(tool.sigma)),
            "p_value": tool.p_value,
            "accepted": tool.accepted,
        },
        "plate": vars(result.plate),
        "trials": [_trial_document(t) for t in result.trials],
        "camera_effects": None if result.sensors.camera is None else list(map(vars, result.sensors.trials)),
    }


def _trial_document(t: TrialError) -> dict[str, Any]:
    angles = {"tilt_deg": t.tilt, "pin_tilt_deg": t.pin_tilt}
    return {
        **{key: value for key, value in vars(t).items() if not key.endswith("tilt")},
        **{key: None if angle is None else float(np.degrees(angle)) for key, angle in angles.items()},
    }


def correction_sentence(result: DrillResult, length_unit: str) -> str:
    """Say what the correction is worth."""
    before = np.concatenate([np.linalg.norm(c.errors, axis=1) for c in result.groups.values()])
    after = np.concatenate([np.linalg.norm(c.residuals, axis=1) for c in result.groups.values()])
    return (
        f"{len(result.drives)} holes to drill in {len(result.groups)} groups. By the drawing the drives miss the "
        f"reference holes by {before.min():.2f} to {before.max():.2f} {length_unit}; after the correction "
        f"{after.max():.2f} {length_unit} at most is left."
    )


def detail_sentences(result: DrillResult, length_unit: str) -> Iterator[str]:
    """Say where the plate lies, what camera and plate are worth, which effects there are, and the trial drives' errors.

    Four holes of the plate leave none to test the camera with.
    """
    plate = result.plate
    yield (
        f"Plate: its holes lie {plate.height:.2f} {length_unit} from the flange, {plate.stated:.2f} stated, and "
        f"parallel to it within {plate.parallelism:.2f} {length_unit}."
    )
    if len(result.leave_one_out_errors):
        sizes = np.linalg.norm(result.leave_one_out_errors, axis=1)
        yield (
            "Hand-eye: each hole of the plate mapped by the others is off by "
            f"{sizes.mean():.3f} {length_unit} on average, {sizes.max():.3f} {length_unit} at most."
        )
    yield from significant_effect_sentences(result, length_unit)
    yield from _absent_effect_sentences(result)
    yield from _trial_sentences(result.trials, length_unit)


def _trial_sentences(trials: tuple[TrialError, ...], length_unit: str) -> Iterator[str]:
    """Say the errors of the trial drives by stage, and what the pin bounds."""
    for stage in STAGES:
        drives = [t for t in trials if t.stage == stage]
        if drives:
            tilts = np.degrees([t.tilt for t in drives])
            yield (
                f"Trial drives, {stage}: 3D {_range_text([t.distance for t in drives])} {length_unit}, 2D "
                f"{_range_text([t.in_plane for t in drives])} {length_unit}, direction {_range_text(tilts)}°."
            )
    bounds = [(t.pin_position, t.pin_tilt) for t in trials if t.pin_position is not None and t.pin_tilt is not None]
    if bounds:
        position, tilt = np.max(bounds, axis=0)
        angle = np.degrees(tilt)
        yield f"The pin went in: position within {position:.2f} {length_unit}, direction within {angle:.2f}°."


def _range_text(values: Any) -> str:
    return f"{np.min(values):.2f} to {np.max(values):.2f} (mean {np.mean(values):.2f})"


def significant_effect_sentences(result: DrillResult, length_unit: str) -> Iterator[str]:
    """Say the effects of camera and tool that are taken out."""
    for trial in result.sensors.trials:
        if trial.accepted:
            yield f"{_camera_effect_sentence(trial, length_unit)} (1 σ; p = {trial.p_value:.1g}). That is taken out."
    if result.tool_axis is not None and result.tool_axis.accepted:
        yield (
            f"The tool's true axis lies {_tool_tilt_sentence(result.tool_axis)} off its frame's z (1 σ); the drives "
            "take it up."
        )


def _absent_effect_sentences(result: DrillResult) -> Iterator[str]:
    """Say the effects of camera and tool that were looked for in vain."""
    for trial in result.sensors.trials:
        if not trial.accepted:
            yield f"{_ABSENT_EFFECTS[trial.effect]} beyond chance (p = {trial.p_value:.1g})."
    if (tool := result.tool_axis) is not None and not tool.accepted:
        yield f"No tilt of the tool's axis beyond chance ({_tool_tilt_sentence(tool)}, 1 σ; p = {tool.p_value:.1g})."


def _camera_effect_sentence(effect_test: CameraEffectTest, length_unit: str) -> str:
    """Say what an effect of the camera is, and its size."""
    if effect_test.effect == "plate_height":
        return (
            f"The plate of holes is {value_uncertainty_text(effect_test.value, effect_test.sigma)} {length_unit} off "
            "its stated height"
        )
    size = value_uncertainty_text(100 * effect_test.value, 100 * effect_test.sigma)
    return f"The lens shifts the image's corners by {size} % of their way from its middle"


def _tool_tilt_sentence(tool: ToolAxis) -> str:
    return f"{np.degrees(tool.tilt):.2f} ± {np.degrees(tool.sigma):.2f}°"


def hole_session(job: DrillJob, result: DrillResult) -> SessionFiles:
    """Return one view for each reference hole; the sensors' frame is the flange's, and the drawing gives the targets.

    The sigma is what leaving one hole of the plate out says of the camera; the rangers' height has none of its own.
    """
    T_tool_flange = frames.make(np.eye(3), np.array([0.0, 0.0, -job.height]))
    names = tuple(job.placed)
    tools = job.placed.values()
    views = [f"at-{name}" for name in names]
    T_base_flange = np.array([tool.T_base_tool @ T_tool_flange for tool in tools])
    places = [np.append(result.sensors.in_plane(tool.uv, tool.height), tool.height) for tool in tools]
    errors = result.leave_one_out_errors
    sigma = np.full(len(names), np.sqrt((errors**2).mean())) if len(errors) else None
    return SessionFiles(
        name="drilling",
        length_unit=job.length_unit,
        mount="eye_in_hand",
        tables={"scanner": {"pose": np.eye(4).tolist()}},
        views={"view": views, **pose_columns(T_base_flange)},
        points=points_table(views, names, np.array(places), sigma),
        targets={hole.name: hole.position for hole in job.holes if hole.name in names},
    )


def run_drill(file: Path, servo: str | None, wanted: Wanted) -> None:
    """Solve a job and hand out what was asked for; `InputError` and `NoResultError` end it.

    Args:
        servo: command that drives the tool and reads the sensors; None: the job's tables say where it was.
    """
    job = read_drill_job(file, driven=servo is not None)
    if servo is not None:
        job = drive_onto_references(job, servo)
    result = solve_drill_job(job)
    if servo is not None:
        result = make_drives_upright(job, result, servo)
    if wanted.output is not None:
        write_drives(result, wanted.output)
    if not hand_out("drill", wanted, lambda: [hole_session(job, result)], lambda: drill_document(result), job, result):
        return
    unit = job.length_unit
    say(correction_sentence(result, unit))
    for line in detail_sentences(result, unit):
        say(line)
    if result.sensors.beams:
        show_table(
            "Beams of the range sensors, in the frame of the flange",
            ("sensor", f"origin x y z / {unit}", "direction", f"rms / {unit}"),
            [
                (name, fixed_digits(beam.origin, 3), fixed_digits(beam.direction, 4), f"{beam.rms:.3f}")
                for name, beam in result.sensors.beams.items()
            ],
        )
    show_table(
        "Drives: T_base_tool, angles about z, y', x''",
        ("hole", "group", f"x y z / {unit}", "a b c / °", f"shift / {unit}"),
        [
            (
                drive.hole.name,
                drive.hole.group,
                fixed_digits(drive.position, 3),
                fixed_digits(np.degrees(drive.angles), 3),
                f"{np.linalg.norm(drive.position - drive.hole.position):.3f}",
            )
            for drive in result.drives
        ],
    )
    if wanted.output is not None:
        print(wanted.output)
