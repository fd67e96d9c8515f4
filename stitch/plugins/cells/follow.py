"""`stitch fit JOB --follow`: where a part stands that moves, from scan to scan.

A line on standard input names a table of scans, as `scans` in the job; a line of JSON answers it: T_base_part with its
sigma, the path moved with the part, and how long the answer took. Each fit begins at the pose before, so that nothing
is sought anew; the pose holds for the time at which the scans were taken.
"""

import json
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from stitch.errors import InputError, NoResultError
from stitch.numerics import frames
from stitch.plugins.cells.job_files import POSE_COLUMNS, Wanted, rows_from_poses
from stitch.plugins.cells.placed_scans import assemble_scans, read_scan_table
from stitch.plugins.cells.scan_to_cad import CadFit, fit_cad, read_allowance, split_instances
from stitch.plugins.cells.window import FitJob, correct_path, fit_part, read_fit_job

# Points that scatter about the CAD so many times as much as when the part was found do not lie on it.
_LOST = 3.0


def follow_part(job: FitJob, found: CadFit, tables: Iterable[str]) -> Iterator[dict[str, Any]]:
    """Yield an answer to each table of scans; `lost` where the part is not there: the next begins at the last pose.

    Args:
        found: the part before it moved, or as it moved when it was found.
        tables: names of files, a line each.

    Raises:
        InputError: a table that is missing or malformed.
    """
    T_base_part = found.T_base_part
    for line in tables:
        begun = time.perf_counter()
        answer: dict[str, Any] = {"scans": line.strip()}
        placed = read_scan_table(Path(line.strip()))
        errors = job.placed.errors
        if errors is not None:
            errors = replace(errors, T_base_flange=placed.T_base_scanner @ frames.inverse(errors.T_flange_scanner))
        try:
            fit = fit_cad(assemble_scans(placed), job.cad, T_base_part, job.regions, job.allowance_prior, errors)
            if fit.scale > _LOST * found.scale:
                raise NoResultError(
                    f"points scatter by {fit.scale:.3g} about the CAD, {found.scale:.3g} when it was found"
                )
        except NoResultError as error:
            yield answer | {"lost": str(error), "latency_s": time.perf_counter() - begun}
            continue
        T_base_part = fit.T_base_part
        answer |= {"T_base_part": T_base_part.tolist()}
        answer |= {"sigma": fit.sigma[3:].tolist(), "sigma_deg": np.degrees(fit.sigma[:3]).tolist()}
        if job.path is not None and job.T_base_part_nominal is not None:
            path = rows_from_poses(correct_path(job.path[1], job.T_base_part_nominal, T_base_part)).tolist()
            poses = (dict(zip(POSE_COLUMNS.split(), row, strict=True)) for row in path)
            answer["path"] = dict(zip(job.path[0], poses, strict=True))
        yield answer | {"latency_s": time.perf_counter() - begun}


def run_follow(file: Path, allowance: str | None, wanted: Wanted) -> None:
    """Find the part of a job, then answer standard input until it ends; `InputError` and `NoResultError` end it."""
    if wanted != Wanted():
        raise InputError("--follow writes answers alone; to fix: leave out the other outputs, or run without --follow")
    job = replace(read_fit_job(file), allowance_prior=read_allowance(allowance))
    (scan,) = split_instances(job.scan, job.cad, 1)
    for answer in follow_part(job, fit_part(job, scan).fit, sys.stdin):
        print(json.dumps(answer), flush=True)
