"""This project and its peers on the same scans and start poses, alternating: seconds, and distance from the true part.

Run: python bench/peers.py --python PYTHON [--rounds 1]

PYTHON belongs to an environment with numpy, plyfile, open3d and small_gicp. Table and picture of
docs/large-sessions.md: quality against time over cells, the peers with their clouds thinned to several grids, as their
users tune them. Whole commands, from files to a merged cloud; stitch also finds the hand-eye, tests the views and
writes its page, or as a second row, all that and the recording.
"""

import argparse
import itertools
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
from stitch.numerics import frames
from stitch.session.capture import build_capture
from stitch.session.reading.session_folder import load_session

Array = NDArray[np.float64]
ROOT = Path(__file__).resolve().parents[1]
PAGE, PICTURE = ROOT / "docs" / "large-sessions.md", ROOT / "docs" / "pictures" / "peers.png"
CELLS = (("blade", 11), ("blade", 12), ("blade", 15), ("blade-table", 16), ("car-door", 17))
VOXELS = (0.0, 1.0, 1.5, 2.0)  # mm
PEERS = ("open3d", "small_gicp")
OURS = ("stitch run --no-recording", "stitch run")
_STITCH = "from stitch.cli.main import main; main()"


def begun(session: Path) -> Array:
    """T_reference_scanner (V, 4, 4) of the robot and the hand-eye that the session states."""
    loaded = load_session(session)
    assert loaded.scanner.T_mount is not None
    poses = np.array([view.T_base_flange for view in loaded.views])
    return build_capture(loaded.name, (), poses, loaded.mount).poses(loaded.scanner.T_mount)


def distances(scene: str, clouds: list[Array], poses: Array, truth: dict[str, list[list[float]]]) -> Array:
    """(N,) of all points from the true part (mm), after the rigid motion that no scan can tell."""
    true = np.array(truth["poses"])
    found, right = (
        np.concatenate([frames.transform(T, c) for T, c in zip(p, clouds, strict=True)]) for p in (poses, true)
    )
    a, b = found.mean(axis=0), right.mean(axis=0)
    U, _, Vt = np.linalg.svd((found - a).T @ (right - b))
    R = Vt.T @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ U.T
    in_part = frames.transform(frames.inverse(np.array(truth["T_reference_part"])), (found - a) @ R.T + b)
    return np.abs(off_surface(mesh_of(scene), in_part)[0])


def timed(command: list[str]) -> float:
    """Seconds of a whole command."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    start = time.perf_counter()
    subprocess.run(command, env=environment, check=True, capture_output=True)
    return time.perf_counter() - start


def measured(python: str, rounds: int, scene: str, seed: int, folder: Path) -> tuple[dict[str, list[float]], int]:
    """Of one cell per program: seconds (the median), median and 95 % distance from the part (µm); and its points."""
    session, start = folder / "cell", folder / "start.npy"
    subprocess.run([sys.executable, "-c", _STITCH, "synth", scene, str(session), "--seed", str(seed)], check=True)
    np.save(start, begun(session))
    files = sorted((session / "clouds").iterdir())
    clouds = [np.column_stack([PlyData.read(str(f))["vertex"][axis] for axis in "xyz"]).astype(float) for f in files]
    truth = json.loads(session.with_suffix(".truth.json").read_text())
    ours = [sys.executable, "-c", _STITCH, "run", str(session), "--force", "-o", str(folder / "run")]
    theirs = [python, str(ROOT / "bench" / "peer_programs.py")]
    commands = {OURS[0]: [*ours, "--no-recording"], OURS[1]: ours}
    for name, voxel in itertools.product(PEERS, VOXELS):
        out = str(folder / f"{name} {voxel}.npy")
        commands[f"{name} {voxel}"] = [*theirs, name, str(voxel), str(session / "clouds"), str(start), out]
    seconds = {name: [] for name in commands}
    for _ in range(rounds):
        for name, command in commands.items():
            seconds[name].append(timed(command))
    run = json.loads((folder / "run" / "result.json").read_text())
    poses = {name: np.load(folder / f"{name}.npy") for name in commands if name not in OURS}
    poses |= dict.fromkeys(OURS, np.array([view["pose"] for view in run["views"]]))
    off = {name: 1e3 * distances(scene, clouds, poses[name], truth) for name in commands}
    found = {name: [np.median(seconds[name]), *np.quantile(off[name], (0.5, 0.95)).tolist()] for name in commands}
    return found, sum(map(len, clouds))


def tables(cells: list[dict[str, list[float]]], points: list[int], rounds: int) -> list[str]:
    """Medians over all cells, and each cell by itself."""
    first, rows = np.array([cell[OURS[0]] for cell in cells]), []
    for name in cells[0]:
        own = np.array([cell[name] for cell in cells])
        ratio, ahead = own[:, 0] / first[:, 0], ((own < first)[:, :2]).all(axis=1).sum()
        rows.append(
            f"| {_shown(name)} | {np.median(own[:, 0]):.1f} | {np.median(ratio):.2f} ({ratio.min():.2f} … "
            f"{ratio.max():.2f}) | {np.median(own[:, 1]):.1f} | {np.median(own[:, 2]):.1f} | "
            f"{'' if name in OURS else ahead} |"
        )
    every = [
        f"| {scene}, seed {seed} | {count:,} | "
        + " | ".join(f"{s:.1f}, {off:.1f}" for s, off, _ in cell.values())
        + " |"
        for (scene, seed), count, cell in zip(CELLS, points, cells, strict=True)
    ]
    return [
        f"{len(CELLS)} cells, {os.cpu_count()} cores; medians over the cells, rounds in turns: {rounds}. Beside a peer "
        "stands its grid in mm; without one it has all points.",
        "",
        "| | s | times the first (least … most) | median µm off the part | 95 % µm | cells where faster and nearer |",
        "|---|---:|---:|---:|---:|---:|",
        *rows,
        "",
        "Seconds and median µm off the part in each cell:",
        "",
        "| cell | points | " + " | ".join(map(_shown, cells[0])) + " |",
        "|---|" + "---:|" * (1 + len(cells[0])),
        *every,
    ]


def _shown(name: str) -> str:
    return name.removesuffix(" 0.0").removeprefix("stitch ")


def compare(python: str, rounds: int) -> list[str]:
    """The tables; the picture is drawn beside them."""
    cells, points = [], []
    for scene, seed in CELLS:
        with tempfile.TemporaryDirectory() as name:
            found, count = measured(python, rounds, scene, seed, Path(name))
        cells.append(found)
        points.append(count)
        print(scene, seed, {name: np.round(own, 1).tolist() for name, own in found.items()}, flush=True)
    draw(cells)
    return tables(cells, points, rounds)


def draw(cells: list[dict[str, list[float]]]) -> None:
    """Quality against time: a line for each peer over its grids, and this project's whole command."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 4.2), layout="constrained")
    for name, colour in zip(PEERS, ("tab:orange", "tab:green"), strict=True):
        own = [np.median([cell[f"{name} {voxel}"] for cell in cells], axis=0) for voxel in VOXELS]
        axes.plot(
            [s for s, _, _ in own], [off for _, off, _ in own], "o-", color=colour, label=f"{name}, alignment alone"
        )
        for voxel, (s, off, _) in zip(VOXELS, own, strict=True):
            axes.annotate(
                f"{voxel:g} mm" if voxel else "all points", (s, off), (5, 5), textcoords="offset points", fontsize=8
            )
    for name, sign in zip(OURS, ("o", "s"), strict=True):
        s, off, _ = np.median([cell[name] for cell in cells], axis=0)
        axes.plot(s, off, sign, color="tab:blue", label=name)
    axes.set(xlabel="seconds, from files to a merged cloud", ylabel="median distance from the true part, µm")
    axes.set_xlim(left=0)
    axes.set_yscale("log")
    axes.legend()
    figure.savefig(PICTURE, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--python", required=True)
    parser.add_argument("--rounds", type=int, default=1)
    given = parser.parse_args()
    lines = compare(given.python, given.rounds)
    print("\n".join(lines))
    into_page("peers", lines, PAGE)


if __name__ == "__main__":
    main()
