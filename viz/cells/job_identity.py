"""What the page of a measuring cell is about: the same block as on the page of a run."""

import csv
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from stitch.reading.session_folder import UNKNOWN, content_hash
from viz.identity import Row, page_written, versions


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
