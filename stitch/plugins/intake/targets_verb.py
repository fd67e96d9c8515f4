"""`stitch.detect`: what `stitch detect` does, of a session in memory."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

from stitch.api.session import Session, load_session, public_session
from stitch.errors import InputError
from stitch.plugins.intake.detect import parse_target_options
from stitch.plugins.intake.scan_targets import find_targets, scans_of_session
from stitch.session.session import SessionData


def detect(
    session: SessionData | Path | str, *, boards: Sequence[str] = (), balls: Sequence[float] | Literal["any"] = ()
) -> Session:
    """Find boards and balls in the scans, and return the session with them as labelled points.

    Args:
        session: one in memory, or its folder; boards need the pictures that lie in a folder.
        boards: such as "charuco:11x8:20:15:DICT_4X4_50", "checkerboard:9x6:25", "apriltag:36h11:40"; sides in mm.
        balls: their radii, mm, or "any".

    Returns:
        A session in memory, with a sighting a view; points (T, 3) in the scanner frame, length_unit.

    Raises:
        InputError: nothing to look for, no picture for a board, or an object that is not what is stated.
        NoResultError: no view shows one.

    Example:
        >>> labelled = stitch.detect(ball_session, balls=[30.0])
        >>> labelled.has_sightings, labelled.views[0].sighting.targets
        (True, ('ball1',))
    """
    search = parse_target_options(list(boards), ["any"] if balls == "any" else [str(radius) for radius in balls])
    if search.is_empty:
        raise InputError("stitch.detect: nothing to look for; to fix: pass boards or balls")
    loaded = session if isinstance(session, SessionData) else load_session(session, at_most=None)
    found, _ = find_targets(scans_of_session(loaded), search)
    views = tuple(
        replace(view, sighting=sighting if sighting.targets else None)
        for view, sighting in zip(loaded.views, found, strict=True)
    )
    return public_session(replace(loaded, path=Path(f"<{loaded.name}>"), views=views))
