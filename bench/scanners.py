"""Several scanners in one cell: hand-eyes together and alone against the truth, one scanner's own effect named."""

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import stitch
from bench.harness import Parts, Row, Table, grouped, markdown, named_shares, share
from data_synth.cells.scanner_cell import KINDS, NAMES, ScannerCell, scanner_cell, write_scanners
from stitch.numerics import frames
from stitch.numerics.frames import Array

# What is hidden in one of the two, times what the cell has at amplitude 1: twice what development seeds could detect.
FAULTS = (("field_curvature", 2.0), ("range_scale", 4.0))
# Of a scanner's frame, where it sees the part, mm.
_MIDDLE = np.array([0.0, 0.0, 420.0])


def jobs(seeds: range) -> Iterator[Row]:
    """Yield every trial."""
    for seed in seeds:
        for kind in KINDS:
            yield {"part": "found", "kind": kind, "seed": seed}
            for fault, amplitude in FAULTS:
                yield {"part": "named", "kind": kind, "fault": fault, "amplitude": amplitude, "seed": seed}


def _run(cell: ScannerCell) -> stitch.Run:
    with tempfile.TemporaryDirectory() as folder:
        return stitch.run([stitch.load_session(path) for path in write_scanners(Path(folder), cell)])


def _off(true: Array, found: Array, covariance: Array) -> dict[str, float]:
    twist = frames.log(frames.inverse(true) @ found)
    moved = frames.transform(found, _MIDDLE) - frames.transform(true, _MIDDLE)
    square = float(twist @ np.linalg.solve(covariance, twist)) / 6
    return {"chi2": square, "off": 1e3 * float(np.linalg.norm(moved))}


def found(job: Row) -> Row:
    """Return both hand-eyes against the truth, together and alone, and what is named where nothing is hidden."""
    cell = scanner_cell(job["kind"], job["seed"])
    run = _run(cell)
    diagnosis = stitch.diagnose(run)
    scanners = []
    for k, place in enumerate(run.scanners):
        own = place.alone
        assert own is not None
        together = _off(cell.T_mount[k], place.T_mount, place.covariance)
        alone = _off(cell.T_mount[k], own.hand_eye, own.covariance)
        scanners.append({"U": place.U, "U_alone": place.U_alone, "together": together, "alone": alone})
    doubts = sum("contradicts" in doubt for doubt in run.doubts)
    return {"scanners": scanners, "doubts": doubts, "verdict": diagnosis.verdict, "effects": list(diagnosis.effects)}


def named(job: Row) -> Row:
    """Return what a diagnosis names where one scanner errs."""
    whose = job["seed"] % 2
    diagnosis = stitch.diagnose(_run(scanner_cell(job["kind"], job["seed"], {job["fault"]: (whose, job["amplitude"])})))
    true = f"{job['fault']}@{NAMES[whose]}"
    return {"true": true, "verdict": diagnosis.verdict, "effects": list(diagnosis.effects)}


def _found_lines(rows: list[Row]) -> list[str]:
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


def _named_lines(rows: list[Row]) -> list[str]:
    groups = grouped(rows, "kind", "fault").items()
    table = [(kind, f"`{fault}`", str(len(of)), *named_shares(of)) for (kind, fault), of in groups]
    return markdown("cell | hidden in one | cells | named for that one | in a group | wrong", table)


_PARTS = Parts({"found": (found, _found_lines), "named": (named, _named_lines)})
TABLE = Table(jobs, _PARTS.trial, _PARTS.summary, range(400, 420), page="several-scanners", block="scanners")
