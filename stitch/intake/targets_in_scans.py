"""Boards and balls in the scans of a session: what each view shows of them, as labelled points."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stitch.detection.ball_points import ball_sightings
from stitch.detection.board import Board
from stitch.detection.board_points import PlacedBoard, boards_in, judged
from stitch.errors import InputError, NoResultError
from stitch.measurement.labelled_points import Sighting
from stitch.measurement.range_image import RangeImage
from stitch.measurement.session import Session
from stitch.reading.extras import package
from stitch.reading.range_image import read_range_image
from stitch.reading.session_toml import document
from stitch.reading.views_csv import read_views
from stitch.units import METRES

_MM = 1e-3


@dataclass(frozen=True)
class TargetsFound:
    """By view of the session, in its order."""

    views: tuple[str, ...]
    sightings: tuple[Sighting, ...]
    notes: tuple[str, ...]

    @property
    def seen(self) -> dict[str, int]:
        """Number of views that show each target."""
        names = [name for sighting in self.sightings for name in sighting.targets]
        return {name: names.count(name) for name in sorted(set(names))}


def targets_in(session: Session, boards: Sequence[Board], balls: Sequence[float] | None = None) -> TargetsFound:
    """Find boards and balls in all views.

    Args:
        balls: radii, mm; empty for balls of any radius, None for no balls.

    Raises:
        InputError: no scan is an image, or a board or a ball is not what is stated.
        NoResultError: no view shows any.
    """
    parts, notes = [], list[str]()
    for board in boards:
        found, told = _of_board(session, board)
        if not any(sighting.targets for sighting in found):
            raise NoResultError(
                f"{session.path}: no view shows {board.stated}; to try: check the number of squares and the "
                "dictionary, and that the picture is neither dark nor blurred"
            )
        parts.append(found)
        notes += told
    if balls is not None:
        found, told = _of_balls(session, balls)
        parts.append(found)
        notes += told
    views = [_together(of_view) for of_view in zip(*parts, strict=True)]
    return TargetsFound(tuple(view.name for view in session.views), tuple(views), tuple(notes))


def _of_board(session: Session, board: Board) -> tuple[list[Sighting], list[str]]:
    cv2 = package("cv2", f"--board {board.stated}", "vision")
    to_mm = METRES[session.length_unit] / _MM
    own, seen, images = board.scaled(1 / to_mm), list[list[PlacedBoard]](), 0
    for file in scan_files(session):
        image = _image(session, file)
        images += image is not None
        seen.append([] if image is None else boards_in(image, own, cv2))
    if not images:
        raise InputError(
            f"{session.path}: no scan is an image with brightness, so that no board can be seen; to fix: export "
            "organised clouds with colour or intensity, or depth images with the picture beside them"
        )
    return judged(seen, own, to_mm)


def _of_balls(session: Session, radii: Sequence[float]) -> tuple[list[Sighting], list[str]]:
    to_mm = METRES[session.length_unit] / _MM
    clouds = [None if view.cloud is None else view.cloud.points for view in session.views]
    rotations = [view.T_base_flange[:3, :3] for view in session.views]
    found, told = ball_sightings(clouds, rotations, [radius / to_mm for radius in radii], to_mm)
    if not any(sighting.targets for sighting in found):
        why = told[0] if told else "no view shows a ball of which a cap is covered"
        raise NoResultError(f"{session.path}: {why}; to try: scan closer, or from where more of the balls is seen")
    return found, told


def scan_files(session: Session) -> list[Path | None]:
    """The file of each view's scan; None where it has none."""
    rows = read_views(session.path / "views.csv", session.robot)
    return [session.path / row.cloud if row.cloud else None for row in rows]


def _image(session: Session, file: Path | None) -> RangeImage | None:
    if file is None:
        return None
    unit = document(session.path / "session.toml").get("cloud_unit", session.length_unit)
    return read_range_image(file, METRES[unit] / METRES[session.length_unit])


def _together(parts: Sequence[Sighting]) -> Sighting:
    return Sighting(
        tuple(name for part in parts for name in part.targets),
        np.vstack([part.points for part in parts]),
        np.concatenate([part.sigma for part in parts]),
    )
