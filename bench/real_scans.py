"""The tables of docs/results.md: real scans, and a synthetic blade of 18 views with 340,000 points.

Usage: python bench/real_scans.py PATH_OF_REGHEC_SESSIONS
"""

import sys
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np

from data_synth.fixtures.blade_cells import SCENE_OF_MOUNT, captured, disturbed
from data_synth.scene import load_scene
from data_synth.simulate import simulate
from stitch.api.pipeline import run, run_rig
from stitch.fit.correct import correct
from stitch.fusion.register import register
from stitch.numerics import frames
from stitch.observations.surfaces.matching import sample_points
from stitch.observations.surfaces.normal_equations import collect_overlaps
from stitch.session.capture import part_size, prepare_capture
from stitch.session.reading.session_folder import load_session

PAGE = Path(__file__).resolve().parents[1] / "docs" / "results.md"
BEGIN, END = "<!-- scans: begin -->", "<!-- scans: end -->"
IN_HAND = ("david", "cone", "sphere", "rubik")
OBJECTS = (*IN_HAND, "gripperopen")


def main(folder: Path) -> None:
    """Print the page."""
    print("Written by `python bench/real_scans.py PATH_OF_REGHEC_SESSIONS`; two cores.\n")
    runs = {name: run(load_session(folder / name)) for name in OBJECTS}
    print("## Real scans, no hand-eye given (RegHEC: 5 objects, 9 views each)\n")
    print("| object | one hand-eye, rms (µm) | held-out (µm) | after register (µm) | sensor noise (µm) | seconds |")
    print("|---|---:|---:|---:|---:|---:|")
    for name, r in runs.items():
        seconds = sum(s.seconds for s in r.stages)
        print(
            f"| {name} | {r.residual_rms * 1e3:.0f} | {r.heldout_rms * 1e3:.0f} | {r.stages[2].rms * 1e3:.0f} "
            f"| {r.noise_floor * 1e3:.0f} | {seconds:.1f} |"
        )
    agreement(runs)
    together(folder, runs)
    repeated(folder, runs)
    synthetic()
    speed()


def agreement(runs) -> None:
    """χ² of the differences of the hand-eyes of one rig."""
    print("\n## The four eye-in-hand objects come from one rig: do their hand-eyes agree?\n")
    print(
        "Difference squared over the sum of covariances, 6 degrees of freedom; 17.3 is the 95 % limit for six pairs.\n"
    )
    print("| pair | χ² |\n|---|---:|")
    for i, a in enumerate(IN_HAND):
        for b in IN_HAND[:i]:
            xi = frames.log(frames.inverse(runs[a].T_mount) @ runs[b].T_mount)
            both = runs[a].mount_covariance + runs[b].mount_covariance
            print(f"| {b}, {a} | {xi @ np.linalg.solve(both, xi):.1f} |")


def together(folder: Path, runs) -> None:
    """All four sessions in one fit."""
    joint = run_rig([load_session(folder / name) for name in IN_HAND])
    sigma = np.sqrt(np.diag(joint[0].mount_covariance))
    best = min(np.sqrt(np.trace(runs[n].mount_covariance[3:, 3:])) for n in IN_HAND)
    print(
        f"\nTogether: one hand-eye, translation sigma {np.linalg.norm(sigma[3:]):.2f} mm "
        f"(best single object {best:.2f} mm); "
        "after register "
        + ", ".join(f"{n} {r.stages[2].rms * 1e3:.0f} µm" for n, r in zip(IN_HAND, joint, strict=True))
        + "."
    )


def repeated(folder: Path, runs) -> None:
    """Corrections of david's views before other objects."""
    print("\n## Pose errors repeat: corrections learned on david, applied to the same poses before other objects\n")
    print("| object | before (µm) | after (µm) |\n|---|---:|---:|")
    david = runs["david"]
    for name in ("cone", "sphere", "rubik"):
        own = prepare_capture(load_session(folder / name))
        model = own.poses(david.T_mount)
        picked = [sample_points(scan, 3000) for scan in own.scans]
        moved = frames.exp(david.corrections) @ model
        before, after = (collect_overlaps(own, poses, 4.0, picked).gram.rms for poses in (model, moved))
        print(f"| {name} | {before * 1e3:.0f} | {after * 1e3:.0f} |")


def synthetic(seeds: int = 20) -> None:
    """True error of the hand-eye at the part against its prediction."""
    print(f"\n## Synthetic blade, 12 views, {seeds} seeds, start off by 5° and 30 mm\n")
    print("Repeatability put in: 20 µm and 20 µrad. z: error over sigma, all six components.\n")
    print("| mount | rms error at the part (µm) | predicted (µm) | ratio | rms z |\n|---|---:|---:|---:|---:|")
    for mount in ("eye_to_hand", "eye_in_hand"):
        rows = [_trial(mount, seed) for seed in range(seeds)]
        error, predicted = (np.sqrt(np.mean([row[i] for row in rows])) * 1e3 for i in (0, 1))
        z = np.sqrt(np.mean([row[2] for row in rows]))
        print(f"| {mount} | {error:.1f} | {predicted:.1f} | {error / predicted:.2f} | {z:.2f} |")


def _trial(mount: str, seed: int) -> tuple[float, float, float]:
    """Squared error and predicted variance at the part, mean squared z."""
    scene = load_scene(SCENE_OF_MOUNT[mount])
    m = simulate(replace(scene, small=0.0), {}, seed, 12)
    c = captured(m)
    found = correct([c], disturbed(m.T_mount, 1000 + seed), 0.35 * part_size([c])).hand_eye
    xi = frames.log(frames.inverse(m.T_mount) @ found.T_mount)
    middle = np.mean([s.points.mean(axis=0) for s in c.scans], axis=0)
    J = np.hstack([-frames.skew(middle), np.eye(3)])
    z = xi / np.sqrt(np.diag(found.covariance))
    return float(np.sum((J @ xi) ** 2)), float(np.trace(J @ found.covariance @ J.T)), float(np.mean(z**2))


def speed() -> None:
    """Seconds of every stage with a coarse hand-eye given."""
    import time

    scene = load_scene("blade")
    m = simulate(replace(scene, scanner=replace(scene.scanner, columns=330, rows=330)), {}, 0)
    marks = [time.perf_counter()]
    c = captured(m)
    marks.append(time.perf_counter())
    found = correct([c], m.T_mount @ frames.exp(np.array([0.02, -0.025, 0.015, 4, -5, 4.5])), 0.35 * part_size([c]))
    marks.append(time.perf_counter())
    poses = c.poses(found.hand_eye.T_mount)
    register(c, poses, found.hand_eye.repeatability[0], found.overlaps[0].gate, start=found.unconstrained[0].poses)
    marks.append(time.perf_counter())
    prepare, corrected, registered = np.diff(marks)
    points = sum(len(s.points) for s in c.scans)
    print(f"\n## Speed: 18 views, {points:,} points\n")
    print("| prepare (s) | correct (s) | register (s) | in all (s) |\n|---:|---:|---:|---:|")
    print(f"| {prepare:.1f} | {corrected:.1f} | {registered:.1f} | {marks[-1] - marks[0]:.1f} |")


if __name__ == "__main__":
    with redirect_stdout(StringIO()) as printed:
        main(Path(sys.argv[1]))
    page = PAGE.read_text(encoding="utf-8")
    text = page.split(BEGIN)[0] + BEGIN + "\n" + printed.getvalue() + END + page.split(END)[1]
    PAGE.write_text(text, encoding="utf-8")
