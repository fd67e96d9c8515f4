"""The page of a measuring cell: one sentence, pictures with captions, tables; one file that needs nothing beside it."""

import csv
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from stitch.output.comparison.run_verdict import ToleranceVerdict
from stitch.session.reading.session_folder import UNKNOWN, content_hash
from viz.figures import png, svg
from viz.page_parts import Head, Row, Subject, page_written, versions, write_page

# What the page of a measuring cell is about: the same block as on the page of a run.


def job_identity(file: Path | None, own: Sequence[Row]) -> list[Row]:
    """Rows of label and text.

    Args:
        file: the job file, None where the job was not read from one.
        own: what was measured, arm, sensor: as far as the job states them.
    """
    measured, *others = own
    name = "not read from a file" if file is None else file.name
    return [
        ("Job", name),
        measured,
        page_written(),
        *others,
        versions(),
        ("SHA-256 of the job", UNKNOWN if file is None else content_hash(file.parent, _files(file))),
    ]


def _files(job: Path) -> list[Path]:
    """The job file, the files that it names, and those that its tables name."""
    found = [job]
    try:
        for file in found:  # grows while it is read
            for word in _words(file):
                other = file.parent / word
                if other.is_file() and other not in found:
                    found.append(other)
    except (OSError, ValueError, csv.Error):
        return found
    return found


def _words(file: Path) -> Iterator[str]:
    match file.suffix.lower():
        case ".toml":
            yield from _texts(tomllib.loads(file.read_text(encoding="utf-8-sig")))
        case ".csv":
            with open(file, encoding="utf-8-sig", newline="") as table:
                for row in csv.reader(table):
                    yield from (cell.strip() for cell in row if cell.strip())


def _texts(entry: Any) -> Iterator[str]:
    """Every text within nested tables and lists."""
    if isinstance(entry, str):
        yield entry
    elif isinstance(entry, dict | list):
        for inner in entry.values() if isinstance(entry, dict) else entry:
            yield from _texts(inner)


# Beyond so many marks a drawing of lines is larger than one of pixels.
_PIXELS = 130
# Inches of a figure of which a phone shows the numbers.
_PHONE = 8.0


@dataclass(frozen=True)
class Picture:
    """A figure and what there is to see in it."""

    title: str
    figure: Figure
    caption: str
    pixels: bool = False  # thousands of points: stored as PNG

    @property
    def wide(self) -> bool:
        """True if a phone's width would leave nothing to read of it."""
        return self.figure.get_figwidth() > _PHONE

    @property
    def address(self) -> str:
        """The picture as a data address."""
        return png(self.figure, _PIXELS) if self.pixels else svg(self.figure)


@dataclass(frozen=True)
class Table:
    """Rows of texts under a header."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Page:
    """Hold the content of a cell's page."""

    system: str
    verdict: str
    file: Path | None  # of the job
    about: Sequence[Row]  # what was measured, arm, sensor
    pictures: Sequence[Picture]
    tables: Sequence[Table]
    notes: Sequence[str] = ()
    light: ToleranceVerdict | None = None  # where the job states what is allowed


def write(page: Page, path: Path) -> None:
    """Render the page."""
    lights = [] if page.light is None else [page.light]
    about = Subject(job_identity(page.file, page.about))
    head = Head(page.system, page.verdict, [about], lights=lights, notes=page.notes)
    write_page(path, "cell.html.j2", head, page=page)
