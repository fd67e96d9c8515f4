"""Both window jobs from their readings to their results and files."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stitch import frames
from stitch.cells.pose_table import POSE_COLUMNS, rows_from_poses, write_columns, write_poses
from stitch.cells.window.allowance import Allowance
from stitch.cells.window.cad_fit import CadFit, fit_cad
from stitch.cells.window.cad_start import CadStart, find_cad_start
from stitch.cells.window.deviation import Deviations, measure_deviations, write_deviation_csv, write_deviation_ply
from stitch.cells.window.instances import split_instances
from stitch.cells.window.path_correction import correct_path
from stitch.cells.window.regions import coverage
from stitch.cells.window.seam import Seam, measure_seam
from stitch.cells.window.window_jobs import FitJob, SeamJob
from stitch.errors import NoResultError
from stitch.frames import Array


@dataclass(frozen=True)
class FittedPart:
    """One part found in the scan."""

    start: CadStart
    fit: CadFit
    deviations: Deviations
    coverage: dict[str, float]  # of expected regions
    forbidden: dict[str, int]  # usable points in forbidden regions
    path: Array | None  # (N, 4, 4) corrected T_base_tool


def fit_parts(job: FitJob) -> list[FittedPart]:
    """Start, fit and map every part; largest first.

    Raises:
        NoResultError: a part is not found, or an expected region is not covered.
    """
    return [_fit_part(job, scan) for scan in split_instances(job.scan, job.cad, job.instances)]


def _fit_part(job: FitJob, scan: Any) -> FittedPart:
    start = find_cad_start(scan, job.cad)
    found = fit_cad(scan, job.cad, start.T_base_part, job.regions, job.allowance_prior)
    T = frames.inverse(found.T_base_part)
    local, normals = frames.transform(T, scan.points[scan.usable]), frames.rotate(T, scan.normals[scan.usable])
    covered = {box.name: coverage(box, job.cad, local, normals) for box in job.regions.expected}
    for name, share in covered.items():
        if share < job.coverage:
            raise NoResultError(
                f"expected region {name}: only {share:.0%} of it was scanned, {job.coverage:.0%} wanted; scan it, or "
                "lower `coverage`"
            )
    forbidden = {box.name: int(box.holds(local).sum()) for box in job.regions.forbidden}
    path = None
    if job.path is not None and job.T_base_part_nominal is not None:
        path = correct_path(job.path[1], job.T_base_part_nominal, found.T_base_part)
    mapped = measure_deviations(
        scan, job.cad, found.T_base_part, tolerance=job.tolerance, cell=job.cell, allowance=found.allowance
    )
    return FittedPart(start, found, mapped, coverage=covered, forbidden=forbidden, path=path)


def fit_document(job: FitJob, parts: list[FittedPart]) -> dict[str, Any]:
    """Plain data for JSON; length_unit of the CAD, degrees."""
    return {"format": "stitch-fit-result/1", "noise": job.scan.noise, "parts": [_part_document(p) for p in parts]}


def _part_document(part: FittedPart) -> dict[str, Any]:
    cells = part.deviations.cells
    worst = int(np.argmax(np.abs(cells.mean))) if len(cells.mean) else None
    pose = rows_from_poses(part.fit.T_base_part[None])[0].tolist()
    return {
        "T_base_part": part.fit.T_base_part.tolist(),
        "pose": dict(zip(POSE_COLUMNS.split(), pose, strict=True)),
        "sigma": part.fit.sigma[3:].tolist(),
        "sigma_deg": np.degrees(part.fit.sigma[:3]).tolist(),
        "scale": part.fit.scale,
        "rms": part.fit.rms,
        "inliers": part.fit.inliers,
        "points": part.fit.points,
        "start_share": part.start.share,
        "start_runner_up": part.start.runner_up,
        "cells": len(cells.mean),
        "cells_outside": int(part.deviations.outside.sum()),
        "worst": None if worst is None else {"at": cells.middle[worst].tolist(), "deviation": float(cells.mean[worst])},
        "coverage": part.coverage,
        "points_in_forbidden": part.forbidden,
        **({} if part.fit.allowance is None else {"allowance": _allowance_document(part.fit.allowance)}),
    }


def _allowance_document(allowance: Allowance) -> dict[str, Any]:
    return {
        "value": allowance.value,
        "sigma": allowance.sigma,
        "kind": "varying" if allowance.prior.varying else "free" if allowance.prior.free else "stated",
        "lowest": allowance.lowest,
        "highest": allowance.highest,
        "sigma_field": allowance.sigma_field,
        "told_apart": allowance.separable_share,
    }


def write_fit(job: FitJob, parts: list[FittedPart], folder: Path) -> list[str]:
    """fit.json, and for each part its map and path; returns the files' names."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "fit.json").write_text(json.dumps(fit_document(job, parts), indent=1) + "\n", encoding="utf-8")
    written = ["fit.json"]
    for i, part in enumerate(parts):
        tail = f"-{i + 1}" if len(parts) > 1 else ""
        names = [f"deviation{tail}.ply", f"deviation{tail}.csv"]
        write_deviation_ply(folder / names[0], part.deviations)
        write_deviation_csv(folder / names[1], part.deviations)
        if part.path is not None and job.path is not None:
            names.append(f"path{tail}.csv")
            write_poses(folder / names[-1], "name", job.path[0], part.path)
        written += names
    return written


def solve_seam(job: SeamJob) -> list[Seam]:
    """Flush and gap at every station.

    Raises:
        NoResultError: no station could be measured.
    """
    seams = measure_seam(job.scan, job.T_base_part, job.stations, job.limits, job.pose_sigma)
    if all(seam.verdict == "not measured" for seam in seams):
        raise NoResultError(f"no station could be measured; the first: {seams[0].reason}")
    return seams


def write_seam(seams: list[Seam], file: Path) -> None:
    """One row per station."""
    names = ("station", "flush", "gap", "sigma_flush", "sigma_gap", "verdict", "reason")
    write_columns(file, {name: [getattr(seam, name) for seam in seams] for name in names})
