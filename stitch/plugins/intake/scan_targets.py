"""Boards and balls in scans: what each view shows of them, as labelled points."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stitch.errors import InputError, NoResultError
from stitch.numerics.feature_matching import align_points
from stitch.numerics.frames import Array
from stitch.numerics.units import METRES
from stitch.plugins.intake.detection.balls import ball_sightings
from stitch.plugins.intake.detection.boards import Board, PlacedBoard, board_sightings, boards_in
from stitch.plugins.intake.detection.range_image import read_range_image
from stitch.plugins.intake.folder_files import FolderFiles
from stitch.plugins.intake.guesses import Guess
from stitch.plugins.intake.layouts import MM
from stitch.screening.motions import RelativeScans
from stitch.session.reading.session_toml import read_session_document
from stitch.session.reading.views_table import read_views
from stitch.session.session import Cloud, SessionData, Sighting
from stitch.system.packages import import_extra

# Views that are compared: each with the next few that show the same targets.
_NEXT = 4
_FEWEST = 3
# Targets closer to one line than this share of their extent do not show how the scanner turned.
_LINE = 0.05


def target_motions(sightings: Sequence[Sighting]) -> RelativeScans:
    """Motions (Arun, Huang & Blostein 1987) between views with three common targets or more that span a plane."""
    pairs, motions = list[tuple[int, int]](), list[Array]()
    showing = [v for v, s in enumerate(sightings) if len(s.targets) >= _FEWEST]
    for place, v in enumerate(showing):
        for w in showing[place + 1 : place + 1 + _NEXT]:
            T = _relative_motion(sightings[v], sightings[w])
            if T is not None:
                pairs.append((v, w))
                motions.append(T)
    return RelativeScans(tuple(pairs), np.array(motions).reshape(-1, 4, 4))


def _relative_motion(first: Sighting, second: Sighting) -> Array | None:
    """T (4, 4) that maps the second view's scanner frame into the first's."""
    common = [name for name in first.targets if name in second.targets]
    if len(common) < _FEWEST:
        return None
    a, b = (s.points[[s.targets.index(name) for name in common]] for s in (first, second))
    extent = np.linalg.svd(a - a.mean(axis=0), compute_uv=False)
    return None if extent[1] < _LINE * extent[0] else align_points(b, a)


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
        return self.unit / MM


def scans_of_session(session: SessionData) -> ViewScans:
    """The scans of a session, in its length_unit; of one in memory there are no files."""
    files: tuple[Path | None, ...] = (None,) * len(session.views)
    cloud_unit = session.length_unit
    if (session.path / "session.toml").is_file():
        rows = read_views(session.path / "views.csv", session.robot)
        files = tuple(session.path / row.cloud if row.cloud else None for row in rows)
        cloud_unit = read_session_document(session.path / "session.toml").get("cloud_unit", session.length_unit)
    return ViewScans(
        where=session.path,
        files=files,
        file_unit=METRES[cloud_unit],
        unit=METRES[session.length_unit],
        clouds=tuple(None if view.cloud is None else _every_point(view.cloud) for view in session.views),
        rotations=tuple(view.T_base_flange[:3, :3] for view in session.views),
    )


def _every_point(cloud: Cloud) -> Array:
    return cloud.points if cloud.whole is None else cloud.whole.read().points


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


def find_folder_targets(
    files: FolderFiles, clouds: Sequence[Array], metres: float, search: TargetSearch
) -> tuple[tuple[Sighting, ...], tuple[Guess, ...]]:
    """What every cloud shows of the targets that are looked for, mm; nothing where none are.

    Args:
        clouds: (N, 3) of the files, in their own unit.
        metres: of that unit.
    """
    if search.is_empty:
        return (), ()
    own = tuple(cloud * metres / MM for cloud in clouds)
    scans = ViewScans(files.folder, files.clouds, metres, MM, own, (None,) * len(own))
    sightings, notes = find_targets(scans, search)
    count = sum(bool(s.targets) for s in sightings)
    words = f"{len(views_of_targets(sightings))} in {count} of {len(sightings)} clouds"
    reason = "; ".join(("found where they were looked for", *notes))
    return tuple(sightings), (Guess("targets", words, reason, True, "--board, --ball"),)
