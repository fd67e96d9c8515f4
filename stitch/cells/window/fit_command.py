"""`stitch fit JOB`: where the parts lie, how they differ from their CAD, and the robot path that follows them."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from stitch.cells.outputs import RecordingOption, ReportOption, SessionOption, show
from stitch.cells.window import fit_parts, read_fit_job, scan_session
from stitch.cells.window.allowance import allowance_sentence, read_allowance
from stitch.cells.window.window_solution import Part, fit_document, write_fit
from stitch.system.console import console
from stitch.writing.session_files import write_session


def fit(
    file: Annotated[Path, typer.Argument(metavar="JOB", help="Job file, TOML.")],
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="FOLDER", help="For map and path.")] = None,
    recording: RecordingOption = None,
    report: ReportOption = None,
    session: SessionOption = None,
    allowance: Annotated[
        str | None,
        typer.Option(
            metavar="free|varying|SIZE", help="Stock on a casting, outside = plus: found evenly, varying, or stated."
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON alone on standard output.")] = False,
) -> None:
    """Fit scans onto a CAD model without a guess: pose, deviation map and corrected robot path.

    \b
    Examples:
      stitch fit fit.toml --report page.html
      stitch fit casting.toml --allowance free
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
