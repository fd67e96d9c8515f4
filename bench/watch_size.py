"""Ten thousand sessions in one cell: what one more costs, how long the page takes, how large the file is."""

import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from data_synth.cell_history import CellPlan, cell_history
from data_synth.fixtures.cell_records import records_of
from stitch.plugins.watch.history import HISTORY_FILE, open_history
from stitch.plugins.watch.report import cell_report, cell_trend
from stitch.plugins.watch.update import append_runs
from viz.watch.cell_page import write_page

SIZES = (100, 1_000, 10_000)
_MORE = 40


def size() -> list[str]:
    """A row a size; the clock of the processor, so that other programs on the machine do not count."""
    lines = ["**Growing histories** of 12 parameters, one processor", ""]
    lines += ["| sessions | one more, ms (median, most) | report, s | page with drawings, s | file, MB |"]
    lines += ["|---:|---:|---:|---:|---:|"]
    for sessions in SIZES:
        lines.append(_row(sessions))
    return lines


def _row(sessions: int) -> str:
    plan = CellPlan(days=(sessions + _MORE) // 20, knock_day=None, growth=0.0)
    records = [replace(r, run_hash=f"{r.run_hash} of {sessions}") for r in records_of(cell_history(1, plan))]
    with tempfile.TemporaryDirectory() as folder, open_history(Path(folder) / "cell", new=True) as history:
        append_runs(history, records[:sessions])
        cost = []
        for record in records[sessions:]:
            begun = time.process_time()
            append_runs(history, [record])
            cost.append(1e3 * (time.process_time() - begun))
        begun = time.process_time()
        report = cell_report(history)
        reported = time.process_time() - begun
        write_page(cell_trend(history, report), Path(folder) / "watch.html")
        page = time.process_time() - begun
        history.sql("PRAGMA wal_checkpoint(TRUNCATE)")
        large = (Path(folder) / "cell" / HISTORY_FILE).stat().st_size / 1e6
    told = f"{np.median(cost):.0f}, {max(cost):.0f}"
    return f"| {sessions:,} | {told} | {reported:.2f} | {page:.2f} | {large:.1f} |"
