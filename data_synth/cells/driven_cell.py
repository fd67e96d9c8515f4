"""A cell that is driven: takes a view at a pose that comes as JSON on standard input, and writes it into the session.

    python -m data_synth.cells.driven_cell SEED [FAULT …]

Faults, each once in a session: `fail` ends with an error, `hang` never answers, `lose` returns 0 and writes nothing,
`empty` returns 0 and writes a scan without points; `far`, always: joint 1 goes no farther than a few degrees from where
the first view was taken.
"""

import csv
import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_synth import kinematics, nature
from data_synth.fixtures.quiet_scenes import mesh_for
from data_synth.moment import Plan
from data_synth.planning import plan_views
from data_synth.scanner import field_map
from data_synth.scene import Scene, load_scene
from data_synth.simulate import moments_of
from data_synth.take_view import Cell, take_view
from data_synth.write import cloud_file, robot_table
from stitch.numerics import frames
from stitch.output import session_files
from stitch.output.session_files import SessionFiles, write_ply
from stitch.session.session import Cloud

Array = NDArray[np.float64]
# Views after which a fault comes, and how far from home joint 1 goes where it is short, rad.
_AFTER = {"fail": 2, "hang": 3, "empty": 4, "lose": 5}
_SHORT = 0.25


def driven_scene() -> Scene:
    """The blade, few points, an arm without the effects that are always there."""
    scene = load_scene("blade")
    return replace(scene, small=0.0, scanner=replace(scene.scanner, columns=90, rows=90))


def true_mount(scene: Scene, seed: int) -> Array:
    """(4, 4) the hand-eye as it is."""
    rng = np.random.default_rng([seed, 3])
    return scene.T_mount @ frames.exp(rng.standard_normal(6) * np.repeat(scene.mount_spread, 3))


def new_cell(folder: Path, seed: int) -> list[float]:
    """Write a session without any view but its tables; return joints, degrees, that see the part."""
    scene = driven_scene()
    T = true_mount(scene, seed) @ frames.exp(np.repeat([0.003, 1.0], 3))
    scanner = {"pose": T.tolist(), "noise": scene.scanner.noise, "standoff": scene.scanner.standoff}
    tables: dict[str, dict[str, Any]] = {"scanner": scanner, "robot": robot_table(scene.arm)}
    columns: dict[str, list[object]] = {"view": []}
    session_files.write_session(folder, SessionFiles("driven", "mm", scene.mount, views=columns, tables=tables))
    (folder / "views.csv").unlink()
    plan, _ = plan_views(scene, mesh_for(scene), 1, np.random.default_rng([seed, 1]))
    return np.degrees(plan.joints[0]).tolist()


def take(folder: Path, view: str, joints: Array, seed: int, empty: bool = False) -> bool:
    """Take one view and write its scan, then its row, into the session; return False where the scanner sees nothing.

    Args:
        empty: the scan is written without its points.
    """
    scene = driven_scene()
    names, before = _rows(folder)
    every = np.array([*before, joints])
    still = np.zeros_like(every)
    plan = Plan(every, kinematics.gravity_torques(scene.arm, every), still, scene.arm, scene.useful)
    laws, _ = nature.draw({}, scene.small, plan, np.random.default_rng([seed, 2]))
    weights = field_map(scene.scanner, np.random.default_rng([seed, 4]))
    names_of = ("scanner_temperature_c", "part_temperature_c", "robot_temperature_c", "humidity_percent")
    still_air = dict.fromkeys(names_of, np.full(len(every), 25.0))
    moment = moments_of(scene, plan, 30.0 * np.arange(len(every)), still_air)[-1]
    cell = Cell(scene, mesh_for(scene), laws, true_mount(scene, seed), weights, {})
    cloud, *_ = take_view(cell, moment, 0.0, np.random.default_rng([seed, 5, len(names)]))
    if not len(cloud.points):
        return False
    (folder / "clouds").mkdir(exist_ok=True)
    write_ply(folder / "clouds" / f"{view}.ply", Cloud(np.empty((0, 3))) if empty else cloud_file(cloud))
    table = folder / "views.csv"
    with table.open("a", newline="") as file:
        if not names:
            file.write(",".join(["view", "cloud", "time_s", *(f"j{i + 1}_deg" for i in range(len(joints)))]) + "\r\n")
        csv.writer(file).writerow([view, f"clouds/{view}.ply", 30.0 * len(names), *np.degrees(joints)])
    return True


def _rows(folder: Path) -> tuple[list[str], list[Array]]:
    """Return names and joints of the views that are there."""
    table = folder / "views.csv"
    rows = list(csv.DictReader(table.open(newline=""))) if table.is_file() else []
    return [r["view"] for r in rows], [np.radians([float(v) for k, v in r.items() if k[0] == "j"]) for r in rows]


def main(seed: int, faults: list[str]) -> int:
    """Do what the pose on standard input asks, or go wrong; return the exit code."""
    pose = json.load(sys.stdin)
    folder, joints = Path(pose["session"]), np.radians(pose["joints_deg"])
    names, before = _rows(folder)
    for fault in faults:
        done = folder.parent / f"{folder.name}.{fault}"
        if _AFTER.get(fault, -1) == len(names) and not done.exists():
            done.touch()
            if fault == "hang":
                time.sleep(3600)
            return (
                0 if fault == "empty" and take(folder, pose["view"], joints, seed, empty=True) else int(fault == "fail")
            )
    if "far" in faults and before and abs(joints[0] - before[0][0]) > _SHORT:
        return 3
    return 0 if take(folder, pose["view"], joints, seed) else 3


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), sys.argv[2:]))
