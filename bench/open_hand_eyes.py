"""Machines that leave the hand-eye open: what a run knows lies within its U, what it does not is never a number.

Run: python bench/open_hand_eyes.py [--seeds 3 4] [--only NAME]; writes the table of docs/integrity.md. A wavy plate,
ten views, 20 µm of noise, poses that scatter by 20 µm and 0.02 mrad; each session is run as it is and with a hand-eye
stated that is off by 3 mm and 5 mrad, and every format of `stitch export` is tried on both.
"""

import argparse
import json
import re
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from batch import into_page
from field_folders import command
from plyfile import PlyData
from scipy.spatial.transform import Rotation

from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.in_memory import session_of
from stitch.api.session import Session
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.plugins.export.formats import ARM, CLOUD, HAND_EYE
from stitch.session.robot import Robot, forward

PAGE = Path(__file__).resolve().parents[1] / "docs" / "integrity.md"
X = frames.make(Rotation.from_rotvec([0.08, -0.12, 0.75]).as_matrix(), np.array([62.0, -38.0, 95.0]))
OFF = frames.exp(np.array([0.003, -0.003, 0.0025, 2.0, -1.5, 1.5]))
VIEWS, AWAY, HALF, NOISE = 10, 400.0, 70.0, 0.02
NUMBERS = ("x", "y", "z", "rx", "ry", "rz")
# Why an export is refused, by its words.
REFUSED = {"do not show": "not shown", "robot": "no arm", "needs the package": "its package is not installed"}


def flange_poses(kind: str, rng: np.random.Generator, robot: Robot) -> tuple[Array, Array | None]:
    """T_base_flange (V, 4, 4) mm of a machine, and the joints (V, n) of an arm."""
    down, none = Rotation.from_rotvec([np.pi, 0, 0]), np.zeros((VIEWS, 3))
    turn = Rotation.from_rotvec(np.outer(np.linspace(-0.6, 0.6, VIEWS), [0, 0, 1]))
    place = np.array([700.0, 100.0, 500.0]) + rng.uniform(-25, 25, (VIEWS, 3))
    if kind == "six-axis, still wrist":
        joints = np.array([0.3, -1.2, 1.4, 0.2, 0.9, -0.4]) + rng.uniform(-0.06, 0.06, (VIEWS, 6)) * [1, 1, 1, 0, 0, 0]
        return forward(robot, joints), joints
    R, p = {
        "gantry": (Rotation.concatenate([down] * VIEWS), place),
        "scara": (turn * down, place + 0.2 * rng.uniform(-25, 25, (VIEWS, 3))),
        "turntable": (turn * down, none + np.array([0.0, 0.0, 500.0])),
    }[kind]
    return frames.make(R.as_matrix(), p), None


def scans(T: Array, rng: np.random.Generator) -> list[Array]:
    """What the scanner sees from its poses of a wavy plate (N, 3), and under the mean of them straight ahead."""
    middle = frames.transform(T, np.array([0, 0, AWAY])).reshape(-1, 3).mean(axis=0)
    plate = frames.make(Rotation.concatenate(Rotation.from_matrix(T[:, :3, :3])).mean().as_matrix(), middle)
    out = []
    for pose in T:
        x, y = rng.uniform(-170, 170, (2, 30_000))
        z = 6 * np.sin(x / 11) * np.cos(y / 15) + 0.002 * x**2 + 4 * np.exp(-((x - 20) ** 2 + (y + 10) ** 2) / 200)
        seen = frames.transform(frames.inverse(pose[None])[0] @ plate, np.column_stack([x, y, z]))
        seen = seen[(np.abs(seen[:, :2]) < HALF).all(axis=1)]
        out.append(seen + NOISE * rng.standard_normal(seen.shape) * [0.1, 0.1, 1.0])
    return out


def session(kind: str, seed: int, stated: bool) -> Session:
    """The session of a machine, with or without a coarse hand-eye."""
    rng = np.random.default_rng([seed, len(kind)])
    robot = session_of(measured_blade(1, views=3, pixels=20, mount="eye_in_hand")).robot
    assert robot is not None
    T, joints = flange_poses(kind, rng, robot)
    err = frames.exp(np.hstack([2e-5 * rng.standard_normal((VIEWS, 3)), 0.02 * rng.standard_normal((VIEWS, 3))]))
    own = {"joints": joints, "robot": robot} if joints is not None else {"poses": T}
    scanner = {"pose": (X @ OFF).tolist(), "noise": NOISE} if stated else {"noise": NOISE}
    own.setdefault("poses", None)
    return Session.from_arrays(
        scans(T @ err @ X, rng), mount="eye_in_hand", scanner=scanner, name="s", check=False, **own
    )


def exported(run: Path) -> dict[str, str]:
    """What becomes of every format: written, written as stated, or refused."""
    out = {}
    for name in (*HAND_EYE, *ARM, *CLOUD):
        file = run / f"exported.{name}"
        done = command("export", str(run), "--to", name, "-o", str(file))
        text = file.read_text(errors="replace") if file.is_file() and name not in CLOUD else ""
        said = "as stated" if "not measured" in text else "written"
        refused = next((why for words, why in REFUSED.items() if words in done.refusal), done.refusal)
        out[name] = f"refused: {refused}" if done.code else said
    return out


def row(kind: str, seed: int, stated: bool, scratch: Path) -> str:
    """A line of the table."""
    folder, run = scratch / "s", scratch / "r"
    for old in (folder, run):
        shutil.rmtree(old, ignore_errors=True)
    session(kind, seed, stated).save(folder)
    done = command("run", str(folder), "-o", str(run), "--no-recording")
    begin = f"| {kind} | {seed} | {'stated' if stated else 'none'} |"
    if done.code:
        return f"{begin} {done.refusal.replace(str(scratch), '')} | – | – | – | – |"
    said = json.loads((run / "result.json").read_text())
    T, unknown = np.array(said["hand_eye"]), said["hand_eye_unknown"]
    numbers, true = (np.hstack([M[:3, 3], Rotation.from_matrix(M[:3, :3]).as_rotvec()]) for M in (T, X))
    line = printed_U(done.said)
    U = [np.nan if NUMBERS[k] in unknown else line.get(NUMBERS[k], np.nan) for k in range(6)]
    off = np.abs(numbers - true) * [1, 1, 1, 1e3, 1e3, 1e3] / U
    printed = "not known" if not any(n in line for n in unknown) else "a number"
    worst = f"{np.nanmax(off):.2f} U" if np.isfinite(off).any() else "–"
    vertex = PlyData.read(str(run / "stitched.ply"))["vertex"]
    cloud = np.column_stack([vertex[a] for a in "xyz"]).mean(axis=0)
    made = exported(run)
    groups = {name: {made[x] for x in names} for name, names in (("e", HAND_EYE), ("arm", ARM), ("cloud", CLOUD))}
    cells = [
        ", ".join(unknown) or "nothing",
        printed if unknown else "–",
        worst,
        f"{np.linalg.norm(cloud) / 1e3:.2f} m",
    ]
    return f"{begin} {' | '.join(cells)} | {'; '.join(' / '.join(sorted(g)) for g in groups.values())} |"


def printed_U(said: str) -> dict[str, float]:
    """U of every number that is printed with one, by its name."""
    out: dict[str, float] = {}
    for line, names in ((r"position (.*)", NUMBERS[:3]), (r"rotation vector (.*)", NUMBERS[3:])):
        found = re.search(line, said)
        for axis, name in zip("xyz", names, strict=True):
            number = found and re.search(rf"{axis} \S+ ± ([\d.e+-]+)", found[1])
            if number:
                out[name] = float(number[1])
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[31])
    parser.add_argument("--only")
    asked = parser.parse_args()
    lines = [
        "| machine | seed | hand-eye stated | not known | printed as | largest error of what is known | cloud from the "
        "base | hand-eye formats; arm; cloud |",
        "|---|---:|---|---|---|---:|---:|---|",
    ]
    with TemporaryDirectory() as scratch:
        for kind in ("gantry", "scara", "turntable", "six-axis, still wrist"):
            if asked.only and asked.only not in kind:
                continue
            for seed in asked.seeds:
                for stated in (False, True):
                    lines.append(row(kind, seed, stated, Path(scratch)))
                    print(lines[-1], flush=True)
    if not asked.only:
        into_page("open", lines, PAGE)


if __name__ == "__main__":
    main()
