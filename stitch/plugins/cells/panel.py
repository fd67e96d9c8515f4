"""`stitch panel`: a panel job from its readings to the commands of all robots."""

import sys
from collections import Counter
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from stitch.cli.terminal import say, show_table
from stitch.errors import InputError, NoResultError
from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices
from stitch.output.session_files import SessionFiles, pose_columns
from stitch.plugins.cells.job_files import (
    POSE_COLUMNS,
    CsvColumns,
    JobTable,
    Wanted,
    hand_out,
    points_table,
    poses_from_columns,
    poses_from_rows,
    read_columns,
    read_job_file,
    rows_from_poses,
    write_columns,
    write_pictures,
    write_poses,
)
from stitch.plugins.cells.panel_model import (
    ClampLayout,
    Contacts,
    ControlPoints,
    LaserTracker,
    LegOffset,
    Legs,
    MotionErrors,
    ReflectorReadings,
    RigidFit,
    RobotModel,
    ShapeStep,
    adjust_pose,
    calibrate_robot,
    clamp_contacts,
    errors_along_motion,
    errors_by_master,
    find_leg_offset,
    largest_deviations,
    leg_lengths,
    preposition,
    rigid_fit,
    shape_step,
    true_flanges,
)
from stitch.system.programs import call_program

# Twice a triangle's area against the sum of two squared sides: below, it is a line.
_FLAT = 1e-3
PANEL_FORMAT = "stitch-panel/1"
_KEYS = {"format", "robots", "master", "target", "layout", "tracker", "shape", "legs", "limits", "files"}
_AXES = ("rx", "ry", "rz", "x", "y", "z")
_FILES = {"calibration", "flanges", "targets", "control", "forces", "world"}
_LAYOUT = ("radius", "clamp_width", "spacing", "clamp_height", "edge", "length")
# A panel that follows its clamps needs one or two.
_MOST_CORRECTIONS = 10
# The source moves 100 mm and turns 2°.
_DISTANCES = np.linspace(0.0, 100.0, 11)
_ANGLES = np.radians(np.linspace(0.0, 2.0, 11))
# A likelihood ratio of 100 is a chi-square of 9.2.
_CLEAR = 9.2
_REFLECTORS = ("r1", "r2", "r3")


@dataclass(frozen=True)
class PanelPoints:
    """Targets on the panel and where the tracker sees them, mm."""

    names: list[str]
    nominal: Array  # (K, 3) panel frame
    measured: Array  # (K, 3) world frame
    clamp: Indices  # (K,) index of the robot; −1 where the file has none


def read_calibration(
    file: Path, names: tuple[str, ...], tracker: LaserTracker, T_world_tracker: Array
) -> tuple[ReflectorReadings, ...]:
    """Read each robot's poses and reflectors; the tracker's readings are brought into the world.

    Raises:
        InputError: a column or robot is missing, or reflectors lie on one line.
    """
    columns = _read_robots(file, names, "robot", f"{POSE_COLUMNS} x1 y1 z1 x2 y2 z2 x3 y3 z3")
    poses = poses_from_columns(columns)
    reflectors = columns.stack("x1 y1 z1 x2 y2 z2 x3 y3 z3").reshape(-1, 3, 3)
    reflectors = frames.transform(T_world_tracker, reflectors)
    robot = np.array(columns.texts["robot"])
    sides = reflectors[:, 1:] - reflectors[:, :1]
    flat = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) < _FLAT * (sides**2).sum(axis=(1, 2))
    if flat.any():
        raise InputError(
            f"{file}: data row {np.argmax(flat) + 1}: the reflectors lie on one line; to fix: read them again"
        )
    readings = []
    for name in names:
        rows = robot == name
        if not rows.any():
            raise InputError(f"{file}: robot {name} has no row; to fix: measure its poses, or leave it out of the job")
        readings.append(ReflectorReadings(name, poses[rows], reflectors[rows], tracker.sigma(reflectors[rows])))
    return tuple(readings)


def read_per_robot(file: Path, names: tuple[str, ...], column_names: str) -> Array:
    """Read (N, k), one row of numbers for each robot, in the order of `names`.

    Raises:
        InputError: a column is missing, or a robot is missing, unknown or there twice.
    """
    columns = _read_robots(file, names, "robot", column_names)
    robots = columns.texts["robot"]
    counts = Counter(robots)
    for name in names:
        if counts[name] != 1:
            raise InputError(f"{file}: robot {name} stands in {counts[name]} rows; to fix: give each robot one")
    return columns.stack(column_names)[[robots.index(name) for name in names]]


def read_panel_points(file: Path, robots: tuple[str, ...] | None, T_world_tracker: Array) -> PanelPoints:
    """Read targets (robots None) or control points, which name the robot whose clamp they lie beside.

    Raises:
        InputError: a column is missing, a robot unknown or without a point.
    """
    numbers = "x y z seen_x seen_y seen_z"
    columns = _read_robots(file, robots, "point robot", numbers) if robots else read_columns(file, "point", numbers)
    clamp = np.array([robots.index(name) for name in columns.texts["robot"]] if robots else [-1] * columns.rows)
    for name in robots or ():
        if name not in columns.texts["robot"]:
            raise InputError(f"{file}: robot {name} has no control point; to fix: measure one or more beside its clamp")
    measured = frames.transform(T_world_tracker, columns.stack("seen_x seen_y seen_z"))
    return PanelPoints(columns.texts["point"], columns.stack("x y z"), measured, clamp)


def read_world(file: Path, tracker: LaserTracker) -> Array:
    """Return T_world_tracker (4, 4) from reference points; the tracker sits at its own frame's origin.

    Raises:
        InputError: a column is missing, the points fix no frame, or one contradicts the others.
    """
    columns = read_columns(file, "point", "x y z seen_x seen_y seen_z")
    measured = columns.stack("seen_x seen_y seen_z")
    sigma = replace(tracker, position=np.zeros(3)).sigma(measured)
    try:
        fit = rigid_fit(columns.stack("x y z"), measured, sigma)
    except NoResultError as error:
        raise InputError(f"{file}: {error}") from None
    sizes = np.linalg.norm(fit.residuals, axis=1)
    worst = int(np.argmax(sizes))
    # With few points much of an error hides in the fit; ten sigmas beyond it are no noise.
    if sizes[worst] > 10 * np.sqrt(3) * sigma[worst]:
        name = columns.texts["point"][worst]
        raise InputError(f"{file}: point {name} is {sizes[worst]:.3f} mm off the others; to fix: measure it anew")
    return frames.inverse(fit.T)


def _read_robots(file: Path, names: tuple[str, ...], texts: str, numbers: str) -> CsvColumns:
    columns = read_columns(file, texts, numbers)
    for name in columns.texts["robot"]:
        if name not in names:
            raise InputError(
                f"{file}: robot {name!r} is not in the job's robots {', '.join(names)}; to fix: correct its name"
            )
    return columns


@dataclass(frozen=True)
class PanelJob:
    """What a panel cell has measured. Lengths in mm, forces in N; robots row by row as the layout counts clamps."""

    robots: tuple[str, ...]
    master: int
    T_world_target: Array  # (4, 4)
    layout: ClampLayout
    tracker: LaserTracker
    tolerance: float  # of the shape, mm
    axes: Array  # (6,) bool, driven axes of shape control: turns about x, y, z, then x, y, z
    legs: Legs | None
    calibration: tuple[ReflectorReadings, ...]
    flanges: Array | None  # (N, 4, 4) where the controllers believe the flanges are
    targets: PanelPoints | None
    control: PanelPoints | None
    forces: Array | None  # (N, 6) change of torques and forces
    force_limit: float = np.inf  # N, at any clamp
    torque_limit: float = np.inf  # N m
    file: Path | None = None  # that was read


def read_panel_job(file: Path | str) -> PanelJob:
    """Read and check a panel job.

    Raises:
        InputError: a file is missing or malformed; an entry is missing, unknown, not a number or impossible.
    """
    file = Path(file)
    document = read_job_file(file, PANEL_FORMAT, _KEYS, "examples/panel/job.toml")
    robots = document.entries.get("robots")
    if not isinstance(robots, list) or len(robots) < 2 or not all(isinstance(r, str) for r in robots):
        raise document.refusal("robots", "list the robots' names, row by row")
    if len(set(robots)) != len(robots) or len(robots) % 2:
        raise InputError(
            f"{file}: robots has an odd number of names or one twice; to fix: list half of them for each row"
        )
    names = tuple(robots)
    paths = _file_paths(document.table("files", _FILES, required=True))
    settings = document.table("tracker", {"position", "constant", "per_length"}, required=True)
    tracker = LaserTracker(
        settings.vectors("position", (3,), "[x, y, z] in mm"),
        constant=settings.number("constant", 0.010, positive=True),
        per_length=settings.number("per_length", 5e-6, positive=True),
    )
    T_world_tracker = np.eye(4)
    if "world" in paths:
        T_world_tracker = read_world(paths["world"], tracker)
        tracker = replace(tracker, position=T_world_tracker[:3, 3])
    tolerance, axes = _read_shape(document.table("shape", {"tolerance", "axes"}))
    flanges = read_per_robot(paths["flanges"], names, POSE_COLUMNS) if "flanges" in paths else None
    limits = document.table("limits", ("force_N", "torque_Nm"))
    if limits.entries and "forces" not in paths:
        raise InputError(f"{file}: [limits] goes with files.forces; to fix: name the table of the sensors' changes")
    return PanelJob(
        robots=names,
        master=names.index(document.choice("master", names)),
        T_world_target=document.pose("target"),
        layout=_read_layout(document.table("layout", _LAYOUT, required=True), len(names) // 2),
        tracker=tracker,
        tolerance=tolerance,
        axes=axes,
        legs=_read_legs(document.table("legs", {"base", "platform"})) if "legs" in document else None,
        calibration=read_calibration(paths["calibration"], names, tracker, T_world_tracker),
        flanges=None if flanges is None else poses_from_rows(flanges),
        targets=read_panel_points(paths["targets"], None, T_world_tracker) if "targets" in paths else None,
        control=read_panel_points(paths["control"], names, T_world_tracker) if "control" in paths else None,
        forces=read_per_robot(paths["forces"], names, "tx ty tz fx fy fz") if "forces" in paths else None,
        force_limit=limits.number("force_N", positive=True) if "force_N" in limits else np.inf,
        torque_limit=limits.number("torque_Nm", positive=True) if "torque_Nm" in limits else np.inf,
        file=file,
    )


def _read_layout(entries: JobTable, columns: int) -> ClampLayout:
    layout = ClampLayout(columns=columns, **{key: entries.number(key, positive=True) for key in _LAYOUT})
    try:
        clamp_contacts(layout)
    except InputError as error:
        raise InputError(f"{entries.file}: {error}") from None
    return layout


def _read_shape(entries: JobTable) -> tuple[float, Array]:
    """Read the tolerance, and which of the six axes are driven."""
    axes = entries.entries.get("axes", ["rx", "ry", "z"])
    if not isinstance(axes, list) or not axes:
        raise entries.refusal("axes", f"list some of {', '.join(_AXES)}")
    for axis in axes:
        if axis not in _AXES:
            raise InputError(f"{entries.file}: shape.axes is {axis!r}; to fix: write one of {', '.join(_AXES)}")
    return entries.number("tolerance", 0.6, positive=True), np.array([axis in axes for axis in _AXES])


def _read_legs(entries: JobTable) -> Legs:
    legs = {key: entries.vectors(key, (6, 3), "6 points [x, y, z] in mm") for key in ("base", "platform")}
    for name, joints in legs.items():
        if np.linalg.matrix_rank(joints - joints.mean(axis=0), tol=1e-3) < 2:
            raise InputError(
                f"{entries.file}: legs.{name}: the six joints lie on one line; to fix: give them in mm, leg by leg"
            )
    return Legs(**legs)


def _file_paths(entries: JobTable) -> dict[str, Path]:
    if "calibration" not in entries:
        raise InputError(
            f"{entries.file}: files.calibration is missing; to fix: name the table of the robots' calibration"
        )
    for name in ("targets", "control"):
        if name in entries and "flanges" not in entries:
            raise InputError(
                f"{entries.file}: files.{name} is without files.flanges; to fix: add where the robots stood then"
            )
    return {key: entries.path(key) for key in entries.entries}


@dataclass(frozen=True)
class PanelResult:
    """Everything a job gives; commands are poses for the controllers, which do not know of leg offsets."""

    contacts: Contacts
    models: tuple[RobotModel, ...]
    legs: tuple[LegOffset, ...]  # empty without the legs' joints
    preposition: Array  # (N, 4, 4)
    # Errors to expect of the slaves against the master, from the global model's covariance.
    shift_errors: MotionErrors
    turn_errors: MotionErrors
    errors_by_master: Array  # (N, 2) worst of a slave, mm, after the longest shift and turn, if robot N were master
    pose: RigidFit | None  # T_world_panel
    pose_error: Array | None  # (6,) twist from target to measured pose, panel frame
    pose_commands: Array | None  # (N, 4, 4)
    shape: ShapeStep | None
    shape_largest: Array | None  # (N,) mm
    shape_commands: Array | None  # (N, 4, 4)


def calibrate_robots(job: PanelJob) -> tuple[tuple[RobotModel, ...], tuple[LegOffset, ...]]:
    """Return models of all robots; those in which a leg offset is found are calibrated anew without it.

    Raises:
        NoResultError: a robot has too few poses, or turned about one axis only.
    """
    models = []
    offsets = []
    for readings in job.calibration:
        model = calibrate_robot(readings)
        if job.legs is not None:
            offset = find_leg_offset(readings, model, job.legs, 6 * len(job.robots))
            offsets.append(offset)
            if offset.found:
                real = true_flanges(job.legs, readings.T_base_flange, [(offset.leg, offset.offset)])
                model = calibrate_robot(replace(readings, T_base_flange=real))
        models.append(model)
    return tuple(models), tuple(offsets)


def solve_panel_job(job: PanelJob) -> PanelResult:
    """Return model, pre-positions and errors to expect; pose and shape corrections where the job has their readings.

    Raises:
        NoResultError: a step has too few or degenerate readings; names the step.
    """
    _require_forces_within_limits(job)
    models, offsets = calibrate_robots(job)
    bases = np.array([model.T_world_base for model in models])
    clamps = np.array([model.T_flange_contact for model in models])
    # What to tell the controllers so that the flanges really come there; first order in a leg's offset.
    commands_for = partial(_flanges_with_offsets, job, offsets, sign=-1.0)
    layout = clamp_contacts(job.layout)
    before = preposition(bases, job.T_world_target, layout.T_panel_contact, clamps)
    stand = before if job.flanges is None else _flanges_with_offsets(job, offsets, job.flanges)
    shift_errors = errors_along_motion(models, stand, job.master, _DISTANCES, turn=False)
    turn_errors = errors_along_motion(models, stand, job.master, _ANGLES, turn=True)
    by_master = errors_by_master(models, stand, float(_DISTANCES[-1]), float(_ANGLES[-1]))
    pose = pose_error = pose_commands = shape = shape_largest = shape_commands = None
    T_world_panel = job.T_world_target
    if job.targets is not None:
        pose = rigid_fit(job.targets.nominal, job.targets.measured, job.tracker.sigma(job.targets.measured))
        T_world_panel = pose.T
        pose_error = frames.log(frames.inverse(job.T_world_target) @ pose.T)
        stand = adjust_pose(bases, stand, job.master, pose.T, job.T_world_target)
        pose_commands = commands_for(stand)
    if job.control is not None:
        # With targets, the shape is evaluated on the panel where it was measured and corrected where it goes.
        measured = frames.transform(frames.inverse(T_world_panel), job.control.measured)
        control = ControlPoints(job.control.nominal, job.control.clamp, layout.T_panel_contact)
        shape = shape_step(measured, control, stand, clamps, axes=job.axes)
        shape_largest = largest_deviations(shape.deviations, control)
        shape_commands = commands_for(shape.T_base_flange)
    return PanelResult(
        contacts=layout,
        models=models,
        legs=offsets,
        preposition=commands_for(before),
        shift_errors=shift_errors,
        turn_errors=turn_errors,
        errors_by_master=by_master,
        pose=pose,
        pose_error=pose_error,
        pose_commands=pose_commands,
        shape=shape,
        shape_largest=shape_largest,
        shape_commands=shape_commands,
    )


def _require_forces_within_limits(job: PanelJob) -> None:
    """Refuse to give commands while a clamp pulls harder than it may.

    Raises:
        NoResultError: names the clamp.
    """
    if job.forces is None:
        return
    for what, sizes, limit, unit in (
        ("force", np.linalg.norm(job.forces[:, 3:], axis=1), job.force_limit, "N"),
        ("torque", np.linalg.norm(job.forces[:, :3], axis=1) / 1000, job.torque_limit, "N m"),
    ):
        worst = int(np.argmax(sizes))
        if sizes[worst] > limit:
            raise NoResultError(
                f"the {what} at clamp {job.robots[worst]} has changed by {sizes[worst]:.1f} {unit}, its limit is "
                f"{limit:g} {unit}. No robot is told to move; to fix: release that clamp and lay the panel anew"
            )


def _flanges_with_offsets(job: PanelJob, offsets: tuple[LegOffset, ...], believed: Array, sign: float = 1.0) -> Array:
    """Return where the flanges (N, 4, 4) really are when the controllers believe them at `believed`."""
    real = believed.copy()
    for i, offset in enumerate(offsets):
        if offset.found and job.legs is not None:
            real[i] = true_flanges(job.legs, believed[i : i + 1], [(offset.leg, sign * offset.offset)])[0]
    return real


def panel_document(job: PanelJob, result: PanelResult) -> dict[str, Any]:
    """Return plain data for JSON. mm, degrees, N."""
    document: dict[str, Any] = {
        "robots": {m.name: _robot_document(m) for m in result.models},
        "leg_offsets": {o.robot: {key: value for key, value in vars(o).items() if key != "robot"} for o in result.legs},
        "errors": {
            "after_100_mm": result.shift_errors.position[:, -1].max(axis=0).tolist(),
            "after_2_deg": result.turn_errors.position[:, -1].max(axis=0).tolist(),
            "by_master": dict(zip(job.robots, result.errors_by_master.tolist(), strict=True)),
        },
    }
    if result.pose is not None and result.pose_error is not None:
        sigma = np.sqrt(np.diag(result.pose.covariance))
        document["pose"] = {
            "position_error": result.pose_error[3:].tolist(),
            "angle_error_deg": np.degrees(result.pose_error[:3]).tolist(),
            "sigma": sigma[3:].tolist(),
            "sigma_deg": np.degrees(sigma[:3]).tolist(),
            "targets_rms": float(np.sqrt((result.pose.residuals**2).mean())),
        }
    if result.shape_largest is not None:
        deviation = dict(zip(job.robots, result.shape_largest.tolist(), strict=True))
        ok = bool(result.shape_largest.max() <= job.tolerance)
        document["shape"] = {"largest_deviation": deviation, "tolerance": job.tolerance, "within_tolerance": ok}
    if job.forces is not None:
        document["forces"] = {
            name: {"force_N": float(np.linalg.norm(row[3:])), "torque_Nm": float(np.linalg.norm(row[:3]) / 1000)}
            for name, row in zip(job.robots, job.forces, strict=True)
        }
    return document


def _robot_document(model: RobotModel) -> dict[str, Any]:
    sigma = np.sqrt(np.diag(model.covariance)).reshape(4, 3)
    return {
        "T_world_base": model.T_world_base.tolist(),
        "T_flange_contact": model.T_flange_contact.tolist(),
        "sigma_base": sigma[1].tolist(),
        "sigma_base_deg": np.degrees(sigma[0]).tolist(),
        "sigma_contact": sigma[3].tolist(),
        "sigma_contact_deg": np.degrees(sigma[2]).tolist(),
        **{key: getattr(model, key) for key in ("chi_square", "redundancy", "p_value")},
    }


def write_folder(job: PanelJob, result: PanelResult, folder: Path) -> list[str]:
    """Write commands and model; returns the files' names."""
    folder.mkdir(parents=True, exist_ok=True)
    write_poses(folder / "preposition.csv", "robot", job.robots, result.preposition)
    _write_model(folder / "model.csv", job, result)
    written = ["preposition.csv", "model.csv"]
    for name, commands in (("pose_move.csv", result.pose_commands), ("shape_move.csv", result.shape_commands)):
        if commands is not None:
            write_poses(folder / name, "robot", job.robots, commands)
            written.append(name)
    if result.shape is not None and job.control is not None:
        off = result.shape.deviations
        columns: dict[str, Any] = {"point": job.control.names, "dx": off[:, 0], "dy": off[:, 1], "dz": off[:, 2]}
        write_columns(folder / "deviations.csv", columns)
        written.append("deviations.csv")
    return written


def _write_model(file: Path, job: PanelJob, result: PanelResult) -> None:
    columns: dict[str, Any] = {"robot": list(job.robots)}
    for prefix, name in (("base", "T_world_base"), ("contact", "T_flange_contact")):
        rows = rows_from_poses(np.array([getattr(m, name) for m in result.models]))
        columns |= {f"{prefix}_{k}": rows[:, i] for i, k in enumerate(POSE_COLUMNS.split())}
    sigma = np.array([np.sqrt(np.diag(m.covariance)) for m in result.models])
    for prefix, first in (("base", 0), ("contact", 6)):
        columns[f"{prefix}_sigma_deg"] = np.degrees(sigma[:, first : first + 3].max(axis=1))
        columns[f"{prefix}_sigma_mm"] = sigma[:, first + 3 : first + 6].max(axis=1)
    write_columns(file, columns)


def leg_sentence(o: LegOffset) -> str:
    """Say which leg's length its controller does not know."""
    rival = "" if o.gain - o.runner_up_gain > _CLEAR else f"; leg {o.runner_up} explains it nearly as well"
    return (
        f"Leg {o.leg} of robot {o.robot} is {o.offset:+.3f} ± {o.sigma:.3f} mm (1 σ) longer than its controller "
        f"believes{rival}. It is taken out of the model and put into the commands."
    )


def shape_sentence(job: PanelJob, result: PanelResult) -> str | None:
    """Say the clamp where the shape is off most; None without control points."""
    if result.shape_largest is None:
        return None
    worst = int(np.argmax(result.shape_largest))
    verdict = "within" if result.shape_largest[worst] <= job.tolerance else "beyond"
    return (
        f"Its shape is {result.shape_largest[worst]:.2f} mm off at clamp {job.robots[worst]}, {verdict} the "
        f"{job.tolerance:g} mm allowed."
    )


def robot_sessions(job: PanelJob, result: PanelResult) -> list[SessionFiles]:
    """Return one session a robot, since each has a base of its own; the sensor's frame is the world's.

    The poses are the controller's own, a leg offset that was found is still in them. A parallel robot has no chain of
    joints that a session could name; the lengths of its legs go along as covariates.
    """
    return [
        _robot_session(readings, model, job.legs)
        for readings, model in zip(job.calibration, result.models, strict=True)
    ]


def _robot_session(readings: ReflectorReadings, model: RobotModel, legs: Legs | None) -> SessionFiles:
    count = len(readings.T_base_flange)
    views = [f"{readings.name}{m + 1:03}" for m in range(count)]
    points = points_table(
        np.repeat(views, len(_REFLECTORS)).tolist(),
        _REFLECTORS * count,
        readings.reflectors.reshape(-1, 3),
        readings.sigma.ravel(),
    )
    lengths = () if legs is None else leg_lengths(legs, readings.T_base_flange).T
    return SessionFiles(
        name=readings.name,
        length_unit="mm",
        mount="eye_to_hand",
        tables={"scanner": {"pose": frames.inverse(model.T_world_base).tolist()}},
        views={
            "view": views,
            **pose_columns(readings.T_base_flange),
            **{f"leg{i + 1}_mm": length for i, length in enumerate(lengths)},
        },
        points=points,
    )


def control_shape(file: Path, drive: str, folder: Path) -> tuple[PanelJob, PanelResult, list[float]]:
    """Correct until all control points are within the tolerance.

    With targets the first move takes the panel to its place; from then on its shape is judged there.

    Returns:
        The last job, its result, and the largest deviation before each correction and at the end, mm.

    Args:
        drive: a program with its arguments. It sends the robots to shape_move.csv in `folder` and writes the job's
            flanges, targets, control points and forces anew.

    Raises:
        InputError: the job has no control points.
        NoResultError: the program fails, a clamp pulls harder than it may, or ten corrections are not enough.
    """
    largest: list[float] = []
    while True:
        job = read_panel_job(file)
        # A pose taken anew from targets on a panel that bends would move it again and again.
        job = replace(job, targets=None) if largest else job
        result = solve_panel_job(job)
        if result.shape_largest is None:
            raise InputError(f"{file}: files.control is missing; to fix: name the table of the shape's control points")
        write_folder(job, result, folder)
        largest.append(float(result.shape_largest.max()))
        if largest[-1] <= job.tolerance and job.targets is None:
            return job, result, largest
        if len(largest) > _MOST_CORRECTIONS:
            raise NoResultError(
                f"the shape is still {largest[-1]:.2f} mm off after {_MOST_CORRECTIONS} corrections, "
                f"{job.tolerance:g} mm are allowed; to fix: look at the forces, and which clamp a point belongs to"
            )
        print(call_program("--drive", drive), end="", file=sys.stderr)


def run_panel(file: Path, drive: str | None, wanted: Wanted) -> None:
    """Solve a job and hand out what was asked for; `InputError` and `NoResultError` end it."""
    largest: list[float] = []
    if drive is None:
        job = read_panel_job(file)
        result = solve_panel_job(job)
    elif wanted.output is None:
        raise InputError("--drive: no folder for the moves; to fix: name one with -o")
    else:
        job, result, largest = control_shape(file, drive, wanted.output)
    written = []
    if wanted.output is not None:
        written = write_folder(job, result, wanted.output) + write_pictures("panel", wanted.output, job, result)
    steps = {"corrections": {"largest_deviation": largest}} if largest else {}
    if not hand_out(
        "panel", wanted, lambda: robot_sessions(job, result), lambda: panel_document(job, result) | steps, job, result
    ):
        return
    _show_model(result)
    _show_moves(job, result)
    if largest:
        sizes = " → ".join(f"{size:.2f}" for size in largest)
        count = f"{len(largest) - 1} correction{'s' * (len(largest) != 2)}"
        say(f"Shape control: {count}, largest deviation {sizes} mm.")
    for name in written:
        print(f"{wanted.output}/{name}")


def _show_model(result: PanelResult) -> None:
    rows = []
    for model in result.models:
        sigma = np.sqrt(np.diag(model.covariance)).reshape(4, 3).max(axis=1)
        turns = np.degrees(sigma[[0, 2]])
        sizes = (f"{sigma[1]:.3f}", f"{turns[0]:.4f}", f"{sigma[3]:.3f}", f"{turns[1]:.4f}")
        rows.append((model.name, *sizes, f"{model.p_value:.3g}"))
    headings = ("robot", "base σ / mm", "base σ / °", "clamp σ / mm", "clamp σ / °", "misfit p")
    show_table("Robots and tracker in one model: 1 σ of the worst axis", headings, rows)
    offsets = [offset for offset in result.legs if offset.found]
    for offset in offsets:
        say(leg_sentence(offset))
    for model in result.models:
        if model.p_value < 1e-4:
            times = np.sqrt(model.chi_square / model.redundancy)
            say(
                f"Robot {model.name}: its residuals are {times:.1f} times what the tracker's sigma allows and nothing "
                "known explains them; look at single rows, or at the robot."
            )
    if result.legs and not offsets:
        say("No leg offset beyond chance in any robot.")


def _show_moves(job: PanelJob, result: PanelResult) -> None:
    shift = result.shift_errors.position[:, -1].max()
    turn = result.turn_errors.position[:, -1].max()
    say(
        f"With {job.robots[job.master]} as master, the others are off by {shift:.3f} mm rms at most after a shift by "
        f"100 mm, {turn:.3f} mm after a turn by 2°."
    )
    worst = result.errors_by_master.max(axis=1)
    best = int(np.argmin(worst))
    if worst[best] < 0.9 * worst[job.master]:
        say(f"{job.robots[best]} as master would leave {worst[best]:.3f} mm instead of {worst[job.master]:.3f} mm.")
    if result.pose_error is not None:
        x, y, z = result.pose_error[3:]
        a, b, c = np.degrees(result.pose_error[:3])
        say(
            f"Panel off its target by x {x:+.3f}, y {y:+.3f}, z {z:+.3f} mm, turned about x {a:+.4f}, y {b:+.4f}, "
            f"z {c:+.4f}°, in the panel's frame."
        )
    if (shape := shape_sentence(job, result)) is not None:
        say(shape)
    if job.forces is not None:
        size = np.linalg.norm(job.forces[:, 3:], axis=1)
        say(f"Largest change of force: {size.max():.1f} N at clamp {job.robots[int(np.argmax(size))]}.")
