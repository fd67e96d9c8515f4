"""What `stitch fit` does: parts fitted, shown, drawn, as map and path and as a session."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console

from stitch.cells.outputs import show
from stitch.cells.window import scan_session
from stitch.cells.window.allowance import allowance_sentence, read_allowance
from stitch.cells.window.window_jobs import read_fit_job
from stitch.cells.window.window_solution import Part, fit_document, fit_parts, write_fit
from stitch.system.console import console
from stitch.writing.session_files import write_session


def fitted_parts(
    file: Path,
    allowance: str | None,
    output: Path | None,
    recording: Path | None,
    report: Path | None,
    *,
    session: Path | None,
    as_json: bool,
) -> None:
    """Fit the parts of a job and hand out what was asked for.

    Raises:
        InputError, NoResultError: as `stitch fit` ends.
    """
    wanted = read_allowance(allowance)
    job = replace(read_fit_job(file), wanted=wanted)
    parts = fit_parts(job)
    written = write_fit(job, parts, output) if output is not None else []
    if session is not None:
        write_session(session, scan_session.session(file.stem, job.placed, job.cad_file))
    show("fit", recording, report, job, parts)
    if as_json:
        print(json.dumps(fit_document(job, parts), indent=1))
        return
    terminal = console()
    for i, part in enumerate(parts):
        _print(terminal, i + 1, part)
    for name in written:
        print(f"{output}/{name}")


def _print(terminal: Console, number: int, part: Part) -> None:
    found, cells = part.fit, part.deviations.cells
    x, y, z = found.T_base_part[:3, 3]
    terminal.print(
        f"Part {number}: origin {x:.3f} {y:.3f} {z:.3f} in the base, σ {found.sigma[3:].max():.4f} and "
        f"{np.degrees(found.sigma[:3]).max():.5f}°; distances {found.scale:.3f} robust, {found.rms:.3f} rms."
    )
    if found.allowance is not None:
        terminal.print(f"  {allowance_sentence(found.allowance)}")
    if part.start.runner_up > 0.9 * part.start.share:
        terminal.print(
            f"  Another pose meets {part.start.runner_up:.0%} of the scan, this one {part.start.share:.0%}: the part "
            "is nearly symmetric, or too little of it was scanned."
        )
    bad = part.deviations.outside
    if bad.any():
        worst = int(np.argmax(np.abs(cells.mean)))
        at = " ".join(f"{value:.0f}" for value in cells.middle[worst])
        terminal.print(
            f"  {bad.sum()} of {len(bad)} cells beyond {part.deviations.tolerance:g}; worst "
            f"{cells.mean[worst]:+.2f} at {at}."
        )
    else:
        terminal.print(f"  All {len(bad)} cells within {part.deviations.tolerance:g}.")
    for name, count in part.forbidden.items():
        if count:
            terminal.print(f"  {count} points in forbidden region {name}; they did not count.")
