"""What `stitch fit` does: parts fitted, shown, drawn, as map and path and as a session."""

import json
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from stitch.cells.outputs import show
from stitch.cells.window import scan_session
from stitch.cells.window.allowance import read_allowance
from stitch.cells.window.fit_sentences import NO_UNIT, agreement, details
from stitch.cells.window.window_jobs import FitJob, read_fit_job
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
    _print(console(), job, parts)
    for name in written:
        print(f"{output}/{name}")


def _print(terminal: Console, job: FitJob, parts: list[Part]) -> None:
    for i, part in enumerate(parts):
        terminal.print(agreement(job, part, f"Part {i + 1}" if len(parts) > 1 else "The part"))
        for line in details(job, part):
            terminal.print(f"  {line}")
    if job.length_unit is None:
        terminal.print(NO_UNIT)
