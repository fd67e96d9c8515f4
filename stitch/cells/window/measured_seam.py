"""What `stitch seam` does: stations measured, shown, drawn, as a table and as a session."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
from rich.table import Table

from stitch.cells.outputs import write_recording_and_page
from stitch.cells.window import scan_session
from stitch.cells.window.seam import Limits, Seam
from stitch.cells.window.seam_sentences import stations_sentence
from stitch.cells.window.window_jobs import read_seam_job
from stitch.cells.window.window_solution import solve_seam, write_seam
from stitch.system.console import console
from stitch.writing.session_files import write_session


def run_seam(
    file: Path, output: Path | None, recording: Path | None, report: Path | None, session: Path | None, *, as_json: bool
) -> None:
    """Measure the stations of a seam and hand out what was asked for.

    Raises:
        InputError, NoResultError: as `stitch seam` ends.
    """
    job = read_seam_job(file)
    seams = solve_seam(job)
    if output is not None:
        write_seam(seams, output)
    if session is not None:
        write_session(session, scan_session.scan_session(file.stem, job.placed))
    write_recording_and_page("seam", recording, report, job, seams)
    if as_json:
        rows = [{k: None if isinstance(v, float) and np.isnan(v) else v for k, v in asdict(s).items()} for s in seams]
        print(json.dumps(rows, indent=1))
        return
    _print_seams(seams, job.limits)
    if output is not None:
        print(output)


def _print_seams(seams: list[Seam], limits: Limits) -> None:
    table = Table(title="Stations, ± 1 σ", title_justify="left")
    for heading in ("station", "flush / mm", "gap / mm", "verdict"):
        table.add_column(heading)
    for s in seams:
        values = (f"{s.flush:+.3f} ± {s.sigma_flush:.3f}", f"{s.gap:.3f} ± {s.sigma_gap:.3f}")
        table.add_row(
            s.station, *(("", "") if s.reason else values), f"{s.verdict}{': ' if s.reason else ''}{s.reason}"
        )
    terminal = console()
    terminal.print(stations_sentence(limits, seams))
    terminal.print(table)
