"""The page of a measuring cell: one sentence, pictures with captions, tables; one file that needs nothing beside it."""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from matplotlib.figure import Figure

from viz.filled_templates import render
from viz.page_parts import png, svg

# Beyond so many marks a drawing of lines is larger than one of pixels.
_PIXELS = 130


@dataclass(frozen=True)
class Picture:
    """A figure and what there is to see in it."""

    title: str
    figure: Figure
    caption: str
    pixels: bool = False  # thousands of points: stored as PNG

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
    pictures: Sequence[Picture]
    tables: Sequence[Table]
    notes: Sequence[str] = ()


def write(page: Page, path: Path) -> None:
    """Render the page."""
    path.write_text(render("cell.html.j2", page=page, version=version("stitch")), encoding="utf-8")
