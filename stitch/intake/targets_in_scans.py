"""Boards and balls in scans: what each view shows of them, as labelled points."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stitch.detection.ball_points import ball_sightings
from stitch.detection.board import Board
from stitch.detection.board_points import PlacedBoard, board_sightings, boards_in
from stitch.errors import InputError, NoResultError
from stitch.frames import Array
from stitch.measurement.labelled_points import Sighting
from stitch.measurement.session import Session
from stitch.reading.extras import import_extra
from stitch.reading.range_image import read_range_image
from stitch.reading.session_toml import read_session_document
from stitch.reading.views_csv import read_views
from stitch.units import METRES

_METRES_PER_MM = 1e-3


@dataclass(frozen=True)
class TargetSearch:
    """What a person says that the scans show."""

    boards: tuple[Board, ...] = ()
    balls: tuple[float, ...] | None = None  # radii, mm; empty for balls of any radius, None for no balls

    @property
    def is_empty(self) -> bool:
        """True where nothing is looked for."""
        return not self.boards and self.balls is None


@dataclass(frozen=True)
class ViewScans:
    """The scans of V views."""

    where: Path  # for messages
    files: tuple[Path | None, ...]
    file_unit: float  # of the files, m
    unit: float  # of the clouds here, and of what is found, m
    clouds: tuple[Array | None, ...]  # (N, 3), scanner frame
    rotations: tuple[Array | None, ...]  # (3, 3) R_base_flange where it is known

    @property
    def to_mm(self) -> float:
        """Millimetres per unit."""
        return self.unit / _METRES_PER_MM


def scans_of_session(session: Session) -> ViewScans:
    """The scans of a session, in its length_unit."""
    rows = read_views(session.path / "views.csv", session.robot)
    cloud_unit = read_session_document(session.path / "session.toml").get("cloud_unit", session.length_unit)
    return ViewScans(
        where=session.path,
        files=tuple(session.path / row.cloud if row.cloud else None for row in rows),
        file_unit=METRES[cloud_unit],
        unit=METRES[session.length_unit],
        clouds=tuple(None if view.cloud is None else view.cloud.points for view in session.views),
        rotations=tuple(view.T_base_flange[:3, :3] for view in session.views),
    )


def find_targets(scans: ViewScans, search: TargetSearch) -> tuple[list[Sighting], list[str]]:
    """Find boards and balls in all views: a sighting a view, and what was left out, in words.

    Raises:
        InputError: no scan is an image, or a board or a ball is not what is stated.
        NoResultError: no view shows one that is looked for.
    """
    parts, notes = [], list[str]()
    for i, board in enumerate(search.boards):
        alike = sum(other.kind == board.kind for other in search.boards[:i])
        found, told = _board_sightings(scans, board, f"{board.kind}{alike + 1 if alike else ''}")
        parts.append(found)
        notes += told
    if search.balls is not None:
        found, told = _ball_sightings(scans, search.balls)
        parts.append(found)
        notes += told
    return [_merged_sightings(of_view) for of_view in zip(*parts, strict=True)], notes


def _board_sightings(scans: ViewScans, board: Board, label: str) -> tuple[list[Sighting], list[str]]:
    cv2 = import_extra("cv2", f"--board {board.stated}", "vision")
    own, seen, images = board.scaled(1 / scans.to_mm), list[list[PlacedBoard]](), 0
    for file in scans.files:
        image = None if file is None else read_range_image(file, scans.file_unit / scans.unit)
        images += image is not None
        seen.append([] if image is None else boards_in(image, own, cv2))
    if not images:
        raise InputError(
            f"{scans.where}: no scan is an image with brightness, so that no board can be seen; to fix: export "
            "organised clouds with colour or intensity, or depth images with the picture beside them"
        )
    if not any(seen):
        raise NoResultError(
            f"{scans.where}: no view shows {board.stated}; to try: check the number of squares and the dictionary, and "
            "that the picture is neither dark nor blurred"
        )
    return board_sightings(seen, own, scans.to_mm, label)


def _ball_sightings(scans: ViewScans, radii: Sequence[float]) -> tuple[list[Sighting], list[str]]:
    stated = [radius / scans.to_mm for radius in radii]
    found, told = ball_sightings(scans.clouds, scans.rotations, stated, scans.to_mm)
    if not any(sighting.targets for sighting in found):
        why = told[0] if told else "no view shows a ball of which a cap is covered"
        raise NoResultError(f"{scans.where}: {why}; to try: scan closer, or from where more of the balls is seen")
    return found, told


def views_of_targets(sightings: Sequence[Sighting]) -> dict[str, int]:
    """Number of views that show each target, by name."""
    names = [name for sighting in sightings for name in sighting.targets]
    return {name: names.count(name) for name in sorted(set(names))}


def points_columns(views: Sequence[str], sightings: Sequence[Sighting], scale: float = 1.0) -> dict[str, list[object]]:
    """points.csv.

    Args:
        scale: from the unit of the sightings to the session's.
    """
    rows = [
        (view, name, *(scale * point).tolist(), float(scale * sigma))
        for view, s in zip(views, sightings, strict=True)
        for name, point, sigma in zip(s.targets, s.points, s.sigma, strict=True)
    ]
    return dict(zip(("view", "target", *"xyz", "sigma"), map(list, zip(*rows, strict=True)), strict=True))


def _merged_sightings(parts: Sequence[Sighting]) -> Sighting:
    return Sighting(
        tuple(name for part in parts for name in part.targets),
        np.vstack([part.points for part in parts]),
        np.concatenate([part.sigma for part in parts]),
    )
