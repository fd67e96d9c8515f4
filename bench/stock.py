"""A view with stock on it, or displaced by as much: what `stitch run` says, and where it puts the view.

A blade is scanned in a cell of the simulator (`data_synth`), in which one view sees the part before stock was ground
off: all of it, or a half or a third along the blade (`blade_with_stock`). In as many cells the pose of one view is
wrong by as much, shifted in any direction or turned so that the part moves by that. Sessions are written as folders
and run by the command; what it found is read from result.json.
"""

import json
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bench.harness import Row, Table, grouped, markdown, share, stitch_process, with_all
from data_synth.fixtures.blade_cells import blade_with_stock, captured, measured_blade
from data_synth.simulate import Measured
from data_synth.write import write_session
from stitch.fusion.register import METHODS, register
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.observations.surfaces.hand_eye_fit import capture_repeatability
from stitch.observations.surfaces.view_poses import unconstrained_poses
from stitch.output.stored_run import load_run
from stitch.run_data import RunData

SIZES, PARTS = (0.1, 0.2, 0.3, 0.5), {"all": 1.0, "half": 0.5, "a third": 1 / 3}
MOUNTS, VIEWS, PIXELS = ("eye_to_hand", "eye_in_hand"), 12, 90
_SCANS = ("as it came", "taken off")


def jobs(seeds: range) -> Iterator[Row]:
    """A stock and a displaced view for each seed; sizes and parts change with it."""
    for k, seed in enumerate(seeds):
        size, part = list(product(SIZES, PARTS))[k % 12]
        mount = MOUNTS[k // 12 % 2]
        yield {"kind": "stock", "size": size, "part": part, "mount": mount, "seed": seed}
        yield {"kind": "displaced", "size": size, "part": ("shifted", "turned")[k % 2], "mount": mount, "seed": seed}


def cell(job: Row) -> tuple[Measured, int]:
    """Return what was measured, and the view that is odd."""
    rng = np.random.default_rng([job["seed"], 67])
    view = int(rng.integers(VIEWS))
    settings = {"views": VIEWS, "mount": job["mount"], "pixels": PIXELS}
    if job["kind"] == "stock":
        from_top = bool(rng.integers(2))

        def stock(along: Array) -> Array:
            return job["size"] * ((1 - along if from_top else along) <= PARTS[job["part"]])

        return blade_with_stock(job["seed"], [view], stock, **settings), view
    measured = measured_blade(job["seed"], **settings)
    direction = rng.standard_normal(3)
    direction *= job["size"] / np.linalg.norm(direction)
    T = np.array(measured.T_base_flange)
    if job["part"] == "shifted":
        T[view] = frames.make(np.eye(3), direction) @ T[view]
    else:
        # About the middle of what the view shows, by as much at a blade's half length.
        middle = measured.T_reference_scanner[view] @ np.append(measured.clouds[view].points.mean(axis=0), 1.0)
        at = np.linalg.inv(T[view]) @ middle if job["mount"] == "eye_in_hand" else middle
        to_middle = frames.make(np.eye(3), at[:3])
        turn = frames.exp(np.append(direction / (0.5 * measured.mesh.extents.max()), np.zeros(3)))
        T[view] = T[view] @ to_middle @ turn @ np.linalg.inv(to_middle)
    return replace(measured, T_base_flange=T), view


def trial(job: Row) -> Row:
    """Run one cell by the command, and hold what it says of the odd view against the truth."""
    measured, view = cell(job)
    name = f"v{view:03d}"
    with TemporaryDirectory() as folder:
        session, out = Path(folder) / "session", Path(folder) / "run"
        write_session(session, measured, "blade")
        stitch_process("run", session, "-o", out)
        result = json.loads((out / "result.json").read_text(encoding="utf-8"))
        said = result.get("stock", [])
        row: Row = {
            "said": [[stock["view"], stock["thickness"], stock["sigma"], stock["share"]] for stock in said],
            "right": [stock["view"] for stock in said] == [name],
            "left_out": [item["view"] for item in result.get("left_out", [])],
        }
        if job["kind"] == "stock":
            sigma = next((stock["pose_sigma"] for stock in said if stock["view"] == name), None)
            row |= _poses(load_run(out), measured, view, sigma) if name not in row["left_out"] else {}
    return row


def _poses(run: RunData, measured: Measured, view: int, sigma: list[float] | None) -> Row:
    """Return the view's pose error in sigmas as stated, and in µm by each method: from scans as they came, and without
    stock."""
    kept = [int(name[1:]) for name in run.session.names]
    own = kept.index(view)
    true = measured.T_reference_scanner[kept]
    capture = run.measurement.capture
    raw = captured(measured).without(np.setdiff1d(np.arange(VIEWS), kept))
    scatter = capture_repeatability(capture, unconstrained_poses(capture, run.poses_model, run.gate), run.T_mount)
    middle = frames.transform(run.poses[own], capture.scans[own].points.mean(axis=0)[None])[0]
    row: Row = {} if sigma is None else {"pose_sigmas": (_error(middle, run.poses, true, own) / sigma).tolist()}
    for name, method in METHODS.items():
        for scans, of_scans in zip(_SCANS, (raw, capture), strict=True):
            poses = register(of_scans, run.poses_model, scatter, run.gate, method=method).poses
            row[f"{name}, {scans}"] = 1e3 * float(np.linalg.norm(_error(middle, poses, true, own)[3:]))
    return row


def _error(middle: Array, poses: Array, true: Array, own: int) -> Array:
    """Return (6,) twist about a point (3,) by which one pose is off, beside the mean of the others."""
    to_middle = frames.make(np.eye(3), -middle)
    twists = frames.log(to_middle @ poses @ frames.inverse(to_middle @ true))
    return twists[own] - np.delete(twists, own, axis=0).mean(axis=0)


def summary(rows: list[Row]) -> list[str]:
    """Return what was said by size and part, of displaced views, and the methods side by side."""
    groups = grouped(rows, "kind")
    stock = groups.get("stock", [])
    lines = []
    for (size, part), group in with_all(grouped(stock, "size", "part"), ("all", "")).items():
        said = [row for row in group if row["right"]]
        z = [(row["said"][0][1] - row["size"]) / row["said"][0][2] for row in said]
        off = [np.abs(row["pose_sigmas"]).max() for row in group if "pose_sigmas" in row]
        error = [1e3 * (row["said"][0][1] - row["size"]) for row in said]
        rms = f"{np.sqrt(np.mean(np.square(error))):.1f}" if error else "–"
        shares = [share(row["right"] for row in group), share(abs(x) < 3 for x in z), share(x < 3 for x in off)]
        lines.append([size, part, shares[0], rms, *shares[1:]])
    out = markdown("stock / mm | on | said | rms error / µm | within 3 σ | pose within 3 σ", lines)
    displaced = groups.get("displaced", [])
    called = [
        [size, share(row["said"] for row in group), share(row["left_out"] for row in group)]
        for size, group in with_all(grouped(displaced, "size")).items()
    ]
    out += ["", *markdown("displaced by / mm | called stock | left out", called), ""]
    posed = [row for row in stock if "dpwvm, taken off" in row]
    by_method = [
        [name, *(f"{np.sqrt(np.mean([row[f'{name}, {scans}'] ** 2 for row in posed])):.1f}" for scans in _SCANS)]
        for name in METHODS
    ]
    return out + markdown("pose error of the view, rms / µm | from scans as they came | stock taken off", by_method)


TABLE = Table(jobs, trial, summary, range(6800, 6840), "register", "stock")
