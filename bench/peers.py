"""This project and its peers on the same scans and start poses, alternating: seconds, and distance from the true part.

Run: python bench/peers.py --python PYTHON [--rounds 5] [--seed 11]

PYTHON belongs to an environment with numpy, plyfile, open3d and small_gicp. The table goes into docs/large-sessions.md.
Whole commands, from files to a merged cloud; stitch also finds the hand-eye, tests the views and writes its page, or as
a second row, all that and the recording.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from batch import into_page
from numpy.typing import NDArray
from plyfile import PlyData

from data_synth.fixtures.part_distance import off_surface
from data_synth.fixtures.quiet_scenes import mesh_of
from stitch import frames
from stitch.measurement.capture import build_capture
from stitch.reading.session_folder import load_session

Array = NDArray[np.float64]
ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "large-sessions.md"
SCENE = "blade"
_STITCH = "from stitch.cli.main import main; main()"


def begun(session: Path) -> Array:
    """T_reference_scanner (V, 4, 4) of the robot and the hand-eye that the session states."""
    loaded = load_session(session)
    assert loaded.scanner.T_mount is not None
    poses = np.array([view.T_base_flange for view in loaded.views])
    return build_capture(loaded.name, (), poses, loaded.mount).poses(loaded.scanner.T_mount)


def distances(clouds: list[Array], poses: Array, truth: dict[str, list[list[float]]]) -> Array:
    """(N,) of all points from the true part (mm), after the rigid motion that no scan can tell."""
    true = np.array(truth["poses"])
    found, right = (
        np.concatenate([frames.transform(T, c) for T, c in zip(p, clouds, strict=True)]) for p in (poses, true)
    )
    a, b = found.mean(axis=0), right.mean(axis=0)
    U, _, Vt = np.linalg.svd((found - a).T @ (right - b))
    R = Vt.T @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ U.T
    in_part = frames.transform(frames.inverse(np.array(truth["T_reference_part"])), (found - a) @ R.T + b)
    return np.abs(off_surface(mesh_of(SCENE), in_part)[0])


def timed(command: list[str]) -> float:
    """Seconds of a whole command."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    start = time.perf_counter()
    subprocess.run(command, env=environment, check=True, capture_output=True)
    return time.perf_counter() - start


def compare(python: str, rounds: int, seed: int, folder: Path) -> list[str]:
    """The table."""
    session, start = folder / "cell", folder / "start.npy"
    subprocess.run([sys.executable, "-c", _STITCH, "synth", SCENE, str(session), "--seed", str(seed)], check=True)
    np.save(start, begun(session))
    files = sorted((session / "clouds").iterdir())
    clouds = [np.column_stack([PlyData.read(str(f))["vertex"][axis] for axis in "xyz"]).astype(float) for f in files]
    truth = json.loads(session.with_suffix(".truth.json").read_text())
    ours = [sys.executable, "-c", _STITCH, "run", str(session), "--force", "-o"]
    theirs = [python, str(ROOT / "bench" / "peer_programs.py")]
    commands = {"stitch run --no-recording": [*ours, str(folder / "run"), "--no-recording"]}
    commands |= {"stitch run": [*ours, str(folder / "run")]}
    for name in ("open3d", "small_gicp"):
        commands[name] = [*theirs, name, str(session / "clouds"), str(start), str(folder / f"{name}.npy")]
    seconds = {name: [] for name in commands}
    for _ in range(rounds):
        for name, command in commands.items():
            seconds[name].append(timed(command))
    run = json.loads((folder / "run" / "result.json").read_text())
    poses = {name: np.load(folder / f"{name}.npy") for name in ("open3d", "small_gicp")}
    poses |= dict.fromkeys(list(commands)[:2], np.array([view["pose"] for view in run["views"]]))
    first = np.array(next(iter(seconds.values())))
    rows = []
    for name in commands:
        off, ratio = distances(clouds, poses[name], truth), np.array(seconds[name]) / first
        rows.append(
            f"| {name} | {np.median(seconds[name]):.1f} ({min(seconds[name]):.1f} … {max(seconds[name]):.1f}) | "
            f"{np.median(ratio):.2f} ({ratio.min():.2f} … {ratio.max():.2f}) | {1e3 * np.median(off):.1f} | "
            f"{1e3 * np.quantile(off, 0.95):.1f} |"
        )
    return [
        f"{SCENE}, seed {seed}: {len(clouds)} views, {sum(map(len, clouds)):,} points, {os.cpu_count()} cores, "
        f"{rounds} rounds one after the other; median (least … most)",
        "",
        "| | s | times the first | median µm off the part | 95 % µm |",
        "|---|---:|---:|---:|---:|",
        *rows,
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--python", required=True)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seed", type=int, default=11)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        lines = compare(given.python, given.rounds, given.seed, Path(name))
    print("\n".join(lines))
    into_page("peers", lines, PAGE)


if __name__ == "__main__":
    main()
