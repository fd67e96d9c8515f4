"""`stitch drill`: a drilling job from its readings to the corrected drives."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from stitch.errors import InputError, NoResultError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.units import METRES, value_uncertainty_text
from stitch.output.session_files import SessionFiles, pose_columns
from stitch.plugins.cells.drill_checks import (
    STAGES,
    PlatePlace,
    TrialError,
    holes_in_flange,
    plate_place,
    read_pin,
    read_trials,
    trial_error,
)
from stitch.plugins.cells.drilling_sensors import (
    CameraEffectTest,
    EffectSelection,
    GroupCompensation,
    HoleObservations,
    RangerFit,
    ToolAxis,
    base_frame,
    compensate_group,
    euler_zyx,
    find_tool_axis,
    fit_homography,
    fit_ranger,
    hole_at_tool,
    hole_rotation,
    holes_of_plate,
    leave_one_out,
    select_effects,
    to_plane,
)
from stitch.plugins.cells.job_files import (
    POSE_COLUMNS,
    CsvColumns,
    JobTable,
    Wanted,
    fixed_digits,
    hand_out,
    points_table,
    poses_from_columns,
    read_columns,
    read_job_file,
    require_unique,
    write_columns,
)
from stitch.session.reading.csv_files import read_csv_lines

DRILL_FORMAT = "stitch-drill/1"
_FILES = {"plate", "plate_image", "holes", "placed", "rangers", "joint1", "joint6", "checks", "locating", "trials"}
_KEYS = {"format", "length_unit", "height", "image_size", "home", "joint6_height", "pin", *_FILES}
# Cosine of the largest angle between tool and hole that a small error explains.
_ALONG = float(np.cos(np.radians(30)))
_NEEDED = ("plate", "holes", "placed")
_ABSENT_EFFECTS = {"plate_height": "No error of the plate's height", "k1": "No distortion of the lens"}


@dataclass(frozen=True)
class Hole:
    """One hole as the part's drawing puts it in the base frame."""

    name: str
    group: str
    reference: bool
    position: Array  # (3,)
    direction: Array  # (3,) unit vector into the part


@dataclass(frozen=True)
class PlacedTool:
    """Where the servo loop ended on a reference hole, and what the camera and the rangers saw there."""

    T_base_tool: Array  # (4, 4) reported
    uv: Array  # (2,) pixels
    height: float  # of the hole along the flange's z, h' of the source


@dataclass(frozen=True)
class DrillJob:
    """Everything of one drilling job. Lengths in length_unit."""

    length_unit: str
    height: float
    plate_xyz: Array  # (N, 3) flange frame
    plate_uv: Array  # (N, 2)
    holes: tuple[Hole, ...]
    placed: dict[str, PlacedTool]  # by the reference hole
    rangers: dict[str, tuple[Array, Array]]  # planes (M, 4), readings (M,)
    marker_paths: tuple[Array, Array] | None  # joint 6, joint 1, in the measuring system
    checks: HoleObservations | None  # plate and check holes together
    joint6_height: float = 0.0  # of the axis of joint 6 above the base's origin
    locating_rms: float | None = None  # of the plate's locating holes; None: the plate is given in the flange frame
    trials: CsvColumns | None = None
    pin: tuple[float, float] | None = None  # diameter, feed
    file: Path | None = None  # that was read


def read_drill_job(file: Path | str) -> DrillJob:
    """Read a job file and the tables it names, whose paths are relative to it.

    Raises:
        InputError: anything missing, unknown, contradictory or not a number; names the file, the place and what to do.
    """
    file = Path(file)
    document = read_job_file(file, DRILL_FORMAT, _KEYS, "examples/drilling/job.toml")
    paths = {key: document.path(key) for key in _FILES if key in document}
    for key in _NEEDED:
        if key not in paths:
            raise InputError(f"{file}: {key} is missing; to fix: name the CSV file")
    plate_xyz, plate_uv = _read_plate(paths["plate"], paths.get("plate_image"))
    marker_paths = _read_marker_paths(file, paths)
    joint6_height = document.number("joint6_height", 0.0)
    locating_rms = None
    if "locating" in paths:
        if marker_paths is None or "home" not in document:
            raise InputError(f"{file}: locating goes with joint1, joint6 and [home]; to fix: add them")
        try:
            T_measuring_base = base_frame(*marker_paths, joint6_height)
        except NoResultError as error:
            raise InputError(f"{file}: {error}") from None
        T_measuring_flange = T_measuring_base @ document.pose("home")
        plate_xyz, locating_rms = holes_in_flange(paths["locating"], plate_xyz, T_measuring_flange)
    holes = _read_holes(paths["holes"])
    pin = read_pin(document)
    rangers = _read_ranger_tables(paths["rangers"]) if "rangers" in paths else {}
    return DrillJob(
        length_unit=document.choice("length_unit", METRES),
        height=document.number("height", positive=True),
        plate_xyz=plate_xyz,
        plate_uv=plate_uv,
        holes=holes,
        placed=_read_placed_tools(paths["placed"], holes, plate_xyz, plate_uv),
        rangers=rangers,
        marker_paths=marker_paths,
        checks=_read_check_holes(document, paths["checks"], plate_xyz, plate_uv) if "checks" in paths else None,
        joint6_height=joint6_height,
        locating_rms=locating_rms,
        trials=read_trials(paths["trials"], tuple(rangers), pin is not None) if "trials" in paths else None,
        pin=pin,
        file=file,
    )


def _read_plate(file: Path, picture: Path | None) -> tuple[Array, Array]:
    """Read the plate's holes, flange frame (N, 3) and pixels (N, 2); with a picture, pixels come from there."""
    if picture is None:
        plate = read_columns(file, "", "x y z u v")
        return plate.stack("x y z"), plate.stack("u v")
    xyz = read_columns(file, "", "x y z").stack("x y z")
    uv = holes_of_plate(picture)
    if len(xyz) != len(uv):
        raise InputError(f"{file}: has {len(xyz)} rows; to fix: with plate_image, list the {len(uv)} holes it shows")
    return xyz, uv


def _read_holes(file: Path) -> tuple[Hole, ...]:
    table = read_columns(file, "hole group kind", "x y z i j k")
    rows = zip(*table.texts.values(), table.stack("x y z"), table.stack("i j k"), strict=True)
    holes: list[Hole] = []
    for name, group, kind, position, direction in rows:
        size = np.linalg.norm(direction)
        if abs(size - 1) > 0.01:
            raise InputError(
                f"{file}: direction of hole {name} has length {size:.4f}; to fix: write i, j, k as a unit vector"
            )
        if kind not in ("reference", "drill"):
            raise InputError(f"{file}: kind of hole {name} is {kind!r}; to fix: write reference or drill")
        holes.append(Hole(name, group, kind == "reference", position, direction / size))
    for (name, group), count in Counter((hole.name, hole.group) for hole in holes).items():
        if count > 1:
            raise InputError(f"{file}: hole {name} stands twice in group {group}; to fix: leave one of them out")
    return tuple(holes)


def _read_placed_tools(file: Path, holes: tuple[Hole, ...], plate_xyz: Array, plate_uv: Array) -> dict[str, PlacedTool]:
    """Read where the tool ended; a column image in place of u and v names a picture of each hole."""
    header, _ = read_csv_lines(file)
    if "image" in header and "u" not in header:
        table = read_columns(file, "hole image", f"{POSE_COLUMNS} height")
        H = fit_homography(plate_xyz[:, :2], plate_uv)
        pixels = np.array([hole_at_tool(file.parent / name, H) for name in table.texts["image"]])
    else:
        table = read_columns(file, "hole", f"{POSE_COLUMNS} u v height")
        pixels = table.stack("u v")
    poses = poses_from_columns(table)
    names = table.texts["hole"]
    require_unique(file, "hole", names)
    for hole in holes:
        if hole.reference and hole.name not in names:
            raise InputError(f"{file}: reference hole {hole.name} is missing; to fix: add where the robot ended on it")
        if hole.reference and poses[names.index(hole.name), :3, 2] @ hole.direction < _ALONG:
            raise InputError(
                f"{file}: on hole {hole.name} the tool's z lies more than 30° off the hole's direction; to fix: let "
                "directions point into the part, and a, b, c turn about z, y', x''"
            )
    tools = map(PlacedTool, poses, pixels, table.numbers["height"].tolist())
    return dict(zip(names, tools, strict=True))


def _read_ranger_tables(file: Path) -> dict[str, tuple[Array, Array]]:
    table = read_columns(file, "ranger", "a b c d reading")
    planes = table.stack("a b c d")
    readings = table.numbers["reading"]
    names = np.array(table.texts["ranger"])
    if (np.linalg.norm(planes[:, :3], axis=1) == 0).any():
        raise InputError(f"{file}: a plane has a = b = c = 0; to fix: write its normal there")
    return {str(name): (planes[names == name], readings[names == name]) for name in dict.fromkeys(names)}


def _read_marker_paths(file: Path, paths: dict[str, Path]) -> tuple[Array, Array] | None:
    if ("joint1" in paths) != ("joint6" in paths):
        raise InputError(f"{file}: joint1 and joint6 belong together; to fix: name both marker paths or neither")
    if "joint1" not in paths:
        return None
    joint6, joint1 = (read_columns(paths[key], "", "x y z").stack("x y z") for key in ("joint6", "joint1"))
    return joint6, joint1


def _read_check_holes(document: JobTable, file: Path, plate_xyz: Array, plate_uv: Array) -> HoleObservations:
    """Read holes of the plate and check holes together."""
    width, height = document.vectors("image_size", (2,), "[width, height] in pixels, which the checks need").tolist()
    if min(width, height) <= 0:
        raise document.refusal("image_size", "write numbers above zero")
    checks = read_columns(file, "", "x y z u v")
    return HoleObservations(
        xyz=np.vstack([plate_xyz, checks.stack("x y z")]),
        uv=np.vstack([plate_uv, checks.stack("u v")]),
        on_plate=np.repeat([True, False], [len(plate_xyz), checks.rows]),
        image_size=(width, height),
    )


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

    H: Array  # (3, 3) work plane to image
    leave_one_out_errors: Array  # (N, 2) of the plate's holes, in the work plane
    groups: dict[str, GroupCompensation]
    drives: tuple[Drive, ...]
    rangers: dict[str, RangerFit]
    T_measuring_base: Array | None
    effects: EffectSelection | None  # of the camera; None without check holes
    tool_axis: ToolAxis | None
    plate: PlatePlace
    trials: tuple[TrialError, ...]


def solve_drill_job(job: DrillJob) -> DrillResult:
    """Return homography, compensation of every group, and what else the job holds readings for.

    What the check holes show of the camera is taken out of the reference holes' places.

    Raises:
        NoResultError: a step has too few or degenerate readings; names the step.
    """
    xy = job.plate_xyz[:, :2]
    H = fit_homography(xy, job.plate_uv)
    effects = select_effects(job.checks) if job.checks is not None else None
    groups: dict[str, GroupCompensation] = {}
    for group in dict.fromkeys(hole.group for hole in job.holes):
        references = [hole for hole in job.holes if hole.group == group and hole.reference]
        if len(references) < 3:
            raise NoResultError(f"group {group}: {len(references)} reference holes; to fix: give it three or more")
        actual = np.array([_measured_hole(job, H, effects, hole.name) for hole in references])
        groups[group] = compensate_group(np.array([hole.position for hole in references]), actual)
    # The tool's axis from each reference hole once, whatever number of groups it serves.
    once = {hole.name: hole for hole in job.holes if hole.reference}
    tool_axis = find_tool_axis(
        np.array([job.placed[name].T_base_tool[:3, :3] for name in once]),
        np.array([groups[h.group].T_actual_nominal[:3, :3] @ h.direction for h in once.values()]),
    )
    rangers = {name: fit_ranger(*readings) for name, readings in job.rangers.items()}
    trials: list[TrialError] = []
    if job.trials is not None:
        in_plane = partial(hole_in_plane, H, effects)
        rows = range(job.trials.rows)
        trials = [trial_error(job.trials, row, rangers, in_plane, job.height, job.pin) for row in rows]
    return DrillResult(
        H,
        leave_one_out_errors=leave_one_out(xy, job.plate_uv) if len(xy) > 4 else np.empty((0, 2)),
        groups=groups,
        drives=tuple(_corrected_drive(hole, groups[hole.group], tool_axis) for hole in job.holes if not hole.reference),
        rangers=rangers,
        T_measuring_base=base_frame(*job.marker_paths, job.joint6_height) if job.marker_paths else None,
        effects=effects,
        tool_axis=tool_axis,
        plate=plate_place(job.plate_xyz, job.height, job.locating_rms),
        trials=tuple(trials),
    )


def _corrected_drive(hole: Hole, group: GroupCompensation, tool_axis: ToolAxis | None) -> Drive:
    positions, directions = group.apply(hole.position[None], hole.direction[None])
    R = hole_rotation(directions[0])
    return Drive(hole, positions[0], directions[0], R if tool_axis is None else tool_axis.orient(R))


def _measured_hole(job: DrillJob, H: Array, effects: EffectSelection | None, name: str) -> Array:
    """Return the drive coordinate (3,) of a reference hole from where the robot ended and what it saw there."""
    placed = job.placed[name]
    offset = np.append(hole_in_plane(H, effects, placed.uv, placed.height), placed.height - job.height)
    return placed.T_base_tool[:3, 3] + placed.T_base_tool[:3, :3] @ offset


def hole_in_plane(H: Array, effects: EffectSelection | None, uv: Array, height: float) -> Array:
    """Return x, y (2,) in the flange frame of a hole that the camera saw at uv (2,).

    Where check holes have shown the camera beyond its work plane, at the hole's own height and without the effects that
    were selected; else as if the hole lay in the work plane: a camera tilted by 25° is then off by 0.47 mm for each mm.
    """
    if effects is not None:
        return effects.camera.plane(uv[None], height)[0]
    return to_plane(H, uv[None])[0]


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
        "homography": result.H.tolist(),
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
            for name, r in result.rangers.items()
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
        "camera_effects": result.effects and [vars(trial) for trial in result.effects.trials],
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
    for trial in result.effects.trials if result.effects else ():
        if trial.accepted:
            yield f"{_camera_effect_sentence(trial, length_unit)} (1 σ; p = {trial.p_value:.1g}). That is taken out."
    if result.tool_axis is not None and result.tool_axis.accepted:
        yield (
            f"The tool's true axis lies {_tool_tilt_sentence(result.tool_axis)} off its frame's z (1 σ); the drives "
            "take it up."
        )


def _absent_effect_sentences(result: DrillResult) -> Iterator[str]:
    """Say the effects of camera and tool that were looked for in vain."""
    for trial in result.effects.trials if result.effects else ():
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
    places = [np.append(hole_in_plane(result.H, result.effects, tool.uv, tool.height), tool.height) for tool in tools]
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


def run_drill(file: Path, wanted: Wanted) -> None:
    """Solve a job and hand out what was asked for; `InputError` and `NoResultError` end it."""
    job = read_drill_job(file)
    result = solve_drill_job(job)
    if wanted.output is not None:
        write_drives(result, wanted.output)
    terminal = hand_out(
        "drill", wanted, lambda: [hole_session(job, result)], lambda: drill_document(result), job, result
    )
    if terminal is None:
        return
    unit = job.length_unit
    terminal.print(correction_sentence(result, unit))
    for line in detail_sentences(result, unit):
        terminal.print(line)
    if result.rangers:
        beams = Table(title="Beams of the range sensors, in the frame of the flange", title_justify="left")
        for heading in ("sensor", f"origin x y z / {unit}", "direction", f"rms / {unit}"):
            beams.add_column(heading)
        for name, beam in result.rangers.items():
            beams.add_row(name, fixed_digits(beam.origin, 3), fixed_digits(beam.direction, 4), f"{beam.rms:.3f}")
        terminal.print(beams)
    headings = ("hole", "group", f"x y z / {unit}", "a b c / °", f"shift / {unit}")
    table = Table(*headings, title="Drives: T_base_tool, angles about z, y', x''", title_justify="left")
    for drive in result.drives:
        shift = float(np.linalg.norm(drive.position - drive.hole.position))
        angles = fixed_digits(np.degrees(drive.angles), 3)
        table.add_row(drive.hole.name, drive.hole.group, fixed_digits(drive.position, 3), angles, f"{shift:.3f}")
    terminal.print(table)
    if wanted.output is not None:
        print(wanted.output)
