"""Parts of every page: head with verdict and identity, templates, numbers that stay on one line."""

import json
import platform
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from pathlib import Path

from jinja2 import Environment, PackageLoader, select_autoescape
from markupsafe import Markup

from stitch.numerics.units import MICROMETRES, length_text
from stitch.output.comparison.run_verdict import ToleranceVerdict
from stitch.run_data import RunData
from stitch.session.reading.session_folder import session_hash
from stitch.session.session import SessionData
from stitch.system.files import whole_file
from stitch.system.packages import stitch_version

# Numbers and their units stay on one line.

_SPACE = "\u00a0"
_UNIT = r"(?:[kµm]?m|[µm]?rad|N|kg|°C?|deg|ppm|h|min|m?s|[kM]B|[%σ])(?![\w%])"
_VALUE = r"[−\-]?\d"
_BETWEEN = re.compile(
    rf"(?<=\d) (?={_UNIT}|± \d)|(?<=\d ±) (?=\d)|(?<=\bN) (?=m\b)|(?<=\w) (?== {_VALUE})|(?<=\w =) (?={_VALUE})"
)


def unbroken(text: str) -> str:
    """The text with no-break spaces before units, about ± and =: a line of a page ends elsewhere."""
    return _BETWEEN.sub(_SPACE, text)


# Templates of pages filled in, without the libraries that draw.


def render(template: str, **content: object) -> str:
    """A template of `viz/templates` filled in; text is escaped, and numbers stay with their units."""
    return _environment().get_template(template).render(**content)


@cache
def _environment() -> Environment:
    """The templates, each compiled once in a process."""
    environment = Environment(
        loader=PackageLoader("viz"), autoescape=select_autoescape(default=True), trim_blocks=True, finalize=_on_one_line
    )
    environment.filters["script_json"] = lambda data: Markup(script_json(data))
    return environment


def _on_one_line(value: object) -> object:
    """Text as a page has it; what is markup already was text before."""
    return unbroken(value) if isinstance(value, str) and not isinstance(value, Markup) else value


def script_json(data: object) -> str:
    """Plain data as JSON that may stand inside a script element."""
    return json.dumps(data).replace("<", "\\u003c")


# What a page is about: object, time, arm, scanner, versions, and a hash that tells one session from another.

Row = tuple[str, str]


def identity(run: RunData) -> list[Row]:
    """Rows of label and text; nothing that the session does not state."""
    session = run.session
    scanner = "fixed in the cell, part on the flange" if session.mount == "eye_to_hand" else "on the flange, part fixed"
    noise = session.scanner.noise
    stated = "" if noise is None else f", noise {noise:g} {session.length_unit} as stated"
    joints = "" if session.robot is None else f", {session.robot.n_joints} joints"
    of = f" of {len(session.views) + len(run.left_out)}" if run.left_out else ""
    return [
        ("Session", session.name),
        ("Views", f"{len(session.views)}{of}, {_points(session)}"),
        page_written(),
        ("Arm", ("not stated" if session.robot is None else session.robot.name or "without a name") + joints),
        ("Scanner", scanner + stated),
        ("Model", ", ".join(["hand-eye", *_effects_in_words(run)])),
        versions(),
        ("SHA-256 of the session", session_hash(session)),
    ]


def _effects_in_words(run: RunData) -> list[str]:
    """Of a run without effects nothing of a diagnosis is loaded."""
    if not run.effects:
        return []
    from stitch.output.plain_words import effect_in_words

    return [effect_in_words(name) for name in run.effects]


def page_written() -> Row:
    """The day, UTC."""
    return "Page written", datetime.now(UTC).strftime("%Y-%m-%d")


def versions() -> Row:
    """Return the versions of the programs that computed it."""
    return "stitch", f"{stitch_version()}, Python {platform.python_version()}, numpy {version('numpy')}"


def _points(session: SessionData) -> str:
    clouds = sum(view.cloud.count for view in session.views if view.cloud is not None)
    labelled = sum(len(view.sighting.targets) for view in session.views if view.sighting is not None)
    told = [f"{n:,} {word}" for n, word in ((clouds, "points"), (labelled, "labelled points")) if n]
    return " and ".join(told) or "no points"


def round_length(value: float, length_unit: str) -> str:
    """Return a length as one remembers it: two digits, whole micrometres from a hundred on."""
    return length_text(value, length_unit, 3 if 100 <= abs(value) * MICROMETRES[length_unit] < 1e3 else 2)


@dataclass(frozen=True)
class Tile:
    """One of the numbers on top of a screen: as it was or is, and as it is or would be."""

    key: str
    name: str
    values: Sequence[float]  # one, or two: before and after
    length_unit: str

    @property
    def told(self) -> str:
        """The number, or from where it came to where."""
        texts = [round_length(value, self.length_unit) for value in self.values]
        if len(texts) > 1 and texts[0].rpartition(" ")[2] == texts[1].rpartition(" ")[2]:
            texts[0] = texts[0].rpartition(" ")[0]
        return " → ".join(texts)


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


def write_page(
    path: Path, template: str, head: Head, sections: dict[str, str] | None = None, **content: object
) -> None:
    """Fill in a template that extends `page.html.j2`, whole or not at all; it needs nothing beside it.

    Args:
        sections: put between their marks, in place of what the template says there.
    """
    page = with_sections(render(template, head=head, **content), sections or {})
    with whole_file(path) as file:
        file.write_text(page, encoding="utf-8")


# Sections that a diagnosis or a comparison adds to a page that stands, each between two marks of its name.


def with_sections(page: str, sections: dict[str, str]) -> str:
    """The page with these sections between their marks; one from elsewhere without marks stays as it is."""
    for name, html in sections.items():
        begin, end = f"<!-- {name} begins -->", f"<!-- {name} ends -->"
        page = re.sub(f"{begin}.*?{end}", lambda _, own=begin + html + end: own, page, flags=re.S)  # type: ignore[misc]
    return page


def sections_of(page: str) -> dict[str, str]:
    """The sections of a page, by the names of their marks."""
    return dict(re.findall(r"<!-- (\w+) begins -->(.*?)<!-- \1 ends -->", page, flags=re.S))
