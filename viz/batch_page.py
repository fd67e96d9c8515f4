"""The page of a batch: a row a session, those first that need somebody, each with a link to its own page."""

from collections.abc import Sequence
from os.path import relpath
from pathlib import Path

from stitch.numerics.units import length_text
from stitch.plugins.watch.batch.run_batch import SessionRow, batch_sentence
from stitch.system.files import whole_file
from viz.page_parts import render


def write_page(rows: Sequence[SessionRow], path: Path) -> None:
    """Write the page of the sessions of a batch; its links hold wherever the folder of the runs is copied."""
    shown = [_row(row, path.parent) for row in sorted(rows, key=SessionRow.urgency)]
    with whole_file(path) as file:
        file.write_text(render("batch.html.j2", rows=shown, sentence=batch_sentence(rows)), encoding="utf-8")


def _row(row: SessionRow, folder: Path) -> dict[str, object]:
    of = f" of {(row.views or 0) + row.left_out}" if row.left_out else ""
    lengths = (*row.steps_um, row.noise_floor_um, row.worst_view_um)
    return {
        "name": row.name,
        "href": None if row.run is None else Path(relpath(Path(row.run) / "report.html", folder.resolve())).as_posix(),
        "words": row.error or " ".join((*row.doubts, row.verdict or "")),
        "failed": row.error is not None,
        "lengths": ["–" if x is None else length_text(x / 1e3, "mm", zeros=True) for x in lengths],
        "worst_view": row.worst_view or "",
        "views": "–" if row.views is None else f"{row.views}{of}",
    }
