"""What stands on top of every page: a sentence, lights, notes, and what the page is about."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from stitch.comparison.run_verdict import ToleranceVerdict
from stitch.system.files import whole_file
from viz.filled_templates import render


@dataclass(frozen=True)
class Subject:
    """One of the things that a page is about."""

    identity: Sequence[tuple[str, str]]  # label and text
    name: str = ""  # where they are several
    found: Sequence[str] = ()  # sentences


@dataclass(frozen=True)
class Head:
    """In the order in which it is read."""

    title: str
    verdict: str
    subjects: Sequence[Subject]
    lights: Sequence[ToleranceVerdict] = ()  # against what is allowed, where somebody said what is
    evidence: str = ""
    notes: Sequence[str] = ()
    doubts: Sequence[str] = ()  # in full, of which the verdict has the beginnings


def write_page(path: Path, template: str, head: Head, **content: object) -> None:
    """Fill in a template that extends `page.html.j2`, whole or not at all; it needs nothing beside it."""
    page = render(template, head=head, **content)
    with whole_file(path) as file:
        file.write_text(page, encoding="utf-8")
