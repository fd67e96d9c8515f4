"""The page of a measuring cell: one sentence, pictures with captions, tables; one file that needs nothing beside it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from stitch.comparison.run_verdict import ToleranceVerdict
from viz.cells.job_identity import job_identity
from viz.identity import Row
from viz.page_head import Head, Subject, write_page
from viz.page_parts import png, svg

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
    """What a cell has to say."""

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
