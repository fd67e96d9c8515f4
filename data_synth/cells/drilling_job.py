"""Writes a drilling cell as the files that `stitch drill` reads; truth stays with the cell."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from data_synth.cells.drilling import GROUPS, HEIGHT, HOLE_DIAMETER, IMAGE, DrillingCell
from data_synth.csv_rows import POSE, pose_numbers, write_rows
from stitch.numerics import frames

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


def write_trials(folder: Path, cell: DrillingCell) -> None:
    """Drive to every hole to drill by the drawing, by a correction of the simulator's own, and along the normal.

    trials.csv holds what rangers and camera see; a pin of 4.69 mm is then driven 87 mm into the levelled holes.
    """
    rows = []
    for references, holes in GROUPS.values():
        nominal, actual = (np.array([place[name][0] for name in references]) for place in (cell.nominal, cell.reached))
        turn = Rotation.align_vectors(actual - actual.mean(axis=0), nominal - nominal.mean(axis=0))[0]
        for name in holes:
            position, direction = cell.nominal[name]
            at = turn.apply(position - nominal.mean(axis=0)) + actual.mean(axis=0)
            drives = {
                "drawing": frames.make(_hole_frame(direction), position),
                "corrected": frames.make(_hole_frame(turn.apply(direction)) @ cell.tool_turn.inv().as_matrix(), at),
            }
            drives["levelled"] = _levelled(cell, name, drives["corrected"])
            for stage, T in drives.items():
                ranges, uv = cell.measure(name, T)
                rows.append([name, stage, *uv, *ranges, HOLE_DIAMETER + float(cell.rng.uniform(0.0, 0.1))])
    _table(folder / "trials.csv", "hole stage u v L1 L2 L3 L4 diameter", rows)
    job = folder / "job.toml"
    text = job.read_text(encoding="utf-8")
    job.write_text(f'{text}trials = "trials.csv"\n\n[pin]\ndiameter = 4.69\nfeed = 87.0\n', encoding="utf-8")


def _levelled(cell: DrillingCell, name: str, T_base_tool: np.ndarray) -> np.ndarray:
    """The pose turned about the tool's tip until the tool stands along the hole, to within the servo's limit."""
    true = T_base_tool[:3, :3] @ cell.tool_turn.as_matrix()
    wanted = cell.actual[name][1] + cell.rng.normal(0, 0.0015, 3)
    turn = Rotation.align_vectors(wanted[None] / np.linalg.norm(wanted), true[None, :, 2])[0]
    return np.asarray(frames.make(turn.as_matrix() @ T_base_tool[:3, :3], T_base_tool[:3, 3]))


def write_locating(folder: Path, cell: DrillingCell, T_measuring_base: np.ndarray) -> None:
    """Give the plate in its own frame, and its four locating holes as the measuring system sees them at home."""
    rng = cell.rng
    home = frames.make(np.column_stack([[0, 1.0, 0], [0, 0, 1.0], [1.0, 0, 0]]), [1250.0, 0.0, 0.0])
    T_flange_plate = frames.make(np.eye(3), [0.0, 0.0, HEIGHT])
    corners = np.array([[x, y, 0.0] for x in (-60.0, 60.0) for y in (-60.0, 60.0)])
    seen = frames.transform(T_measuring_base @ home @ T_flange_plate, corners) + rng.normal(0, 0.01, corners.shape)
    _table(folder / "locating.csv", "x y z seen_x seen_y seen_z", np.hstack([corners, seen]))
    plate = np.genfromtxt(folder / "plate.csv", delimiter=",", skip_header=1)
    plate[:, :3] = frames.transform(frames.inverse(T_flange_plate), plate[:, :3])
    _table(folder / "plate.csv", "x y z u v", plate)
    job = folder / "job.toml"
    pose = "\n".join(f"{key} = {value}" for key, value in zip(POSE.split(), pose_numbers(home, 9), strict=True))
    text = job.read_text(encoding="utf-8")
    job.write_text(f'{text}locating = "locating.csv"\n\n[home]\n{pose}\n', encoding="utf-8")


def _hole_frame(direction: np.ndarray) -> np.ndarray:
    """R_base_tool (3, 3) with z along a direction, x level."""
    z = direction / np.linalg.norm(direction)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def _placed(cell: DrillingCell, name: str) -> list[object]:
    """A reported pose whose true pose lies within the servo's limits of the hole, and what is seen there."""
    rng = cell.rng
    position, direction = cell.actual[name]
    R_true = _hole_frame(direction + np.append(rng.uniform(-0.003, 0.003, 2), 0.0))
    R = R_true @ cell.tool_turn.inv().as_matrix()
    wanted = position - R_true @ np.append(rng.uniform(-0.12, 0.12, 2), rng.uniform(-0.4, 0.4))
    reported = wanted.copy()
    # Each round takes up what the robot's own error moved; the last move keeps its repeatability.
    for _ in range(4):
        reported += wanted - cell.true_pose(frames.make(R, reported))[:3, 3]
    T_true = cell.true_pose(frames.make(R, reported))
    offset = T_true[:3, :3].T @ (position - T_true[:3, 3])
    cell.reached[name] = (reported + R @ offset, direction)
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
