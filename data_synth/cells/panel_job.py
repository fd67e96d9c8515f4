"""A panel cell's measurements as the files that `stitch panel` reads.

As a program it stands for the machines: `python -m data_synth.cells.panel_job FOLDER MOVES` lets the robots of a cell
that `stitch synth panel-robots FOLDER` wrote go where the table MOVES says, and measures anew.
"""

import csv
import json
import sys
from pathlib import Path

import numpy as np
import tomli_w
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from data_synth.cells import hexapod
from data_synth.cells.panel import LENGTH, NAMES, RADIUS, PanelCell
from data_synth.csv_rows import POSE, pose_numbers, write_rows
from stitch.numerics import frames

Array = NDArray[np.float64]

LAYOUT = {
    "radius": RADIUS,
    "clamp_width": 360.0,
    "spacing": 290.0,
    "clamp_height": 360.0,
    "edge": 300.0,
    "length": LENGTH,
}
# Targets of the pose on the inner side, and three control points at each clamp: axial place and angle.
_POSE = [(x, a) for x in (-1400.0, -470.0, 470.0, 1400.0) for a in (-0.31, 0.0, 0.31)]
_CONTROL = [(-1310.0, -0.03), (-1310.0, 0.03), (-830.0, 0.0)]
_COLUMN = 0.2197  # angle between neighbouring clamps of that layout
SKIN = 3.0
_FILES = {key: f"{key}.csv" for key in ("calibration", "flanges", "targets", "control", "forces")}
_COMMENT = """# Lengths in mm; poses are x, y, z and a, b, c in degrees about z, y', x''.
# robots: row by row as the layout counts its clamps, each row from one long edge of the panel to the other.
# target: where the panel's frame shall stand in the world; z out of the panel, x along its axis.
# legs: joints of the six-legged robots, leg by leg; leave the table out for other robots.
# files: calibration is needed; flanges (where the robots stand now) goes with targets and control.
"""


def inner(x: float, angle: float) -> list[float]:
    """A nominal point on the panel's inner side, mm."""
    r = RADIUS - SKIN
    return [x, r * np.sin(angle), r * np.cos(angle) - RADIUS]


def pose_targets() -> Array:
    """(12, 3) panel frame."""
    return np.array([inner(*at) for at in _POSE])


def control_points() -> tuple[Array, NDArray[np.int64]]:
    """(18, 3) panel frame and the index of the clamp of each."""
    points, clamp = [], []
    for i in range(6):
        side, angle = (1.0 if i < 3 else -1.0), _COLUMN * (i % 3 - 1)
        for x, off in _CONTROL:
            points.append(inner(side * x, angle + off))
            clamp.append(i)
    return np.array(points), np.array(clamp)


def calibration_poses(count: int, seed: int = 0) -> Array:
    """(M, 6, 4, 4) commands all about the robots' workspace: ±80 mm and ±8°."""
    rng = np.random.default_rng(seed)
    twist = rng.uniform(-1, 1, (count, 6, 6)) * np.repeat([np.radians(8.0), 80.0], 3)
    return np.asarray(frames.make(np.eye(3), [0.0, 0.0, hexapod.HOME_HEIGHT]) @ frames.exp(twist))


def calibration(cell: PanelCell, commands: Array) -> Array:
    """(M, 6, 3, 3) reflectors seen at commanded poses."""
    seen = []
    for T in commands:
        cell.drive(T)
        seen.append(cell.see_reflectors())
    return np.array(seen)


def stand_at_target(cell: PanelCell) -> Array:
    """(6, 4, 4) where the robots stand when their clamps wait for a panel at its target, as they truly are."""
    places = np.array([cell.place(*at) for at in cell.plan()])
    T_flange_clamp = frames.inverse(cell.T_world_base @ cell.T_base_flange) @ cell.clamps()
    return np.asarray(frames.inverse(cell.T_world_base) @ cell.target @ places @ frames.inverse(T_flange_clamp))


def cell_with_a_leg_off(seed: int) -> PanelCell:
    """One leg of one robot is half a millimetre longer or shorter than its controller believes."""
    rng = np.random.default_rng([seed, 9])
    offsets = np.zeros((len(NAMES), 6))
    robot, leg = int(rng.integers(len(NAMES))), int(rng.integers(6))
    offsets[robot, leg] = float(rng.choice([-0.5, 0.5]))
    return PanelCell(seed, leg_offsets=offsets)


def write_cell(folder: Path, cell: PanelCell, poses: int = 40) -> None:
    """Calibrate the robots, lay the panel on, measure it, and write the job with all its tables."""
    commands, seen, stand = calibrated_and_laid(cell, poses)
    write_calibration(folder / _FILES["calibration"], commands, seen)
    write_readings(folder, cell, stand)
    write_job(folder / "job.toml", cell, _FILES)


def calibrated_and_laid(cell: PanelCell, poses: int = 40) -> tuple[Array, Array, Array]:
    """Poses of the calibration (M, 6, 4, 4), what was seen there, and where the robots stand with the panel on them."""
    stand, commands = stand_at_target(cell), calibration_poses(poses, cell.seed)
    seen = calibration(cell, commands)
    cell.drive(stand)
    cell.lay()
    return commands, seen, stand


def drive_and_measure(folder: Path, moves: Path, seed: int) -> None:
    """Robots of the cell in FOLDER go where a table says, under force control, and its readings are written anew."""
    cell = cell_with_a_leg_off(seed)
    calibrated_and_laid(cell)
    with moves.open(newline="", encoding="utf-8") as stream:
        rows = {row["robot"]: [float(row[key]) for key in POSE.split()] for row in csv.DictReader(stream)}
    numbers = np.array([rows[name] for name in NAMES])
    stand = frames.make(Rotation.from_euler("ZYX", numbers[:, 3:], degrees=True).as_matrix(), numbers[:, :3])
    # Elastic and without friction: how the panel lies follows from where it was laid and where its clamps are now.
    cell.rng, cell.compliant = np.random.default_rng([seed, *moves.read_bytes()[-8:]]), True
    cell.drive(stand)
    write_readings(folder, cell, stand)


def write_readings(folder: Path, cell: PanelCell, stand: Array) -> None:
    """Where the robots believe they stand (6, 4, 4), and what tracker and force sensors show there."""
    files = _FILES
    write_flanges(folder / files["flanges"], stand)
    targets, (control, clamp) = pose_targets(), control_points()
    names = [f"T{i + 1}" for i in range(len(targets))]
    write_points(folder / files["targets"], names, targets, cell.track(targets))
    names = [f"SC{c + 1}.{i % 3 + 1}" for i, c in enumerate(clamp)]
    write_points(folder / files["control"], names, control, cell.track(control), [NAMES[c] for c in clamp])
    write_forces(folder / files["forces"], cell.forces())


def write_calibration(file: Path, commands: Array, seen: Array) -> None:
    """One row per robot and pose."""
    rows = [
        [name, m + 1, *pose_numbers(commands[m, i], 6), *np.round(seen[m, i].ravel(), 5).tolist()]
        for i, name in enumerate(NAMES)
        for m in range(len(commands))
    ]
    write_rows(file, f"robot pose {POSE} x1 y1 z1 x2 y2 z2 x3 y3 z3", rows)


def write_flanges(file: Path, T_base_flange: Array) -> None:
    """Where the robots stand."""
    rows = [[name, *pose_numbers(T, 6)] for name, T in zip(NAMES, T_base_flange, strict=True)]
    write_rows(file, f"robot {POSE}", rows)


def write_points(file: Path, names: list[str], nominal: Array, seen: Array, robots: list[str] | None = None) -> None:
    """Nominal points in the panel frame and what the tracker sees in the world."""
    extra = [[r] for r in robots] if robots else [[] for _ in names]
    places = np.hstack([np.round(nominal, 4), np.round(seen, 5)]).tolist()
    rows = [[name, *robot, *place] for name, robot, place in zip(names, extra, places, strict=True)]
    write_rows(file, f"point {'robot ' if robots else ''}x y z seen_x seen_y seen_z", rows)


def write_forces(file: Path, forces: Array) -> None:
    """Change of the sensors since the panel was laid on, N·mm and N."""
    rows = [[n, *np.round(f, 2).tolist()] for n, f in zip(NAMES, forces, strict=True)]
    write_rows(file, "robot tx ty tz fx fy fz", rows)


def write_job(file: Path, cell: PanelCell, files: dict[str, str]) -> None:
    """The job file."""
    document = {
        "format": "stitch-panel/1",
        "robots": list(NAMES),
        "master": "B",
        "target": dict(zip(POSE.split(), pose_numbers(cell.target, 6), strict=True)),
        "layout": LAYOUT,
        "tracker": {"position": cell.tracker.tolist(), "constant": 0.010, "per_length": 5e-6},
        "shape": {"tolerance": 0.6, "axes": ["z", "rx", "ry"]},
        "legs": {"base": np.round(hexapod.BASE, 4).tolist(), "platform": np.round(hexapod.PLATFORM, 4).tolist()},
        "files": files,
    }
    file.write_text(_COMMENT + tomli_w.dumps(document), encoding="utf-8")


if __name__ == "__main__":
    cell_folder, table = map(Path, sys.argv[1:])
    known = json.loads(cell_folder.with_name(f"{cell_folder.name}.truth.json").read_text(encoding="utf-8"))
    drive_and_measure(cell_folder, table, known["seed"])
