"""What stands on top of every page: a sentence, lights, notes, and what the page is about."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from stitch.comparison.plain_verdict import Judged
from stitch.system.whole_file import whole
from viz.filled_templates import render

Rows = Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Head:
    """In the order in which it is read."""

    title: str
    verdict: str
    identities: Sequence[tuple[str, Rows]]  # of each thing that the page is about, with its name where they are several
    lights: Sequence[Judged] = ()  # against what is allowed, where somebody said what is
    evidence: str = ""
    notes: Sequence[str] = ()


def write_page(path: Path, template: str, head: Head, **content: object) -> None:
    """Fill in a template that extends `page.html.j2`, whole or not at all; it needs nothing beside it."""
    page = render(template, head=head, **content)
    with whole(path) as file:
        file.write_text(page, encoding="utf-8")
