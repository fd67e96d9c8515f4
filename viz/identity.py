"""What a page is about: object, time, arm, scanner, versions, and a hash that tells one session from another."""

import csv
import hashlib
import platform
from datetime import UTC, datetime
from importlib.metadata import version

from stitch.measurement.session import Session
from stitch.runs.run import Run

_TABLES = ("session.toml", "views.csv", "points.csv", "frames.csv", "targets.csv")
_BLOCK = 1 << 20


def identity(run: Run) -> list[tuple[str, str]]:
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
        ("Page written", datetime.now(UTC).strftime("%Y-%m-%d")),
        ("Arm", ("not stated" if session.robot is None else session.robot.name or "without a name") + joints),
        ("Scanner", scanner + stated),
        ("Model", ", ".join(["hand-eye", *run.effects])),
        ("stitch", f"{version('stitch')}, Python {platform.python_version()}, numpy {version('numpy')}"),
        ("SHA-256 of the session", session_hash(session)),
    ]


def session_hash(session: Session) -> str:
    """SHA-256 over the session's tables and the clouds that they name, in this order; first 16 digits.

    A dash where the session does not lie on disk any more.
    """
    found = hashlib.sha256()
    try:
        files = [session.path / name for name in _TABLES if (session.path / name).is_file()]
        with open(session.path / "views.csv", encoding="utf-8-sig", newline="") as file:
            rows = list(csv.DictReader(file, skipinitialspace=True))
        files += [session.path / row["cloud"].strip() for row in rows if row.get("cloud")]
        for path in files:
            found.update(path.relative_to(session.path).as_posix().encode() + b"\0")
            with open(path, "rb") as file:
                while block := file.read(_BLOCK):
                    found.update(block)
    except (OSError, ValueError, csv.Error):
        return "–"
    return found.hexdigest()[:16]


def _points(session: Session) -> str:
    clouds = sum(len(view.cloud.points) for view in session.views if view.cloud is not None)
    labelled = sum(len(view.sighting.targets) for view in session.views if view.sighting is not None)
    told = [f"{n:,} {word}" for n, word in ((clouds, "points"), (labelled, "labelled points")) if n]
    return " and ".join(told) or "no points"
