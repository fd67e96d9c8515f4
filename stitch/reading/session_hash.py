"""A hash that tells one measurement from another, wherever its files lie."""

import csv
import hashlib
from collections.abc import Sequence
from pathlib import Path

from stitch.measurement.session import Session

_TABLES = ("session.toml", "views.csv", "points.csv", "frames.csv", "targets.csv")
_BLOCK = 1 << 20
UNKNOWN = "–"


def session_hash(session: Session) -> str:
    """SHA-256 over the session's tables and the clouds that they name, in this order; first 16 digits.

    A dash where the session does not lie on disk any more.
    """
    try:
        files = measured_files(session.path)
    except (OSError, ValueError, csv.Error):
        return UNKNOWN
    return content_hash(session.path, files)


def measured_files(folder: Path) -> list[Path]:
    """The tables of a session's folder and the clouds that they name.

    Raises:
        OSError, ValueError, csv.Error: views.csv cannot be read.
    """
    files = [folder / name for name in _TABLES if (folder / name).is_file()]
    with open(folder / "views.csv", encoding="utf-8-sig", newline="") as file:
        rows = list(csv.DictReader(file, skipinitialspace=True))
    return files + [folder / row["cloud"].strip() for row in rows if row.get("cloud")]


def content_hash(folder: Path, files: Sequence[Path]) -> str:
    """SHA-256 over names and contents of files below a folder, in this order; first 16 digits.

    A dash where one cannot be read, or lies elsewhere.
    """
    found = hashlib.sha256()
    try:
        for path in files:
            found.update(path.relative_to(folder).as_posix().encode() + b"\0")
            with open(path, "rb") as file:
                while block := file.read(_BLOCK):
                    found.update(block)
    except (OSError, ValueError):
        return UNKNOWN
    return found.hexdigest()[:16]
