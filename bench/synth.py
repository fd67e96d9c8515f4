"""Speed and memory of the simulator, and the size of its laws: writes the tables of docs/synth.md.

Run: python bench/synth.py [--pixels N] [--views N]
"""

import argparse
import os
import resource
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from data_synth.fixtures.part_distance import off_surface
from data_synth.fixtures.quiet_scenes import clean, simulated
from data_synth.nature import LAWS
from data_synth.scene import load_scene
from data_synth.simulate import Measured, simulate
from data_synth.write import write_session
from stitch.numerics import frames

PAGE = Path(__file__).resolve().parents[1] / "docs" / "synth.md"
SEEDS = range(4)
# Scenes of laws that the blade on the arm does not show.
_SHOWN_BY = {"latency": "line-sweep", "mount_droop": "blade-table"}


def megabytes() -> float:
    """Peak memory of this process so far; Linux counts in kilobytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000


def speed_table(pixels: int, views: int) -> list[str]:
    scene = load_scene("blade")
    scene = replace(scene, scanner=replace(scene.scanner, columns=pixels, rows=pixels))
    start = time.perf_counter()
    measured = simulate(scene, {"joint_compliance": 1.0}, 0, views)
    simulated = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        write_session(Path(folder) / "s", measured, "s")
        size = sum(path.stat().st_size for path in (Path(folder) / "s" / "clouds").iterdir())
    written = time.perf_counter()
    points = sum(len(cloud.points) for cloud in measured.clouds) / views
    return [
        f"Blade, {views} views of {pixels} x {pixels} rays, {os.cpu_count()} cores:", "",
        "| points a view | rays | simulate / s | write / s | on disk / MB | peak memory / MB |",
        "|---:|---:|---:|---:|---:|---:|",
        f"| {points:,.0f} | {views * pixels**2:,} | {simulated - start:.1f} | {written - simulated:.1f} | "
        f"{size / 1e6:.0f} | {megabytes():.0f} |",
    ]  # fmt: skip


def misfit(measured: Measured) -> tuple[float, float]:
    """µm from the part under the reported poses and the true hand-eye: rms and largest view's rms."""
    scene = measured.scene
    T = measured.T_base_flange
    T_reference_scanner = (frames.inverse(T) if scene.mount == "eye_to_hand" else T) @ measured.T_mount
    T_part_scanner = frames.inverse(scene.T_reference_part) @ T_reference_scanner
    squares = []
    for cloud, pose in zip(measured.clouds, T_part_scanner, strict=True):
        y = frames.transform(pose, cloud.points)
        squares.append(np.mean(off_surface(measured.mesh, y)[0] ** 2))
    return 1e3 * float(np.sqrt(np.mean(squares))), 1e3 * float(np.sqrt(np.max(squares)))


def law_table() -> list[str]:
    lines = ["| law | parameters drawn at amplitude 1, seed 0 | rms / µm | worst view / µm |", "|---|---|---:|---:|"]
    for name in LAWS:
        scene = clean(_SHOWN_BY.get(name, "blade"), noise=0.0)
        runs = [simulated(scene, {name: 1.0}, seed, 12) for seed in SEEDS]
        found = np.array([misfit(run) for run in runs])
        parameters = ", ".join(f"{k} = {v:.2g}" for k, v in runs[0].hidden[name].items())
        rms, worst = np.sqrt((found**2).mean(axis=0))
        lines.append(f"| {name} | {parameters} | {rms:.0f} | {worst:.0f} |")
    return lines


def write(name: str, lines: list[str]) -> None:
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    page = PAGE.read_text(encoding="utf-8")
    text = "\n".join([begin, *lines, end])
    PAGE.write_text(page.split(begin)[0] + text + page.split(end)[1], encoding="utf-8")
    print("\n".join(lines))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pixels", type=int, default=2300)
    parser.add_argument("--views", type=int, default=18)
    options = parser.parse_args()
    write("speed", speed_table(options.pixels, options.views))
    write("laws", law_table())


if __name__ == "__main__":
    main()
