"""Real scans of one rig (folder `reghec` of the shared data), and a synthetic blade of 18 views with 340,000 points."""

import time
from collections.abc import Iterator
from dataclasses import replace
from functools import cache

import numpy as np

from bench.harness import SHARED_DATA, Row, Table, grouped, markdown
from data_synth.fixtures.blade_cells import SCENE_OF_MOUNT, captured, disturbed
from data_synth.scene import load_scene
from data_synth.simulate import simulate
from stitch.api.pipeline import run, run_rig
from stitch.fit.correct import correct
from stitch.fusion.register import register
from stitch.numerics import frames
from stitch.observations.surfaces.matching import sample_points
from stitch.observations.surfaces.normal_equations import collect_overlaps
from stitch.run_data import RunData
from stitch.session.capture import part_size, prepare_capture
from stitch.session.reading.session_folder import load_session

IN_HAND = ("david", "cone", "sphere", "rubik")
OBJECTS = (*IN_HAND, "gripperopen")
MOUNTS = ("eye_to_hand", "eye_in_hand")


def jobs(seeds: range) -> Iterator[Row]:
    """Objects alone, together, in pairs and one after david; a blade for each seed and mount; speed."""
    yield from ({"part": "objects", "object": name} for name in OBJECTS)
    for i, name in enumerate(IN_HAND):
        yield from ({"part": "pairs", "pair": [other, name]} for other in IN_HAND[:i])
    yield {"part": "together"}
    yield from ({"part": "repeated", "object": name} for name in IN_HAND[1:])
    for mount in MOUNTS:
        yield from ({"part": "blade", "mount": mount, "seed": seed} for seed in seeds)
    yield {"part": "speed"}


def trial(job: Row) -> Row:
    """One row of a part."""
    parts = {"objects": _object, "pairs": _pair, "together": _together}
    return {**parts, "repeated": _repeated, "blade": _blade, "speed": _speed}[job["part"]](job)


@cache
def _run_of(name: str) -> RunData:
    return run(load_session(SHARED_DATA / "reghec" / name))


def _object(job: Row) -> Row:
    """Rms of one hand-eye, held out, after register; noise, µm; seconds of all stages."""
    state = _run_of(job["object"])
    lengths = [1e3 * x for x in (state.residual_rms, state.heldout_rms, state.stages[2].rms, state.noise_floor)]
    return {"lengths": lengths, "seconds": sum(stage.seconds for stage in state.stages)}


def _pair(job: Row) -> Row:
    """χ² of the difference of two hand-eyes of one rig."""
    one, other = (_run_of(name) for name in job["pair"])
    xi = frames.log(frames.inverse(other.T_mount) @ one.T_mount)
    return {"chi2": float(xi @ np.linalg.solve(other.mount_covariance + one.mount_covariance, xi))}


def _together(job: Row) -> Row:
    """All four sessions in one fit."""
    joint = run_rig([load_session(SHARED_DATA / "reghec" / name) for name in IN_HAND])
    sigma = np.sqrt(np.diag(joint[0].mount_covariance))[3:]
    best = min(np.sqrt(np.trace(_run_of(name).mount_covariance[3:, 3:])) for name in IN_HAND)
    registered = {name: 1e3 * r.stages[2].rms for name, r in zip(IN_HAND, joint, strict=True)}
    return {"sigma": float(np.linalg.norm(sigma)), "best": float(best), "registered": registered}


def _repeated(job: Row) -> Row:
    """Rms of an object before and after corrections of david's views, µm."""
    david = _run_of("david")
    capture = prepare_capture(load_session(SHARED_DATA / "reghec" / job["object"]))
    model = capture.poses(david.T_mount)
    samples = [sample_points(scan, 3000) for scan in capture.scans]
    poses = (model, frames.exp(david.corrections) @ model)
    before, after = (1e3 * float(collect_overlaps(capture, T, 4.0, samples).gram.rms) for T in poses)
    return {"before": before, "after": after}


def _blade(job: Row) -> Row:
    """Squared error and predicted variance of the hand-eye at the part, mean squared z."""
    scene = load_scene(SCENE_OF_MOUNT[job["mount"]])
    measured = simulate(replace(scene, small=0.0), {}, job["seed"], 12)
    capture = captured(measured)
    start = disturbed(measured.T_mount, 1000 + job["seed"])
    fit = correct([capture], start, 0.35 * part_size([capture])).hand_eye
    xi = frames.log(frames.inverse(measured.T_mount) @ fit.T_mount)
    middle = np.mean([scan.points.mean(axis=0) for scan in capture.scans], axis=0)
    J = np.hstack([-frames.skew(middle), np.eye(3)])
    z = xi / np.sqrt(np.diag(fit.covariance))
    return {
        "error": float(np.sum((J @ xi) ** 2)),
        "predicted": float(np.trace(J @ fit.covariance @ J.T)),
        "z": float(np.mean(z**2)),
    }


def _speed(job: Row) -> Row:
    """Seconds of every stage with a coarse hand-eye given."""
    scene = load_scene("blade")
    measured = simulate(replace(scene, scanner=replace(scene.scanner, columns=330, rows=330)), {}, 0)
    marks = [time.perf_counter()]
    capture = captured(measured)
    marks.append(time.perf_counter())
    start = measured.T_mount @ frames.exp(np.array([0.02, -0.025, 0.015, 4, -5, 4.5]))
    fit = correct([capture], start, 0.35 * part_size([capture]))
    marks.append(time.perf_counter())
    poses = capture.poses(fit.hand_eye.T_mount)
    register(capture, poses, fit.hand_eye.repeatability[0], fit.overlaps[0].gate, start=fit.unconstrained[0].poses)
    marks.append(time.perf_counter())
    return {"seconds": np.diff(marks).tolist(), "points": sum(len(scan.points) for scan in capture.scans)}


def summary(rows: list[Row]) -> list[str]:
    """The tables of all parts that have rows."""
    parts = grouped(rows, "part")
    tables = {"objects": _objects_table, "pairs": _pairs_table, "together": _together_sentence}
    tables |= {"repeated": _repeated_table, "blade": _blade_table, "speed": _speed_table}
    told = "Written by `python bench/run.py real-scans --write`; two cores."
    return [told, "", *(line for p, table in tables.items() if p in parts for line in [*table(parts[p]), ""])]


def _objects_table(rows: list[Row]) -> list[str]:
    lines = ([row["object"], *(f"{x:.0f}" for x in row["lengths"]), f"{row['seconds']:.1f}"] for row in rows)
    head = "object | one hand-eye, rms (µm) | held-out (µm) | after register (µm) | sensor noise (µm) | seconds"
    title = "## Real scans, no hand-eye given (RegHEC: 5 objects, 9 views each)"
    return [title, "", *markdown(head, lines)]


def _pairs_table(rows: list[Row]) -> list[str]:
    return [
        "## The four eye-in-hand objects come from one rig: do their hand-eyes agree?",
        "",
        "Difference squared over the sum of covariances, 6 degrees of freedom; 17.3 is the 95 % limit for six pairs.",
        "",
        *markdown("pair | χ²", ([", ".join(row["pair"]), f"{row['chi2']:.1f}"] for row in rows)),
    ]


def _together_sentence(rows: list[Row]) -> list[str]:
    [row] = rows
    registered = ", ".join(f"{name} {rms:.0f} µm" for name, rms in row["registered"].items())
    return [
        f"Together: one hand-eye, translation sigma {row['sigma']:.2f} mm (best single object {row['best']:.2f} mm); "
        f"after register {registered}."
    ]


def _repeated_table(rows: list[Row]) -> list[str]:
    lines = ([row["object"], f"{row['before']:.0f}", f"{row['after']:.0f}"] for row in rows)
    title = "## Pose errors repeat: corrections learned on david, applied to the same poses before other objects"
    return [title, "", *markdown("object | before (µm) | after (µm)", lines)]


def _blade_table(rows: list[Row]) -> list[str]:
    lines = []
    for mount, group in grouped(rows, "mount").items():
        error, predicted, z = (np.sqrt(np.mean([row[key] for row in group])) for key in ("error", "predicted", "z"))
        lines.append([mount, f"{1e3 * error:.1f}", f"{1e3 * predicted:.1f}", f"{error / predicted:.2f}", f"{z:.2f}"])
    return [
        f"## Synthetic blade, 12 views, {len(group)} seeds, start off by 5° and 30 mm",
        "",
        "Repeatability put in: 20 µm and 20 µrad. z: error over sigma, all six components.",
        "",
        *markdown("mount | rms error at the part (µm) | predicted (µm) | ratio | rms z", lines),
    ]


def _speed_table(rows: list[Row]) -> list[str]:
    [row] = rows
    seconds = [f"{s:.1f}" for s in (*row["seconds"], sum(row["seconds"]))]
    head = "prepare (s) | correct (s) | register (s) | in all (s)"
    return [f"## Speed: 18 views, {row['points']:,} points", "", *markdown(head, [seconds])]


TABLE = Table(jobs, trial, summary, range(20), page="results", block="scans", one_core=False)
