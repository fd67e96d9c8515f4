"""The panel cell in closed loop on any machines that drive and measure: pose first, then shape; and its tables.

`stitch panel` gives the commands of one step from files; a loop drives, measures and steps again.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from bench.harness import Parts, Row, Table, grouped, markdown
from data_synth.cells import hexapod, panel_job
from data_synth.cells.panel import NAMES, PanelCell, Sizes
from stitch.errors import NoResultError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.plugins.cells.panel_model import (
    SHAPE_AXES,
    ClampLayout,
    ControlPoints,
    LaserTracker,
    Legs,
    ReflectorReadings,
    RigidFit,
    RobotModel,
    adjust_pose,
    calibrate_robot,
    clamp_contacts,
    errors_along_motion,
    find_leg_offset,
    follow,
    largest_deviations,
    preposition,
    rigid_fit,
    shape_step,
    true_flanges,
)

LAYOUT = ClampLayout(**panel_job.LAYOUT, columns=3)
LEGS = Legs(hexapod.BASE, hexapod.PLATFORM)
POSES, MASTER, TOLERANCE = 40, 1, 0.6
# By name: what of the robots is not as their controllers believe.
ROBOTS = {
    "": Sizes(),
    "joints 0.05 mm off": Sizes(joint=0.05),
    "legs give 20 µm/kN, 5 K warmer": Sizes(bend=2e-5, warm=5.0),
}
# By name: whether the other axes give way, which are driven, and robots.
SHAPES = {
    "z and about x, y; the rest gives way": (True, SHAPE_AXES, ""),
    "the same, legs give and warm up": (True, SHAPE_AXES, "legs give 20 µm/kN, 5 K warmer"),
    "z and about x, y; the rest is held": (False, SHAPE_AXES, ""),
    "all six": (False, np.ones(6, bool), ""),
}
LEG_OFFSETS = (0.0, 0.2, 0.3, 0.5, 1.0)  # mm, of leg 4 of robot C
MOTIONS = {"100 mm": (False, 100.0), "2°": (True, np.radians(2.0))}
LEGS_REPEAT = (0.0, 0.004)  # mm
DRIFT_CELLS = 20
_MOST_CORRECTIONS = 10


class PanelMachines(Protocol):
    """What a loop needs of the machines."""

    def drive(self, T_base_flange: Array, /) -> None:
        """All robots to poses (N, 4, 4)."""

    def track(self, nominal: Array, /) -> Array:
        """Readings (K, 3), world frame, of the panel's targets given by their nominal places (K, 3)."""

    def forces(self) -> Array:
        """(N, 6) change of torques and forces at the clamps since the panel was laid on."""


@dataclass(frozen=True)
class PanelSetup:
    """Where the panel shall go, and what holds it."""

    models: Sequence[RobotModel]
    master: int
    tracker: LaserTracker
    T_world_target: Array  # (4, 4)


@dataclass(frozen=True)
class ShapeRun:
    """Deviations and forces, first before any correction."""

    T_base_flange: Array  # (N, 4, 4) at the end
    deviations: list[Array]  # (N,) mm each
    forces: list[Array]  # (N, 6) each


def measure_pose(cell: PanelMachines, setup: PanelSetup, targets: Array) -> RigidFit:
    """The panel's pose from its targets (K, 3), panel frame."""
    places = cell.track(targets)
    return rigid_fit(targets, places, setup.tracker.sigma(places))


def run_pose(cell: PanelMachines, setup: PanelSetup, targets: Array, T_base_flange: Array) -> Array:
    """One adjustment: measure, move master and slaves; returns where the robots stand then, (N, 4, 4)."""
    bases = np.array([m.T_world_base for m in setup.models])
    T_world_panel = measure_pose(cell, setup, targets).T
    moved = adjust_pose(bases, T_base_flange, setup.master, T_world_panel, setup.T_world_target)
    cell.drive(moved)
    return moved


def run_shape(
    cell: PanelMachines,
    setup: PanelSetup,
    control: ControlPoints,
    T_base_flange: Array,
    *,
    tolerance: float,
    axes: Array = SHAPE_AXES,
) -> ShapeRun:
    """Correct from poses (N, 4, 4) on until all control points are within the tolerance, mm.

    Raises:
        NoResultError: they are not after ten corrections.
    """
    contact = np.array([m.T_flange_contact for m in setup.models])
    deviations: list[Array] = []
    forces: list[Array] = []
    T_target_world = frames.inverse(setup.T_world_target)
    for _ in range(_MOST_CORRECTIONS + 1):
        places = frames.transform(T_target_world, cell.track(control.nominal))
        step = shape_step(places, control, T_base_flange, contact, axes=axes)
        deviations.append(largest_deviations(step.deviations, control))
        forces.append(cell.forces())
        if deviations[-1].max() <= tolerance:
            return ShapeRun(T_base_flange, deviations, forces)
        T_base_flange = step.T_base_flange
        cell.drive(T_base_flange)
    raise NoResultError(
        f"shape: still {deviations[-1].max():.2f} mm off after {_MOST_CORRECTIONS} corrections "
        f"(tolerance {tolerance:g} mm); look at the forces, or check that control points and clamps belong together"
    )


@dataclass
class Ready:
    """A cell with its panel on the clamps."""

    cell: PanelCell
    setup: PanelSetup
    readings: list[ReflectorReadings]
    T_base_flange: np.ndarray


def ready(seed: int, **settings) -> Ready:
    """Calibrate, pre-position, lay the panel on."""
    r = ready_without_panel(seed, **settings)
    r.cell.lay()
    return r


def ready_without_panel(seed: int, **settings) -> Ready:
    """Calibrate and pre-position."""
    cell = PanelCell(seed, **settings)
    tracker = LaserTracker(cell.tracker)
    readings = read(cell, tracker)
    setup = PanelSetup([calibrate_robot(r) for r in readings], MASTER, tracker, cell.target)
    base = np.array([model.T_world_base for model in setup.models])
    contact = np.array([model.T_flange_contact for model in setup.models])
    start = preposition(base, cell.target, clamp_contacts(LAYOUT).T_panel_contact, contact)
    cell.drive(start)
    return Ready(cell, setup, readings, start)


def read(cell: PanelCell, tracker: LaserTracker) -> list[ReflectorReadings]:
    """Reflectors of all robots at the poses of the calibration."""
    commands = panel_job.calibration_poses(POSES, cell.seed)
    places = panel_job.calibration(cell, commands)
    return [
        ReflectorReadings(name, commands[:, i], places[:, i], tracker.sigma(places[:, i]))
        for i, name in enumerate(NAMES)
    ]


def pose_error(cell: PanelCell) -> np.ndarray:
    """(6,) true error of the panel's pose: rotation in deg, then mm; from the targets' true places."""
    targets = panel_job.pose_targets()
    T = rigid_fit(targets, cell.true_points(targets), np.ones(len(targets))).T
    e = frames.log(frames.inverse(cell.target) @ T)
    return np.concatenate([np.degrees(e[:3]), e[3:]])


def shape_run(seed: int, compliant: bool, axes: np.ndarray, robots: str = "", tolerance: float = TOLERANCE) -> ShapeRun:
    """One adjustment of the pose, then corrections of the shape along some axes."""
    r = ready(seed, sizes=ROBOTS[robots])
    stand = run_pose(r.cell, r.setup, panel_job.pose_targets(), r.T_base_flange)
    r.cell.compliant = compliant
    control = ControlPoints(*panel_job.control_points(), clamp_contacts(LAYOUT).T_panel_contact)
    return run_shape(r.cell, r.setup, control, stand, tolerance=tolerance, axes=axes)


def jobs(seeds: range) -> Iterator[Row]:
    """Pose and legs of every seed, shape of a third of them, motions of twenty cells."""
    for robots in ROBOTS:
        yield from ({"part": "pose", "robots": robots, "seed": seed} for seed in seeds)
    for shape in SHAPES:
        yield from ({"part": "shape", "shape": shape, "seed": seed} for seed in seeds[: max(1, len(seeds) // 3)])
    for size in LEG_OFFSETS:
        yield from ({"part": "leg", "size": size, "seed": seed} for seed in seeds)
    for leg in LEGS_REPEAT:
        for motion in MOTIONS:
            yield from ({"part": "drift", "leg": leg, "motion": motion, "seed": seed} for seed in range(DRIFT_CELLS))


def _pose(job: Row) -> Row:
    """True errors of the panel's pose before and after one adjustment, and the largest change of force."""
    r = ready(job["seed"], sizes=ROBOTS[job["robots"]])
    before = pose_error(r.cell)
    run_pose(r.cell, r.setup, panel_job.pose_targets(), r.T_base_flange)
    force = np.linalg.norm(r.cell.state()[2][:, 3:], axis=1).max()
    return {"before": before.tolist(), "after": pose_error(r.cell).tolist(), "force": float(force)}


def _shape(job: Row) -> Row:
    """Largest deviation before every correction and at the end, and the largest forces at the end."""
    run = shape_run(job["seed"], *SHAPES[job["shape"]])
    forces = run.forces[-1][:, 3:]
    ends = {"force": np.linalg.norm(forces, axis=1).max(), "in_plane": np.linalg.norm(forces[:, :2], axis=1).max()}
    return {"deviations": [float(d.max()) for d in run.deviations], **{key: float(f) for key, f in ends.items()}}


def _leg(job: Row) -> Row:
    """Whether robot C's leg is found, its size, false alarms in others, and robot C's base before and after."""
    hidden = np.zeros((6, 6))
    hidden[2, 3] = job["size"]
    cell = PanelCell(1000 + job["seed"], leg_offsets=hidden)
    wrong = 0
    for i, reading in enumerate(read(cell, LaserTracker(cell.tracker))):
        model = calibrate_robot(reading)
        offset = find_leg_offset(reading, model, LEGS, 36)
        if i != 2:
            wrong += bool(offset.found)
            continue
        better = model
        if offset.found:
            real = true_flanges(LEGS, reading.T_base_flange, [(offset.leg, offset.offset)])
            better = calibrate_robot(replace(reading, T_base_flange=real))
        T_base_world = frames.inverse(cell.T_world_base[2])
        off = [float(np.linalg.norm((T_base_world @ m.T_world_base)[:3, 3])) for m in (model, better)]
        row = {"found": bool(offset.found), "right": bool(offset.found and offset.leg == 4), "base": off}
        row |= {"offset": float(offset.offset), "sigma": float(offset.sigma)}
    return {**row, "wrong": wrong}


def _drift(job: Row) -> Row:
    """What a motion of the source does to the slaves: true twists (3, N, 6), and the largest that the model expects."""
    turn, step = MOTIONS[job["motion"]]
    r = ready_without_panel(job["seed"])
    r.cell.sizes = replace(r.cell.sizes, leg=job["leg"])
    r.cell.drive(r.T_base_flange)
    models = r.setup.models
    expected = errors_along_motion(models, r.T_base_flange, MASTER, np.array([step]), turn=turn)
    drawn: list[Array] = []
    bases = np.array([m.T_world_base for m in models])
    change = []
    for axis in range(3):
        before = r.cell.clamps()
        motion = np.zeros(6)
        motion[axis if turn else 3 + axis] = step
        T = r.T_base_flange[MASTER].copy()
        T[:3, :3] = frames.exp(motion)[:3, :3] @ T[:3, :3]
        T[:3, 3] += frames.exp(motion)[:3, 3]
        moved = follow(bases, r.T_base_flange, MASTER, T)
        r.cell.drive(moved)
        change.append(_relative_change(before, r.cell.clamps()).tolist())
        r.cell.drive(r.T_base_flange)
        drawn.append(np.sqrt((_drawn_changes(models, r.T_base_flange, moved) ** 2).mean(axis=0)))
    closed = [float(expected.position.max()), float(np.degrees(expected.angle.max()))]
    return {"change": change, "expected": closed, "drawn": _worst(np.array(drawn))}


def _relative_change(before: Array, after: Array) -> Array:
    """Twists (..., N, 6) by which contact frames (..., N, 4, 4) move against the master's."""
    first, then = (frames.inverse(c[..., MASTER : MASTER + 1, :, :]) @ c for c in (before, after))
    return frames.log(frames.inverse(first) @ then)


def _drawn_changes(models: Sequence[RobotModel], flanges: Array, moved: Array, draws: int = 200) -> Array:
    """The same (draws, N, 6) of cells drawn about the model from its covariance."""
    rng = np.random.default_rng(0)
    xi = np.stack([rng.multivariate_normal(np.zeros(12), m.covariance, draws, "ignore") for m in models], axis=1)
    bases = np.array([m.T_world_base for m in models]) @ frames.exp(xi[..., :6])
    clamps = np.array([m.T_flange_contact for m in models]) @ frames.exp(xi[..., 6:])
    return _relative_change(bases @ flanges @ clamps, bases @ moved @ clamps)


def _worst(rms: Array) -> list[float]:
    """Position, mm, and angle, °, of the worst axis and slave, of rms twists (3, N, 6)."""
    return [float(np.linalg.norm(part, axis=-1).max()) for part in (rms[..., 3:], np.degrees(rms[..., :3]))]


def _pose_table(rows: list[Row]) -> list[str]:
    groups = grouped(rows, "robots")
    exact = groups[""]
    figures = {"before, largest": (np.abs([row["before"] for row in exact]).max(axis=0), 2)}
    for robots, group in groups.items():
        name, off = ", ".join(filter(None, ("after", robots))), np.abs([row["after"] for row in group])
        figures |= {f"{name}, rms": (np.sqrt((off**2).mean(axis=0)), 4), f"{name}, largest": (off.max(axis=0), 4)}
    lines = [[name, *(f"{v:.{d}f}" for v in values[[3, 4, 5, 0, 1, 2]])] for name, (values, d) in figures.items()]
    lines.append(["published, largest of 3", "0.047", "0.069", "0.036", "0.008", "0.008", "0.008"])
    forces = [row["force"] for row in exact]
    return [
        f"Pose after one adjustment, {len(exact)} cells; absolute errors against the truth.",
        "",
        *markdown("error | x / mm | y / mm | z / mm | about x / ° | about y / ° | about z / °", lines),
        "",
        f"Largest change of force at a clamp after the adjustment: {np.median(forces):.1f} N in the median cell, "
        f"{max(forces):.1f} N in the worst.",
    ]


def _shape_table(rows: list[Row]) -> list[str]:
    lines = []
    for shape, group in grouped(rows, "shape").items():
        runs = [row["deviations"] for row in group]
        at = [f"{max(run[min(k, len(run) - 1)] for run in runs):.2f}" for k in range(3)]
        forces = [f"{max(row[key] for row in group):.0f}" for key in ("force", "in_plane")]
        lines.append([shape, *at, max(map(len, runs)) - 1, *forces])
    lines.append(["published", "larger", "", "", "not given", "table lost", ""])
    head = "driven axes | before, largest / mm | after 1 / mm | after 2 / mm | corrections needed"
    return [
        f"Shape until all control points are within {TOLERANCE} mm, {len(group)} cells each.",
        "",
        *markdown(f"{head} | largest force at the end / N | largest force in the plane / N", lines),
    ]


def _leg_table(rows: list[Row]) -> list[str]:
    lines = []
    for size, group in grouped(rows, "size").items():
        found, right, wrong = (sum(row[key] for row in group) for key in ("found", "right", "wrong"))
        counts = [f"{found} of {len(group)}", f"{right} of {len(group)}"]
        values, sigmas = [row["offset"] for row in group], [row["sigma"] for row in group]
        before, after = np.sqrt(np.mean(np.square([row["base"] for row in group]), axis=0))
        sizes = [f"{np.mean(values):+.3f} ± {np.std(values):.3f}", f"{np.mean(sigmas):.3f}"]
        lines.append([size, *counts, *sizes, f"{wrong} of {5 * len(group)}", f"{before:.3f}", f"{after:.3f}"])
    head = "offset / mm | robot found | leg found | offset found, mean ± spread / mm | its own sigma / mm"
    return [
        f"A hidden offset of leg 4 of robot C, {POSES} calibration poses, {len(group)} cells.",
        "",
        *markdown(f"{head} | false alarms in other robots | base error before / mm | after / mm", lines),
    ]


def _drift_table(rows: list[Row]) -> list[str]:
    lines = []
    for (leg, motion), group in grouped(rows, "leg", "motion").items():
        rms = np.sqrt(np.mean(np.square([row["change"] for row in group]), axis=0))
        found = (group[0]["expected"], group[0]["drawn"], _worst(rms))
        figures = [f"{of[k]:.{3 + k}f}" for k in (0, 1) for of in found]
        lines.append([motion, f"{leg * 1e3:g}", *figures])
    head = "motion | legs repeat / µm | closed form / mm | drawn / mm | in the cells / mm"
    head += " | closed form / ° | drawn / ° | in the cells / °"
    return [
        "Slaves against the master after the source's motions, rms of the worst slave and axis: in closed form, over "
        "200 draws of the model, and what 20 simulated cells do.",
        "",
        *markdown(head, lines),
    ]


PARTS = Parts(
    {
        "pose": (_pose, _pose_table),
        "shape": (_shape, _shape_table),
        "leg": (_leg, _leg_table),
        "drift": (_drift, _drift_table),
    }
)
TABLE = Table(jobs, PARTS.trial, PARTS.summary, range(30), page="panel", block="tables")
