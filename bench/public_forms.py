"""Ten forms in which other people publish poses, through `stitch init`: written down before they were built for.

Found in public repositories by the names of their fields; the first line of each writer says what is right.
"""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bench.drawn_folders import answered
from bench.harness import Row, Table, markdown
from bench.intake import campaigns
from data_synth.fixtures.drawn_folders import Truth
from data_synth.fixtures.field_folders import Array, Campaign, ply

K = [615.3, 0.0, 321.7, 0.0, 615.1, 240.2, 0.0, 0.0, 1.0]


def _scans(folder: Path, c: Campaign, name: str, scale: float) -> list[str]:
    names = [name.format(i) for i in range(len(c.clouds))]
    for file, points in zip(names, c.clouds, strict=True):
        (folder / file).parent.mkdir(exist_ok=True)
        ply(folder / file, points * scale)
    return [Path(file).stem for file in names]


def _metres(T: Array) -> Array:
    return np.concatenate([T[:, :, :3], T[:, :, 3:] * [[1e-3], [1e-3], [1e-3], [1.0]]], axis=2)


def _rows(M: Array) -> str:
    return "\n".join(" ".join(f"{x:.9g}" for x in row) for row in M)


def bop(folder: Path, c: Campaign) -> list[str]:
    """scene_camera.json of BOP: cam_R_w2c and cam_t_w2c (mm) are T_camera_world; cam_K is the lens."""
    inverse = np.linalg.inv(c.T)
    lens = {"cam_K": K, "depth_scale": 1.0}
    told = {
        str(i): lens | {"cam_R_w2c": T[:3, :3].ravel().tolist(), "cam_t_w2c": T[:3, 3].tolist()}
        for i, T in enumerate(inverse)
    }
    (folder / "scene_camera.json").write_text(json.dumps(told))
    return _scans(folder, c, "{:06d}.ply", 1.0)


def bundler(folder: Path, c: Campaign) -> list[str]:
    """bundle.out v0.3: of each camera f k1 k2, the rows of R, and t, which map world to camera."""
    text = f"# Bundle file v0.3\n{len(c.T)} 0\n"
    for T in _metres(np.linalg.inv(c.T)):
        text += f"1234.5 -0.01 0.002\n{_rows(T[:3, :3])}\n{_rows(T[None, :3, 3])}\n"
    (folder / "bundle.out").write_text(text)
    return _scans(folder, c, "view{:02d}.ply", 1e-3)


def record3d(folder: Path, c: Campaign) -> list[str]:
    """metadata.json of Record3D: poses are qx qy qz qw px py pz, metres; K is the lens."""
    poses = np.column_stack([c.R.as_quat(), c.p / 1e3]).tolist()
    (folder / "metadata.json").write_text(json.dumps({"w": 720, "h": 960, "K": K, "fps": 60, "poses": poses}))
    return _scans(folder, c, "{}.ply", 1e-3)


def scanner_app(folder: Path, c: Campaign) -> list[str]:
    """frame_00000.json of 3D Scanner App: cameraPoseARFrame by rows, beside a projection and a lens; metres."""
    projection = np.array([[1.7, 0, 0.01, 0], [0, 2.3, 0, 0], [0, 0, -1, -2e-3], [0, 0, -1, 0]])
    for i, T in enumerate(_metres(c.T)):
        told = {"cameraPoseARFrame": T.ravel().tolist(), "intrinsics": K}
        told |= {"projectionMatrix": projection.ravel().tolist()}
        told |= {"mvp": (projection @ T).ravel().tolist(), "time": 12.4 + i, "frame_index": i}
        (folder / f"frame_{i:05d}.json").write_text(json.dumps(told))
    return _scans(folder, c, "frame_{:05d}.ply", 1e-3)


def rostopic(folder: Path, c: Campaign) -> list[str]:
    """rostopic echo -p: field.pose.position.x …, field.pose.orientation.w; metres."""
    head = "%time,field.header.seq,field.header.stamp,field.header.frame_id,"
    head += ",".join(f"field.pose.position.{a}" for a in "xyz") + ","
    head += ",".join(f"field.pose.orientation.{a}" for a in "xyzw")
    rows = [
        f"{1700000000 + 5 * i}000000000,{i},{1700000000 + 5 * i}000000000,base_link,"
        + ",".join(f"{x:.9f}" for x in row)
        for i, row in enumerate(np.column_stack([c.p / 1e3, c.R.as_quat()]))
    ]
    (folder / "pose.csv").write_text("\n".join([head, *rows]) + "\n")
    return _scans(folder, c, "cloud_{}.ply", 1e-3)


def franka(folder: Path, c: Campaign) -> list[str]:
    """States of a Franka arm: O_T_EE by columns, metres; joints beside it have no URDF."""
    joints = np.random.default_rng(1).uniform(-2, 2, (len(c.T), 7))
    head = ["time", *(f"O_T_EE[{i}]" for i in range(16)), *(f"q[{i}]" for i in range(7))]
    flat = np.column_stack([np.arange(len(c.T)) * 8.0, _metres(c.T).transpose(0, 2, 1).reshape(-1, 16), joints])
    rows = [",".join(f"{x:.9g}" for x in row) for row in flat]
    (folder / "robot_state.csv").write_text("\n".join([",".join(head), *rows]) + "\n")
    return _scans(folder, c, "pc{:02d}.ply", 1e-3)


def nuscenes(folder: Path, c: Campaign) -> list[str]:
    """ego_pose.json of nuScenes: rotation w first, translation in metres, timestamps in µs."""
    told = [
        {"token": f"{i * 7919:032x}", "timestamp": 1532402927647951 + 500000 * i, "rotation": q, "translation": p}
        for i, (q, p) in enumerate(zip(c.wxyz.tolist(), (c.p / 1e3).tolist(), strict=True))
    ]
    (folder / "ego_pose.json").write_text(json.dumps(told, indent=0))
    return _scans(folder, c, "sweep_{:02d}.ply", 1e-3)


def mvsnet(folder: Path, c: Campaign) -> list[str]:
    """cams/00000000_cam.txt of MVSNet: the extrinsic maps world to camera, mm; intrinsic and depths stand below."""
    (folder / "cams").mkdir()
    for i, T in enumerate(np.linalg.inv(c.T)):
        text = f"extrinsic\n{_rows(T)}\n\nintrinsic\n{_rows(np.reshape(K, (3, 3)))}\n\n425.0 2.5\n"
        (folder / "cams" / f"{i:08d}_cam.txt").write_text(text)
    return _scans(folder, c, "{:08d}.ply", 1.0)


def middlebury(folder: Path, c: Campaign) -> list[str]:
    """blade_par.txt of Middlebury: a name, K, R and t of x ~ K [R t] X, so that R and t map world to camera."""
    rows = [
        f"blade{i:04d}.png " + " ".join(f"{x:.9g}" for x in (*K, *T[:3, :3].ravel(), *T[:3, 3]))
        for i, T in enumerate(_metres(np.linalg.inv(c.T)))
    ]
    (folder / "blade_par.txt").write_text("\n".join([str(len(rows)), *rows]) + "\n")
    return _scans(folder, c, "blade{:04d}.ply", 1e-3)


def metashape(folder: Path, c: Campaign) -> list[str]:
    """Omega, phi, kappa of Metashape: turns about x, y, z of the camera in the world, degrees; the matrix beside."""
    head = "# CoordinateSystem: Local Coordinates (m)\n#Label,X,Y,Z,Omega,Phi,Kappa," + ",".join(
        f"r{i}{k}" for i in "123" for k in "123"
    )
    rows = [
        f"IMG_{i:04d}," + ",".join(f"{x:.9g}" for x in (*p, *angles, *R.ravel()))
        for i, (p, angles, R) in enumerate(zip(c.p / 1e3, c.euler("XYZ"), c.T[:, :3, :3], strict=True))
    ]
    (folder / "cameras.txt").write_text("\n".join([head, *rows]) + "\n")
    return _scans(folder, c, "IMG_{:04d}.ply", 1e-3)


FORMS: tuple[Callable[[Path, Campaign], list[str]], ...] = (
    bop, bundler, record3d, scanner_app, rostopic, franka, nuscenes, mvsnet, middlebury, metashape,
)  # fmt: skip


def jobs(seeds: range) -> Iterator[Row]:
    """Every form."""
    yield from ({"form": form.__name__, "seed": seeds[0]} for form in FORMS)


def trial(job: Row) -> Row:
    """What becomes of a form, asked and answered."""
    campaign = campaigns(job["seed"])["arm"]
    write = next(form for form in FORMS if form.__name__ == job["form"])
    with TemporaryDirectory() as scratch:
        folder, out = Path(scratch) / "scans", Path(scratch) / "session"
        folder.mkdir()
        names = write(folder, campaign)
        unit = "mm" if job["form"] in ("bop", "mvsnet") else "m"
        answers = {"unit": unit, "cloud_unit": unit, "mount": "eye_in_hand"}
        truth = Truth(tuple(names), campaign.T, tuple(range(len(names))), "", answers)
        outcome, asked, told, _ = answered(folder, out, truth, campaign.clouds)
    return {"outcome": outcome, "asked": asked, "told": told}


def summary(rows: list[Row]) -> list[str]:
    """A line a form, and how many are right."""
    right = sum(row["outcome"] == "right" and len(row["asked"]) < 2 for row in rows)
    lines = [[row["form"], row["outcome"], ", ".join(row["asked"]) or "–"] for row in rows]
    return [*markdown("form | what becomes of it | asked", lines), "", f"{right} of {len(rows)} right."]


FOUND = Table(jobs, trial, summary, range(41, 42))
