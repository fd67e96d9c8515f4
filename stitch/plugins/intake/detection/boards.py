"""Corners of boards in space, view by view, checked against what the board is said to be."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.distributions import MAD_TO_SIGMA
from stitch.numerics.feature_matching import align_points
from stitch.numerics.frames import Array, Mask
from stitch.plugins.intake.detection.range_image import RangeImage
from stitch.session.session import Sighting

_FORMS = (
    "charuco:11x8:20:15:DICT_4X4_50 (squares, their side and that of the markers in mm, OpenCV's dictionary), "
    "checkerboard:9x6:25 (squares, side in mm) or apriltag:36h11:40 (family, side of the black square in mm)"
)
_FAMILIES = ("16h5", "25h9", "36h10", "36h11")
_LARGEST_MM = 5000.0
# Fewer corners of a board hold it on nothing.
_MIN_BOARD_CORNERS = 4
# Largest half width of the window in which corners are refined, of the distance to the next.
_REFINED = 0.25
# Pixels around a corner, and how many must have measured something.
_MIN_WINDOW, _MAX_WINDOW = 3, 25
_MIN_WINDOW_PIXELS, _SHARE = 12, 0.3
# Pixels further off the plane than so many robust sigmas belong to something else.
_PLANE_GATE = 3.5
_DRAWS = 40
# The pixels that are left lie around the point: their middle is this much of the window's radius off at most.
_MAX_OFFSET_SHARE = 0.5
# Of the window's size.
_ROUNDED = 1e-6
# Half width of the window around a corner, of the distance to the next corner; tags have their border beside them.
_WINDOW, _WINDOW_OF_TAG = 0.6, 0.3
# What OpenCV's refined corners scatter by, pixels; the scatter about the board's drawing corrects it.
_PIXEL_SIGMA = 0.1
# A scanner's scale is off by less than this; a board that differs more is another one.
_SCALE_TOLERANCE = 0.03
# Corners so many sigmas off the drawing are wrong.
_CORNER_GATE = 5.0
_MIN_SIGMA_FACTOR = 0.3


@dataclass(frozen=True)
class Board:
    """What is printed on it; lengths in mm, or in another unit after `scaled`."""

    kind: str  # "charuco", "checkerboard", "apriltag"
    columns: int  # squares; 0 for tags
    rows: int
    square: float  # side of a square, of a tag's black square
    marker: float  # side of a ChArUco board's markers; else 0
    dictionary: str  # OpenCV's name; empty for a checkerboard
    stated: str  # as it was written

    def scaled(self, factor: float) -> "Board":
        """The board in another unit."""
        return replace(self, square=self.square * factor, marker=self.marker * factor)


def parse_board(stated: str) -> Board:
    """Read a board.

    Raises:
        InputError: it is none; says which forms there are.
    """
    kind, *words = stated.split(":")
    try:
        if kind == "charuco" and len(words) == 4:
            columns, rows = _count(words[0])
            square, marker = _length(words[1]), _length(words[2])
            if marker < square and re.fullmatch(r"DICT_\w+", words[3]):
                return Board(kind, columns, rows, square, marker, words[3], stated)
        if kind == "checkerboard" and len(words) == 2:
            columns, rows = _count(words[0])
            return Board(kind, columns, rows, _length(words[1]), 0.0, "", stated)
        if kind == "apriltag" and len(words) == 2 and words[0] in _FAMILIES:
            return Board(kind, 0, 0, _length(words[1]), 0.0, f"DICT_APRILTAG_{words[0]}", stated)
    except ValueError:
        pass
    raise InputError(f"--board {stated}: is no board that is known; to fix: write {_FORMS}")


def _count(word: str) -> tuple[int, int]:
    columns, rows = (int(number) for number in word.lower().split("x"))
    if not 3 <= min(columns, rows) <= max(columns, rows) <= 200:
        raise ValueError(word)
    return columns, rows


def _length(word: str) -> float:
    length = float(word)
    if not 0 < length < _LARGEST_MM:
        raise ValueError(word)
    return length


@dataclass(frozen=True)
class Corners:
    """K corners of one board, or of one tag, in one image."""

    names: tuple[str, ...]
    pixels: Array  # (K, 2) column and row; (0, 0) is the middle of the first pixel
    drawing: Array  # (K, 3) on the board, z = 0, in the board's unit


def find_corners(grey: NDArray[np.uint8], board: Board, cv2: Any) -> list[Corners]:
    """Find corners of a board in a grey image (H, W), to a fraction of a pixel; of tags each on its own.

    Names stay the same in every view. ChArUco: Garrido-Jurado et al. 2014; AprilTag: Olson 2011; checkerboards: Duda &
    Frese 2018.

    Args:
        cv2: the module of OpenCV.

    Raises:
        InputError: a dictionary that OpenCV does not have, or a checkerboard that looks the same turned round.
    """
    finder = {"charuco": _charuco, "checkerboard": _checkerboard, "apriltag": _tags}[board.kind]
    return [found for found in finder(np.ascontiguousarray(grey), board, cv2) if len(found.names) >= _MIN_BOARD_CORNERS]


def _dictionary(board: Board, cv2: Any) -> Any:
    code = getattr(cv2.aruco, board.dictionary, None)
    if not isinstance(code, int):
        raise InputError(
            f"--board {board.stated}: OpenCV has no dictionary {board.dictionary}; to fix: write one like DICT_4X4_50, "
            "DICT_5X5_100 or DICT_APRILTAG_36h11"
        )
    return cv2.aruco.getPredefinedDictionary(code)


def _charuco(grey: NDArray[np.uint8], board: Board, cv2: Any) -> list[Corners]:
    dictionary = _dictionary(board, cv2)
    if board.columns * board.rows // 2 > len(dictionary.bytesList):
        raise InputError(
            f"--board {board.stated}: the board has {board.columns * board.rows // 2} markers, the dictionary "
            f"{len(dictionary.bytesList)}; to fix: write the dictionary that it was printed with"
        )
    best: list[Corners] = []
    # Boards with an even number of rows were printed otherwise before OpenCV 4.6.
    for legacy in (False, True):
        drawn = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square, board.marker, dictionary)
        drawn.setLegacyPattern(legacy)
        pixels, ids, _, _ = cv2.aruco.CharucoDetector(drawn).detectBoard(grey)
        if ids is not None and (not best or len(ids) > len(best[0].names)):
            numbers = ids.ravel()
            found = _refined(grey, pixels.reshape(-1, 2), min(_REFINED, (1 - board.marker / board.square) / 2), cv2)
            places = np.asarray(drawn.getChessboardCorners(), float)[numbers]
            best = [Corners(tuple(f"c{i:03d}" for i in numbers), found, places)]
    return best


def _checkerboard(grey: NDArray[np.uint8], board: Board, cv2: Any) -> list[Corners]:
    columns, rows = board.columns - 1, board.rows - 1
    if (columns + rows) % 2 == 0:
        raise InputError(
            f"--board {board.stated}: {board.columns}x{board.rows} squares look the same turned by half a turn, "
            "so that corners cannot be told apart; to fix: use a board with an odd and an even number of squares, or a "
            "ChArUco one"
        )
    found, pixels = cv2.findChessboardCornersSB(grey, (columns, rows), cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY)
    if not found:
        return []
    grid = pixels.reshape(rows, columns, 2).astype(float)
    # Names run so that they turn like x and y of an image, and begin where the outermost square is black.
    across, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if across[0] * down[1] - across[1] * down[0] < 0:
        grid = grid[:, ::-1]
    if _corner_brightness(grey, grid) > _corner_brightness(grey, grid[::-1, ::-1]):
        grid = grid[::-1, ::-1]
    v, u = np.mgrid[:rows, :columns].reshape(2, -1)
    drawing = np.stack([u, v, 0 * u], axis=1) * board.square
    names = tuple(f"c{i:03d}" for i in range(rows * columns))
    return [Corners(names, _refined(grey, grid.reshape(-1, 2), _REFINED, cv2), drawing)]


def _refined(grey: NDArray[np.uint8], pixels: Array, share: float, cv2: Any) -> Array:
    """Corners (K, 2) where the edges around them cross (Förstner & Gülch 1987).

    Args:
        share: half width of the window, of the distance to the next corner; markers stay outside.
    """
    if len(pixels) < 2:
        return np.asarray(pixels, float)
    apart = np.linalg.norm(pixels[:, None] - pixels[None], axis=2)
    spacing = float(np.median(np.where(apart > 0, apart, np.inf).min(axis=1)))
    half = int(np.clip(round(spacing * share), 2, 15))
    ends = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
    start = np.ascontiguousarray(pixels, np.float32).reshape(-1, 1, 2)
    return np.asarray(cv2.cornerSubPix(grey, start, (half, half), (-1, -1), ends), float).reshape(-1, 2)


def _corner_brightness(grey: NDArray[np.uint8], grid: Array) -> float:
    """Of the square that lies diagonally outside the first corner."""
    middle = grid[0, 0] - (grid[1, 1] - grid[0, 0]) / 2
    half = max(1, int(np.linalg.norm(grid[1, 1] - grid[0, 0]) / 8))
    column, row = (round(float(x)) for x in middle)
    around = grey[max(row - half, 0) : row + half + 1, max(column - half, 0) : column + half + 1]
    return float(around.mean()) if around.size else 0.0


def _tags(grey: NDArray[np.uint8], board: Board, cv2: Any) -> list[Corners]:
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    squares, ids, _ = cv2.aruco.ArucoDetector(_dictionary(board, cv2), settings).detectMarkers(grey)
    if ids is None:
        return []
    # Clockwise from the tag's upper left corner.
    drawing = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float) * board.square
    return [
        Corners(tuple(f"t{i:03d}-{k}" for k in range(4)), square.reshape(4, 2).astype(float), drawing)
        for i, square in zip(ids.ravel(), squares, strict=True)
        if list(ids.ravel()).count(i) == 1
    ]


def lift_points(image: RangeImage, pixels: Array, radius: Array, pixel_sigma: float) -> tuple[Array, Array]:
    """Return places (K, 3) and sigma of a coordinate (K,) of image points (K, 2); NaN where too little was measured.

    Around an image point a plane is fitted to what the pixels measured, robustly; on that plane the places of the
    pixels are a smooth function of column and row, here of second order, which gives the place of the point itself.
    Nothing is assumed of the camera. What the pixels scatter by gives the point's sigma.

    Args:
        radius: (K,) half width of the window, pixels.
        pixel_sigma: of the image points themselves, pixels.
    """
    found = [_lift_pixel(image, pixel, r, pixel_sigma) for pixel, r in zip(pixels, radius, strict=True)]
    return np.array([point for point, _ in found]).reshape(-1, 3), np.array([sigma for _, sigma in found])


def _lift_pixel(image: RangeImage, pixel: Array, radius: float, pixel_sigma: float) -> tuple[Array, float]:
    nothing = np.full(3, np.nan), float("nan")
    reach = int(np.clip(round(radius), _MIN_WINDOW, _MAX_WINDOW))
    column, row = (round(float(x)) for x in pixel)
    rows, columns = (np.arange(max(x - reach, 0), x + reach + 1) for x in (row, column))
    window = image.points[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    v, u = np.mgrid[rows[0] : rows[0] + window.shape[0], columns[0] : columns[0] + window.shape[1]]
    seen = np.isfinite(window).all(axis=2)
    if seen.sum() < max(_MIN_WINDOW_PIXELS, _SHARE * (2 * reach + 1) ** 2):
        return nothing
    points, offset = window[seen], np.stack([u[seen], v[seen]], axis=1) - pixel
    kept = _on_plane(points)
    points, offset = points[kept], offset[kept]
    if len(points) < _MIN_WINDOW_PIXELS or np.linalg.norm(offset.mean(axis=0)) > _MAX_OFFSET_SHARE * reach:
        return nothing
    middle = points.mean(axis=0)
    axes = np.linalg.svd(points - middle, full_matrices=False)[2]
    local = (points - middle) @ axes.T
    du, dv = (offset / reach).T
    design = np.stack([np.ones(len(du)), du, dv, du * du, du * dv, dv * dv], axis=1)
    coefficients, *_ = np.linalg.lstsq(design, local[:, :2], rcond=None)
    at = coefficients[0]
    # In the plane: the grid's own scatter, and the image point's.
    free = max(len(points) - 6, 1)
    grid = ((local[:, :2] - design @ coefficients) ** 2).sum(axis=0) / free
    shape = np.linalg.pinv(design.T @ design)
    in_plane = grid * shape[0, 0] + (coefficients[1:3] ** 2).sum(axis=0) * (pixel_sigma / reach) ** 2
    # Across it: a plane of three parameters at that place.
    rows_plane = np.column_stack([np.ones(len(local)), local[:, :2]])
    height = (local[:, 2] ** 2).sum() / max(len(points) - 3, 1)
    here = np.append(1.0, at)
    across = height * float(here @ np.linalg.pinv(rows_plane.T @ rows_plane) @ here)
    return middle + at @ axes[:2], float(np.sqrt((in_plane.sum() + across) / 3))


def _on_plane(points: Array) -> Mask:
    """Find the points (N, 3) that lie on the plane that most lie on (least median of squares, Rousseeuw 1984)."""
    draws = np.random.default_rng(0).integers(len(points), size=(_DRAWS, 3))
    a, b, c = (points[draws[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    good = length > 1e-12 * max(float(np.ptp(points)) ** 2, 1e-300)
    if not good.any():
        return np.zeros(len(points), bool)
    normals = normals[good] / length[good, None]
    off = np.abs((points[None] - a[good][:, None]) @ normals[:, :, None])[..., 0]
    best = int(np.argmin(np.median(off, axis=1)))
    # Without noise the scatter is what numbers are rounded to.
    floor = _ROUNDED * float(np.linalg.norm(np.ptp(points, axis=0)))
    kept = off[best] <= _PLANE_GATE * MAD_TO_SIGMA * np.median(off[best]) + floor
    for _ in range(3):
        middle = points[kept].mean(axis=0)
        normal = np.linalg.svd(points[kept] - middle, full_matrices=False)[2][2]
        off_now: Array = np.abs((points - middle) @ normal)
        kept = off_now <= _PLANE_GATE * MAD_TO_SIGMA * np.median(off_now[kept]) + floor
    return np.asarray(kept, bool)


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
    """Find a board in one view, of tags each tag; none where it is not seen.

    Args:
        board: in the unit of the scan.
        cv2: the module of OpenCV.
    """
    found = find_corners(image.grey, board, cv2)
    if not found and board.kind != "checkerboard":
        # Rows from below make a mirror image, in which no marker is known.
        image = RangeImage(image.points[::-1], image.grey[::-1])
        found = find_corners(image.grey, board, cv2)
    window, placed = _WINDOW_OF_TAG if board.kind == "apriltag" else _WINDOW, []
    for corners in found:
        apart = np.linalg.norm(corners.pixels[:, None] - corners.pixels[None], axis=2)
        nearest = np.where(apart > 0, apart, np.inf).min(axis=1)
        points, sigma = lift_points(image, corners.pixels, window * nearest, _PIXEL_SIGMA)
        placed.append(PlacedBoard(corners.names, points, sigma, corners.drawing).only(np.isfinite(points[:, 0])))
    return [p for p in placed if len(p.names) >= _MIN_BOARD_CORNERS]


def board_sightings(
    views: Sequence[Sequence[PlacedBoard]], board: Board, to_mm: float, label: str
) -> tuple[list[Sighting], list[str]]:
    """Return sightings of all views from what each shows; corners off the drawing go, sigmas follow the scatter.

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
    judged = [p for view in kept for p in view if len(p.names) >= _MIN_BOARD_CORNERS]
    freedom = sum(3 * len(p.names) - 6 for p in judged)
    squares = sum(float((_drawing_deviation(p) ** 2).sum()) for p in judged)
    factor = max(np.sqrt(squares / freedom), _MIN_SIGMA_FACTOR) if freedom else 1.0
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
        if len(placed.names) <= _MIN_BOARD_CORNERS:
            break
        off = _drawing_deviation(placed)
        worst = int(np.argmax(off))
        scatter = MAD_TO_SIGMA * float(np.median(off)) / 1.5
        if off[worst] <= _CORNER_GATE * max(scatter, 1.0):
            break
        placed = placed.only(np.arange(len(off)) != worst)
    return placed


def _drawing_deviation(placed: PlacedBoard) -> Array:
    """(K,) distance from the drawing in sigmas under the rigid motion that fits best."""
    drawn = frames.transform(align_points(placed.drawing, placed.points, placed.sigma**-2), placed.drawing)
    return np.asarray(np.linalg.norm(placed.points - drawn, axis=1) / placed.sigma)
