"""The panel cell in closed loop: `stitch panel` solves each step, a simulated cell drives and measures."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from bench.harness import Parts, Row, Table, grouped, markdown
from data_synth.cells import hexapod, panel_job
from data_synth.cells.panel import NAMES, PanelCell, Sizes
from stitch.errors import NoResultError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.plugins.cells.panel import PanelJob, PanelPoints, calibrate_robots, solve_panel_job
from stitch.plugins.cells.panel_model import (
    SHAPE_AXES,
    ClampLayout,
    LaserTracker,
    Legs,
    ReflectorReadings,
    RobotModel,
    calibrate_robot,
    errors_along_motion,
    follow,
    rigid_fit,
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


def calibrated(seed: int, **settings) -> tuple[PanelCell, PanelJob]:
    """Return a cell whose clamps wait for the panel, and its job: what was calibrated, and where the robots stand."""
    cell = PanelCell(seed, **settings)
    job = measured_job(cell)
    job = replace(job, flanges=solve_panel_job(job).preposition)
    cell.drive(job.flanges)
    return cell, job


def measured_job(cell: PanelCell, legs: Legs | None = None) -> PanelJob:
    """Return the job of a cell with what the tracker sees of all reflectors at the poses of the calibration."""
    commands = panel_job.calibration_poses(POSES, cell.seed)
    places = panel_job.calibration(cell, commands)
    tracker = LaserTracker(cell.tracker)
    sigma = tracker.sigma(places)
    readings = tuple(ReflectorReadings(n, commands[:, i], places[:, i], sigma[:, i]) for i, n in enumerate(NAMES))
    stated = (NAMES, MASTER, cell.target, LAYOUT, tracker, TOLERANCE, SHAPE_AXES, legs)
    return PanelJob(*stated, readings, flanges=None, targets=None, control=None, forces=None)


def adjust_panel(cell: PanelCell, job: PanelJob) -> PanelJob:
    """Measure the panel's pose and move it to its target; return the job with where the robots stand then."""
    nominal = panel_job.pose_targets()
    targets = PanelPoints([], nominal, cell.track(nominal), np.full(len(nominal), -1))
    moved = solve_panel_job(replace(job, targets=targets)).pose_commands
    cell.drive(moved)
    return replace(job, flanges=moved)


def correct_shape(cell: PanelCell, job: PanelJob) -> tuple[list[Array], list[Array]]:
    """Return deviations (N,), mm, and forces (N, 6), before each correction and when all points are within tolerance.

    Raises:
        NoResultError: they are not after ten corrections.
    """
    nominal, clamp = panel_job.control_points()
    deviations: list[Array] = []
    forces: list[Array] = []
    for _ in range(_MOST_CORRECTIONS + 1):
        control = PanelPoints([], nominal, cell.track(nominal), clamp)
        result = solve_panel_job(replace(job, control=control))
        deviations.append(result.shape_largest)
        forces.append(cell.forces())
        if deviations[-1].max() <= job.tolerance:
            return deviations, forces
        job = replace(job, flanges=result.shape_commands)
        cell.drive(job.flanges)
    raise NoResultError(f"shape: still {deviations[-1].max():.2f} mm off after {_MOST_CORRECTIONS} corrections")


def pose_error(cell: PanelCell) -> np.ndarray:
    """(6,) true error of the panel's pose: rotation in deg, then mm; from the targets' true places."""
    targets = panel_job.pose_targets()
    T = rigid_fit(targets, cell.true_points(targets), np.ones(len(targets))).T
    e = frames.log(frames.inverse(cell.target) @ T)
    return np.concatenate([np.degrees(e[:3]), e[3:]])


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
    cell, ready = calibrated(job["seed"], sizes=ROBOTS[job["robots"]])
    cell.lay()
    before = pose_error(cell)
    adjust_panel(cell, ready)
    force = np.linalg.norm(cell.state()[2][:, 3:], axis=1).max()
    return {"before": before.tolist(), "after": pose_error(cell).tolist(), "force": float(force)}


def _shape(job: Row) -> Row:
    """Largest deviation before every correction and at the end, and the largest forces at the end."""
    compliant, axes, robots = SHAPES[job["shape"]]
    cell, ready = calibrated(job["seed"], sizes=ROBOTS[robots])
    cell.lay()
    ready = adjust_panel(cell, replace(ready, axes=axes))
    cell.compliant = compliant
    deviations, measured = correct_shape(cell, ready)
    forces = measured[-1][:, 3:]
    ends = {"force": np.linalg.norm(forces, axis=1).max(), "in_plane": np.linalg.norm(forces[:, :2], axis=1).max()}
    return {"deviations": [float(d.max()) for d in deviations], **{key: float(f) for key, f in ends.items()}}


def _leg(job: Row) -> Row:
    """Whether robot C's leg is found, its size, false alarms in others, and robot C's base before and after."""
    hidden = np.zeros((6, 6))
    hidden[2, 3] = job["size"]
    cell = PanelCell(1000 + job["seed"], leg_offsets=hidden)
    measured = measured_job(cell, LEGS)
    models, offsets = calibrate_robots(measured)
    offset = offsets[2]
    T_base_world = frames.inverse(cell.T_world_base[2])
    pair = (calibrate_robot(measured.calibration[2]), models[2])
    off = [float(np.linalg.norm((T_base_world @ m.T_world_base)[:3, 3])) for m in pair]
    row = {"found": bool(offset.found), "right": bool(offset.found and offset.leg == 4), "base": off}
    row |= {"offset": float(offset.offset), "sigma": float(offset.sigma)}
    return {**row, "wrong": sum(bool(other.found) for other in offsets if other is not offset)}


def _drift(job: Row) -> Row:
    """What a motion of the source does to the slaves: true twists (3, N, 6), and the largest that the model expects."""
    turn, step = MOTIONS[job["motion"]]
    cell, ready = calibrated(job["seed"])
    stand = ready.flanges
    cell.sizes = replace(cell.sizes, leg=job["leg"])
    cell.drive(stand)
    models, _ = calibrate_robots(ready)
    expected = errors_along_motion(models, stand, MASTER, np.array([step]), turn=turn)
    drawn: list[Array] = []
    bases = np.array([m.T_world_base for m in models])
    change = []
    for axis in range(3):
        before = cell.clamps()
        motion = np.zeros(6)
        motion[axis if turn else 3 + axis] = step
        T = stand[MASTER].copy()
        T[:3, :3] = frames.exp(motion)[:3, :3] @ T[:3, :3]
        T[:3, 3] += frames.exp(motion)[:3, 3]
        moved = follow(bases, stand, MASTER, T)
        cell.drive(moved)
        change.append(_relative_change(before, cell.clamps()).tolist())
        cell.drive(stand)
        drawn.append(np.sqrt((_drawn_changes(models, stand, moved) ** 2).mean(axis=0)))
    closed = [float(expected.position.max()), float(np.degrees(expected.angle.max()))]
    return {"change": change, "expected": closed, "drawn": _worst(np.array(drawn))}


def _relative_change(before: Array, after: Array) -> Array:
    """Twists (..., N, 6) by which contact frames (..., N, 4, 4) move against the master's."""
    first, then = (frames.inverse(c[..., MASTER : MASTER + 1, :, :]) @ c for c in (before, after))
    return frames.log(frames.inverse(first) @ then)


def _drawn_changes(models: tuple[RobotModel, ...], flanges: Array, moved: Array, draws: int = 200) -> Array:
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
