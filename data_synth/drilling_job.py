"""Writes a drilling cell as the files that `stitch drill` reads; truth stays with the cell."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from data_synth.csv_rows import POSE, write_rows
from data_synth.drilling_cell import GROUPS, HEIGHT, IMAGE, DrillingCell
from stitch import frames

_JOB = f"""# A drilling job: where must the robot be sent so that the holes come where they belong?
#   stitch drill job.toml -o drives.csv
format = "stitch-drill/1"
length_unit = "mm"
height = {HEIGHT}          # of the work plane along the flange's z
image_size = [{IMAGE[0]}, {IMAGE[1]}]   # pixels; only needed with checks
plate = "plate.csv"      # nine holes: x, y, z in the flange frame, u, v in the image
holes = "holes.csv"      # the drawing, in the base frame: position, unit vector into the part
placed = "placed.csv"    # where the servo loop ended on each reference hole: reported tool pose, u, v, height h'
# Optional:
rangers = "rangers.csv"  # per ranger: planes a x + b y + c z + d = 0 in the flange frame, and the reading
joint1 = "joint1.csv"    # a marker's path while joint 1 turns right-handed about the base's z, measuring system
joint6 = "joint6.csv"    # the same for joint 6 and x
checks = "checks.csv"    # one hole seen at many places and heights: shows lens distortion and a wrong plate height
# plate_image = "plate.png"   # a picture of the nine holes: plate.csv then needs no u, v; likewise a column image
#                            # in placed.csv names a picture of each hole; needs the extra `vision`
"""


def write_job(folder: Path, cell: DrillingCell) -> np.ndarray:
    """Write all tables of a job; returns the true T_measuring_base (4, 4)."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "job.toml").write_text(_JOB, encoding="utf-8")
    xyz, uv = cell.plate()
    _table(folder / "plate.csv", "x y z u v", np.hstack([xyz, uv]))
    _table(folder / "checks.csv", "x y z u v", np.hstack(cell.check_holes()))
    planes, readings = cell.plane_readings()
    rows = [[f"L{i + 1}", *plane, d] for i in range(4) for plane, d in zip(planes, readings[i], strict=True)]
    _table(folder / "rangers.csv", "ranger a b c d reading", rows)
    holes = [
        [name, group, kind, *np.concatenate(cell.nominal[name])]
        for group, members in GROUPS.items()
        for kind, names in zip(("reference", "drill"), members, strict=True)
        for name in names
    ]
    _table(folder / "holes.csv", "hole group kind x y z i j k", holes)
    names = sorted({name for references, _ in GROUPS.values() for name in references})
    _table(folder / "placed.csv", f"hole {POSE} u v height", [_placed(cell, name) for name in names])
    return _marker_paths(folder, cell)


def _placed(cell: DrillingCell, name: str) -> list[object]:
    """A reported pose whose true pose lies within the servo's limits of the hole, and what is seen there."""
    rng = cell.rng
    position, direction = cell.actual[name]
    z = direction + np.append(rng.uniform(-0.003, 0.003, 2), 0.0)
    z /= np.linalg.norm(z)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    R_true = np.column_stack([x, np.cross(z, x), z])
    R = R_true @ cell.tool_turn.inv().as_matrix()
    wanted = position - R_true @ np.append(rng.uniform(-0.12, 0.12, 2), rng.uniform(-0.4, 0.4))
    reported = wanted.copy()
    # Each round takes up what the robot's own error moved; the last move keeps its repeatability.
    for _ in range(4):
        reported += wanted - cell.true_pose(frames.make(R, reported))[:3, 3]
    T_true = cell.true_pose(frames.make(R, reported))
    offset = T_true[:3, :3].T @ (position - T_true[:3, 3])
    uv = cell.image((offset + np.array([0.0, 0.0, HEIGHT]))[None])[0] + rng.normal(0, cell.sizes.pixel, 2)
    angles = Rotation.from_matrix(R).as_euler("ZYX", degrees=True)
    return [name, *reported, *angles, *uv, HEIGHT + offset[2] + rng.normal(0, 0.03)]


def _marker_paths(folder: Path, cell: DrillingCell) -> np.ndarray:
    """Circles of a marker about z (joint 1) and about a line along x (joint 6), in a turned measuring system."""
    rng = cell.rng
    T = frames.make(Rotation.random(rng=rng).as_matrix(), rng.normal(0, 1500, 3))
    a = np.radians(np.linspace(-60, 60, 13))
    about_z = np.stack([1500 * np.cos(a), 1500 * np.sin(a), 0 * a + 1200], -1)
    about_x = np.stack([0 * a + 1300, 180 * np.cos(2 * a), 180 * np.sin(2 * a)], -1)
    for name, path in (("joint1.csv", about_z), ("joint6.csv", about_x)):
        seen = frames.transform(T, path) + rng.normal(0, 0.02, path.shape)
        _table(folder / name, "x y z", seen)
    return T


def _table(file: Path, header: str, rows: Iterable[Iterable[object]]) -> None:
    texts = [[value if isinstance(value, str) else f"{value:.6f}" for value in row] for row in rows]
    write_rows(file, header, texts)
