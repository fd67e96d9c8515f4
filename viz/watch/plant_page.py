"""The page of a plant: a row a cell, those first that need somebody."""

from collections.abc import Sequence
from os.path import relpath
from pathlib import Path

from stitch.system.files import whole_file
from stitch.watch.report import CellReport, day_text, event_sentences
from viz.filled_templates import render
from viz.watch.cell_page import light

_ORDER = ("bad", "check", "good")


def write_page(cells: Sequence[tuple[CellReport, Path]], path: Path) -> None:
    """Write the page of some cells with links to theirs.

    Args:
        cells: what each has to say, and where its page lies.
    """
    rows = [
        {
            "name": report.name,
            "href": Path(relpath(page, path.parent)).as_posix(),
            "light": light(report)[0],
            "words": "; ".join(event_sentences(report)) or "nothing moves",
            "sessions": f"{report.sessions:,}",
            "last": day_text(report.last),
            "until": _until(report),
        }
        for report, page in cells
    ]
    rows.sort(key=lambda row: (_ORDER.index(row["light"]), row["name"]))
    counts = {colour: sum(row["light"] == colour for row in rows) for colour in _ORDER}
    with whole_file(path) as file:
        file.write_text(render("plant.html.j2", rows=rows, sentence=_sentence(counts)), encoding="utf-8")


def _until(report: CellReport) -> str:
    end = report.recalibrate_before
    if end is None:
        return "holds"
    return "over" if end <= report.last else day_text(end)


def _sentence(counts: dict[str, int]) -> str:
    total, told = sum(counts.values()), []
    if counts["bad"]:
        told.append(f"{counts['bad']} to recalibrate now")
    if counts["check"]:
        told.append(f"{counts['check']} in which something moves")
    return f"{total} cells: {', '.join(told)}." if told else f"{total} cells: nothing moves."
