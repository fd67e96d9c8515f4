"""Corners of boards in an image, to a fraction of a pixel, with names that stay the same in every view (OpenCV).

ChArUco: Garrido-Jurado et al. 2014; AprilTag: Olson 2011; checkerboards: Duda & Frese 2018.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stitch.detection.board import Board
from stitch.errors import InputError
from stitch.frames import Array

# Fewer corners of a board hold it on nothing.
_MIN_BOARD_CORNERS = 4
# Largest half width of the window in which corners are refined, of the distance to the next.
_REFINED = 0.25


@dataclass(frozen=True)
class Corners:
    """K corners of one board, or of one tag, in one image."""

    names: tuple[str, ...]
    pixels: Array  # (K, 2) column and row; (0, 0) is the middle of the first pixel
    drawing: Array  # (K, 3) on the board, z = 0, in the board's unit


def find_corners(grey: NDArray[np.uint8], board: Board, cv2: Any) -> list[Corners]:
    """Corners of a board in a grey image (H, W); of tags each tag on its own; empty where none is seen.

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
            best = [Corners(tuple(f"c{i:03d}" for i in numbers), found, _drawn(drawn, numbers))]
    return best


def _drawn(drawn: Any, numbers: NDArray[np.int32]) -> Array:
    return np.asarray(drawn.getChessboardCorners(), float)[numbers]


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
