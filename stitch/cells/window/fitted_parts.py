"""What `stitch fit` does: parts fitted, shown, drawn, as map and path and as a session."""

import json
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from stitch.cells.outputs import write_recording_and_page
from stitch.cells.window import scan_session
from stitch.cells.window.allowance import read_allowance
from stitch.cells.window.fit_sentences import NO_UNIT, agreement_sentence, detail_sentences
from stitch.cells.window.window_jobs import FitJob, read_fit_job
from stitch.cells.window.window_solution import FittedPart, fit_document, fit_parts, write_fit
from stitch.system.console import console
from stitch.writing.session_files import write_session


def run_fit(
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
    job = replace(read_fit_job(file), allowance_prior=wanted)
    parts = fit_parts(job)
    written = write_fit(job, parts, output) if output is not None else []
    if session is not None:
        write_session(session, scan_session.scan_session(file.stem, job.placed, job.cad_file))
    write_recording_and_page("fit", recording, report, job, parts)
    if as_json:
        print(json.dumps(fit_document(job, parts), indent=1))
        return
    _print_parts(console(), job, parts)
    for name in written:
        print(f"{output}/{name}")


def _print_parts(terminal: Console, job: FitJob, parts: list[FittedPart]) -> None:
    for i, part in enumerate(parts):
        terminal.print(agreement_sentence(job, part, f"Part {i + 1}" if len(parts) > 1 else "The part"))
        for line in detail_sentences(job, part):
            terminal.print(f"  {line}")
    if job.length_unit is None:
        terminal.print(NO_UNIT)
