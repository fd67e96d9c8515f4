"""Cells with external axes, and with several scanners: what is found against the truth, and what is named.

AXES: places found with their sigma, the cloud beside an arm's alone, and a ball as a rival. A table, a rail, a
positioner stated wrongly by 1 mm and 1 mrad, or not at all; hand-eyes likewise searched. The rival places a turntable
as is usual: a ball on it, its centre fitted in every view, a circle through the centres.

SCANNERS: hand-eyes together and alone, one scanner's own effect named.
"""

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

import stitch
from bench.harness import Parts, Row, Table, grouped, markdown, named_shares, share
from data_synth.cells.axis_cell import AxisCell, axis_cell, write_cell
from data_synth.cells.scanner_cell import KINDS as SCANNER_KINDS
from data_synth.cells.scanner_cell import NAMES, ScannerCell, scanner_cell, write_scanners
from stitch.numerics import frames
from stitch.numerics.feature_matching import align_points
from stitch.numerics.frames import Array

KINDS = ("turntable", "table-arm", "rail-arm", "tilt-turn")
# Twice what views of development seeds could detect, as a multiple of what the cell hides at amplitude 1.
FAULTS = (
    ("turntable", "axis_eccentricity", 0.11),
    ("turntable", "axis_wobble", 0.18),
    ("table-arm", "axis_eccentricity", 1.05),
    ("table-arm", "axis_wobble", 0.4),
    ("rail-arm", "axis_pitch", 0.7),
    ("rail-arm", "axis_scale", 0.45),
)
# A component of an axis counts where its sigma is no accident of the axis' own direction.
_COUNTS = 0.2
# What is hidden in one of the two, times what the cell has at amplitude 1: twice what development seeds could detect.
SCANNER_FAULTS = (("field_curvature", 2.0), ("range_scale", 4.0))
# Of a scanner's frame, where it sees the part, mm.
_MIDDLE = np.array([0.0, 0.0, 420.0])


def jobs(seeds: range, faulty: int = 8) -> Iterator[Row]:
    """Yield every trial; those that a page needs first."""
    for seed in seeds:
        for kind in KINDS:
            for how in ("off by 1", "unknown"):
                yield {"part": "found", "kind": kind, "how": how, "seed": seed}
        yield {"part": "found", "kind": "arm", "how": "no axis", "seed": seed}
        for kind, fault, amplitude in FAULTS if seed < seeds.start + faulty else ():
            yield {"part": "named", "kind": kind, "fault": fault, "amplitude": amplitude, "seed": seed}


def _stated(cell: AxisCell, seed: int, known: bool) -> list[dict[str, Any]]:
    rng = np.random.default_rng([seed, 77])
    tables = []
    for axis in cell.axes:
        direction, point = cell.stated(axis)
        across = np.linalg.svd(direction[None])[2][1:]
        turn, shift = (_unit(rng.standard_normal(2)) @ across for _ in range(2))
        table = {"direction": (direction + 1e-3 * turn).tolist()}
        tables.append(table | ({"point": (point + shift).tolist()} if axis.kind == "rotary" else {}) if known else {})
    return tables


def _unit(v: Array) -> Array:
    return v / np.linalg.norm(v)


def _run(cell: AxisCell, tables: list[dict[str, Any]]) -> stitch.Run:
    with tempfile.TemporaryDirectory() as folder:
        write_cell(Path(folder) / "s", cell, tables)
        return stitch.run(stitch.load_session(Path(folder) / "s"))


def found(job: Row) -> Row:
    """Return errors of axes and hand-eye over their sigma, of the cloud, and what is named where nothing is hidden."""
    cell = axis_cell(job["kind"], job["seed"])
    try:
        run = _run(cell, _stated(cell, job["seed"], job["how"] == "off by 1"))
    except stitch.NoResultError as error:
        return {"failed": str(error)}
    ratios = []
    for axis, place in zip(cell.axes, run.axes, strict=True):
        direction, point = cell.stated(axis)
        pairs = [(place.direction - direction, place.direction_sigma)]
        if place.point is not None:
            pairs.append((place.point - point - direction * (direction @ (place.point - point)), place.point_sigma))
        for off, sigma in pairs:
            counts = ~(sigma < _COUNTS * np.nanmax(sigma))
            ratios += (off[counts] / sigma[counts]).tolist()
    hand_eye: list[float] = []
    if cell.T_base_flange is not None:
        off = frames.log(frames.inverse(cell.T_mount) @ run.T_mount)
        hand_eye = (off / np.sqrt(np.diag(run.mount_covariance))).tolist()
    row: Row = {"axes": ratios, "hand_eye": hand_eye}
    row |= {"cloud": cloud_error(cell, run.poses), "model": cloud_error(cell, run.poses_model)}
    if job["how"] != "unknown":
        diagnosis = stitch.diagnose(run)
        row |= {"verdict": diagnosis.verdict, "effects": list(diagnosis.effects)}
    if job["kind"] == "turntable" and job["how"] != "unknown":
        row |= {"ball": _by_ball(cell, job["seed"]), "ours": _off(cell, run.axes[0].direction, run.axes[0].point)}
        row["ours"].append(row["model"])
    return row


def cloud_error(cell: AxisCell, poses: Array) -> float:
    """Return the rms distance (µm) of the points of all views from where they are, the cloud put onto the truth."""
    return float(1e3 * np.sqrt(np.mean(points_off([cloud.points for cloud in cell.clouds], poses, cell.poses) ** 2)))


def points_off(clouds: list[Array], poses: Array, true_poses: Array) -> Array:
    """Return how far some points of all views lie from where they are, the cloud put onto the truth."""
    some = [points[:: max(len(points) // 300, 1)] for points in clouds]
    put, true = (
        np.concatenate([frames.transform(T, c) for T, c in zip(of_views, some, strict=True)])
        for of_views in (poses, true_poses)
    )
    return np.linalg.norm(frames.transform(align_points(put, true), put) - true, axis=1)


def named(job: Row) -> Row:
    """Return what a diagnosis names where a fault is hidden."""
    cell = axis_cell(job["kind"], job["seed"], {job["fault"]: job["amplitude"]})
    diagnosis = stitch.diagnose(_run(cell, _stated(cell, job["seed"], known=True)))
    return {"true": job["fault"], "verdict": diagnosis.verdict, "effects": list(diagnosis.effects)}


def _by_ball(blade: AxisCell, seed: int) -> list[float]:
    """How far a turntable's axis and the blade's cloud are off, by a ball and a circle through its centres."""
    centres = np.array([_ball_centre(cloud.points) for cloud in axis_cell("turntable", seed, ball=True).clouds])
    middle = centres.mean(axis=0)
    normal = np.linalg.svd(centres - middle)[2][2]
    plane = np.linalg.svd(normal[None])[2][1:]
    flat = (centres - middle) @ plane.T
    x = np.linalg.lstsq(np.column_stack([2 * flat, np.ones(len(flat))]), (flat**2).sum(axis=1), rcond=None)[0]
    point = middle + x[:2] @ plane
    normal = normal * np.sign(normal @ blade.in_scanner(blade.axes[0])[0])
    A = [frames.exp(np.append(normal * -q, np.cross(point, normal * -q))) for q in blade.readings[:, 0]]
    return [*_off(blade, normal, point), cloud_error(blade, np.array(A))]


def _off(cell: AxisCell, normal: Array, point: Array) -> list[float]:
    """Angle in mrad, and distance in µm from the true axis."""
    true, at = cell.in_scanner(cell.axes[0])
    offs = np.cross(normal, true), np.cross(true, point - at)
    return [1e3 * float(np.linalg.norm(off)) for off in offs]


def _ball_centre(points: Array) -> Array:
    start = np.linalg.lstsq(np.column_stack([2 * points, np.ones(len(points))]), (points**2).sum(axis=1), rcond=None)[0]
    radius = np.sqrt(start[3] + start[:3] @ start[:3])

    def off(x: Array) -> Array:
        return np.linalg.norm(points - x[:3], axis=1) - x[3]

    fit = least_squares(off, np.append(start[:3], radius), loss="soft_l1", f_scale=0.05)
    return np.asarray(fit.x[:3])


def _found_lines(rows: list[Row]) -> list[str]:
    table = []
    for (kind, how), of in grouped(rows, "kind", "how").items():
        done = [row for row in of if "failed" not in row]
        axes = share(abs(x) <= 3 for row in done for x in row["axes"])
        hand_eye = share(abs(x) <= 3 for row in done for x in row["hand_eye"])
        adequate = share(row["verdict"] == "adequate" for row in done if "verdict" in row)
        clouds = [[row["cloud"] for row in done], [row["model"] for row in done]]
        registered, model = (f"{np.median(x):.1f} ({max(x):.1f})" if x else "–" for x in clouds)
        table.append((kind, how, f"{len(done)} of {len(of)}", axes, hand_eye, registered, model, adequate))
    head = (
        "cell | axis stated | placed | axis within 3 σ | hand-eye within 3 σ | cloud, µm | by the model, µm | adequate"
    )
    return [*markdown(head, table), "", *_ball_lines([row for row in rows if "ball" in row])]


def _named_lines(rows: list[Row]) -> list[str]:
    groups = grouped(rows, "kind", "fault").items()
    table = [(kind, f"`{fault}`", *named_shares(of)) for (kind, fault), of in groups]
    return markdown("cell | hidden | named | in a group | wrong", table)


def _ball_lines(rows: list[Row]) -> list[str]:
    table = []
    for name, key in (("a ball, a circle through its centres", "ball"), ("the blade's own scans", "ours")):
        angle, place, cloud = np.median([row[key] for row in rows], axis=0)
        table.append((name, f"{angle:.3f}", f"{place:.1f}", f"{cloud:.1f}"))
    return markdown("turntable placed by | direction, mrad | place, µm | cloud by the model, µm", table)


_AXES = Parts({"found": (found, _found_lines), "named": (named, _named_lines)})
AXES = Table(jobs, _AXES.trial, _AXES.summary, range(200, 220), page="axes", block="axes", settings={"faulty": 8})


def scanner_jobs(seeds: range) -> Iterator[Row]:
    """Yield every trial."""
    for seed in seeds:
        for kind in SCANNER_KINDS:
            yield {"part": "found", "kind": kind, "seed": seed}
            for fault, amplitude in SCANNER_FAULTS:
                yield {"part": "named", "kind": kind, "fault": fault, "amplitude": amplitude, "seed": seed}


def _run_scanners(cell: ScannerCell) -> stitch.Run:
    with tempfile.TemporaryDirectory() as folder:
        return stitch.run([stitch.load_session(path) for path in write_scanners(Path(folder), cell)])


def _off_hand_eye(true: Array, found: Array, covariance: Array) -> dict[str, float]:
    twist = frames.log(frames.inverse(true) @ found)
    moved = frames.transform(found, _MIDDLE) - frames.transform(true, _MIDDLE)
    square = float(twist @ np.linalg.solve(covariance, twist)) / 6
    return {"chi2": square, "off": 1e3 * float(np.linalg.norm(moved))}


def found_scanners(job: Row) -> Row:
    """Return both hand-eyes against the truth, together and alone, and what is named where nothing is hidden."""
    cell = scanner_cell(job["kind"], job["seed"])
    run = _run_scanners(cell)
    diagnosis = stitch.diagnose(run)
    scanners = []
    for k, place in enumerate(run.scanners):
        own = place.alone
        assert own is not None
        together = _off_hand_eye(cell.T_mount[k], place.T_mount, place.covariance)
        alone = _off_hand_eye(cell.T_mount[k], own.hand_eye, own.covariance)
        scanners.append({"U": place.U, "U_alone": place.U_alone, "together": together, "alone": alone})
    doubts = sum("contradicts" in doubt for doubt in run.doubts)
    return {"scanners": scanners, "doubts": doubts, "verdict": diagnosis.verdict, "effects": list(diagnosis.effects)}


def named_scanner(job: Row) -> Row:
    """Return what a diagnosis names where one scanner errs."""
    whose = job["seed"] % 2
    diagnosis = stitch.diagnose(
        _run_scanners(scanner_cell(job["kind"], job["seed"], {job["fault"]: (whose, job["amplitude"])}))
    )
    true = f"{job['fault']}@{NAMES[whose]}"
    return {"true": true, "verdict": diagnosis.verdict, "effects": list(diagnosis.effects)}


def _scanner_lines(rows: list[Row]) -> list[str]:
    table = []
    for kind, of in grouped(rows, "kind").items():
        every = [scanner for row in of for scanner in row["scanners"]]
        chi2, alone = (np.mean([s[how]["chi2"] for s in every]) for how in ("together", "alone"))
        off, off_alone = (np.median([s[how]["off"] for s in every]) for how in ("together", "alone"))
        ratio = np.median([s["U"] / s["U_alone"] for s in every])
        smaller = share(s["U"] < s["U_alone"] for s in every)
        adequate = share(row["verdict"] == "adequate" for row in of)
        wrong = share(bool(row["effects"]) for row in of)
        against = (f"{chi2:.2f} ({alone:.2f})", f"{off:.0f} ({off_alone:.0f})", f"{ratio:.2f}")
        table.append((kind, str(len(of)), *against, smaller, adequate, wrong))
    head = "cell | cells | χ²/6 (alone) | off at the part, µm (alone) | U over alone | smaller | adequate | wrong name"
    return markdown(head, table)


def _scanner_named_lines(rows: list[Row]) -> list[str]:
    groups = grouped(rows, "kind", "fault").items()
    table = [(kind, f"`{fault}`", str(len(of)), *named_shares(of)) for (kind, fault), of in groups]
    return markdown("cell | hidden in one | cells | named for that one | in a group | wrong", table)


_SCANNERS = Parts({"found": (found_scanners, _scanner_lines), "named": (named_scanner, _scanner_named_lines)})
SCANNERS = Table(
    scanner_jobs, _SCANNERS.trial, _SCANNERS.summary, range(400, 420), page="several-scanners", block="scanners"
)
