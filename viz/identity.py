"""What a page is about: object, time, arm, scanner, versions, and a hash that tells one session from another."""

import platform
from datetime import UTC, datetime
from importlib.metadata import version

from stitch.measurement.session import Session
from stitch.reading.session_folder import session_hash
from stitch.runs.run import Run
from stitch.writing.diagnosis_document import effect_in_words

Row = tuple[str, str]


def identity(run: Run) -> list[Row]:
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
        ("Model", ", ".join(["hand-eye", *map(effect_in_words, run.effects)])),
        versions(),
        ("SHA-256 of the session", session_hash(session)),
    ]


def page_written() -> Row:
    """The day, UTC."""
    return "Page written", datetime.now(UTC).strftime("%Y-%m-%d")


def versions() -> Row:
    """What computed it."""
    return "stitch", f"{version('stitch')}, Python {platform.python_version()}, numpy {version('numpy')}"


def _points(session: Session) -> str:
    clouds = sum(view.cloud.count for view in session.views if view.cloud is not None)
    labelled = sum(len(view.sighting.targets) for view in session.views if view.sighting is not None)
    told = [f"{n:,} {word}" for n, word in ((clouds, "points"), (labelled, "labelled points")) if n]
    return " and ".join(told) or "no points"
