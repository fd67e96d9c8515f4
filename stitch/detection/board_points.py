"""Corners of boards in space, view by view, checked against what the board is said to be."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stitch import frames
from stitch.detection.board import Board
from stitch.detection.board_corners import Corners, find_corners
from stitch.detection.lift import lift_points
from stitch.errors import InputError
from stitch.frames import Array
from stitch.measurement.labelled_points import Sighting
from stitch.measurement.range_image import RangeImage

# Half width of the window around a corner, of the distance to the next corner; tags have their border beside them.
_WINDOW, _WINDOW_OF_TAG = 0.6, 0.3
# What OpenCV's refined corners scatter by, pixels; the scatter about the board's drawing corrects it.
_PIXEL_SIGMA = 0.1
# A scanner's scale is off by less than this; a board that differs more is another one.
_SCALE_TOLERANCE = 0.03
# Corners so many sigmas off the drawing are wrong.
_CORNER_GATE = 5.0
_MIN_SIGMA_FACTOR = 0.3
_MIN_PLACED_CORNERS = 4


@dataclass(frozen=True)
class PlacedBoard:
    """K corners of one board, or of one tag, in one view."""

    names: tuple[str, ...]
    points: Array  # (K, 3) scanner frame
    sigma: Array  # (K,) of a coordinate
    drawing: Array  # (K, 3) on the board

    def only(self, kept: Array) -> "PlacedBoard":
        """Some of its corners."""
        names = tuple(name for name, keep in zip(self.names, kept, strict=True) if keep)
        return PlacedBoard(names, self.points[kept], self.sigma[kept], self.drawing[kept])


def boards_in(image: RangeImage, board: Board, cv2: Any) -> list[PlacedBoard]:
    """A board in one view, of tags each tag; none where it is not seen.

    Args:
        board: in the unit of the scan.
        cv2: the module of OpenCV.
    """
    found = find_corners(image.grey, board, cv2)
    if not found and board.kind != "checkerboard":
        # Rows from below make a mirror image, in which no marker is known.
        image = RangeImage(image.points[::-1], image.grey[::-1])
        found = find_corners(image.grey, board, cv2)
    placed = [_placed_board(image, corners, board) for corners in found]
    return [p for p in placed if len(p.names) >= _MIN_PLACED_CORNERS]


def _placed_board(image: RangeImage, corners: Corners, board: Board) -> PlacedBoard:
    apart = np.linalg.norm(corners.pixels[:, None] - corners.pixels[None], axis=2)
    nearest = np.where(apart > 0, apart, np.inf).min(axis=1)
    window = _WINDOW_OF_TAG if board.kind == "apriltag" else _WINDOW
    points, sigma = lift_points(image, corners.pixels, window * nearest, _PIXEL_SIGMA)
    return PlacedBoard(corners.names, points, sigma, corners.drawing).only(np.isfinite(points[:, 0]))


def board_sightings(
    views: Sequence[Sequence[PlacedBoard]], board: Board, to_mm: float, label: str
) -> tuple[list[Sighting], list[str]]:
    """Sightings of all views from what each shows; corners that do not fit the drawing go, sigmas follow the scatter.

    Args:
        to_mm: millimetres per unit of the scans, for messages.
        label: with which the names of its corners begin.

    Returns:
        A sighting a view, empty where the board is not seen, and what was left out, in words.

    Raises:
        InputError: the board has another size than stated.
    """
    seen = [placed for view in views for placed in view]
    if not seen:
        return [_board_sighting(label, ()) for _ in views], []
    _require_size(seen, board, to_mm)
    kept = [[_consistent_corners(placed) for placed in view] for view in views]
    gone = sum(len(p.names) for p in seen) - sum(len(p.names) for view in kept for p in view)
    squares = [_sum_of_squares(p) for view in kept for p in view if len(p.names) >= _MIN_PLACED_CORNERS]
    freedom = sum(free for _, free in squares)
    factor = max(np.sqrt(sum(total for total, _ in squares) / freedom), _MIN_SIGMA_FACTOR) if freedom else 1.0
    told = [f"{gone} corners of {board.stated} lie off the board's plane or grid and are left out"] if gone else []
    out = [_board_sighting(label, [replace(p, sigma=factor * p.sigma) for p in view]) for view in kept]
    return out, told


def _board_sighting(label: str, placed: Sequence[PlacedBoard]) -> Sighting:
    names = tuple(f"{label}-{name}" for p in placed for name in p.names)
    points = np.vstack([np.zeros((0, 3)), *(p.points for p in placed)])
    return Sighting(names, points, np.concatenate([np.zeros(0), *(p.sigma for p in placed)]))


def _require_size(boards: Sequence[PlacedBoard], board: Board, to_mm: float) -> None:
    ratio = float(np.median([_median_corner_distance(p.points) / _median_corner_distance(p.drawing) for p in boards]))
    if abs(ratio - 1) <= _SCALE_TOLERANCE:
        return
    found, stated = board.square * ratio * to_mm, board.square * to_mm
    raise InputError(
        f"--board {board.stated}: its squares are {found:.4g} mm in the scans, {stated:.4g} mm are stated; to fix: "
        f"state {found:.4g}, or correct cloud_unit in session.toml"
    )


def _median_corner_distance(points: Array) -> float:
    """Median distance between two corners: few that are wrong do not move it."""
    first, second = np.triu_indices(len(points), 1)
    return float(np.median(np.linalg.norm(points[first] - points[second], axis=1)))


def _consistent_corners(placed: PlacedBoard) -> PlacedBoard:
    """The corners that lie where the drawing has them, within what they scatter by themselves."""
    for _ in range(len(placed.names)):
        if len(placed.names) <= _MIN_PLACED_CORNERS:
            break
        off = _drawing_deviation(placed)
        worst = int(np.argmax(off))
        scatter = 1.4826 * float(np.median(off)) / 1.5
        if off[worst] <= _CORNER_GATE * max(scatter, 1.0):
            break
        placed = placed.only(np.arange(len(off)) != worst)
    return placed


def _drawing_deviation(placed: PlacedBoard) -> Array:
    """(K,) distance from the drawing in sigmas under the rigid motion that fits best (Arun et al. 1987)."""
    weight = (placed.sigma**-2)[:, None]
    a, b = (x - (weight * x).sum(axis=0) / weight.sum() for x in (placed.drawing, placed.points))
    R = frames.nearest_rotation(b.T @ (weight * a))
    return np.asarray(np.linalg.norm(b - a @ R.T, axis=1) / placed.sigma)


def _sum_of_squares(placed: PlacedBoard) -> tuple[float, int]:
    """Sum of squares about the drawing, in sigmas, and its degrees of freedom."""
    return float((_drawing_deviation(placed) ** 2).sum()), 3 * len(placed.names) - 6
