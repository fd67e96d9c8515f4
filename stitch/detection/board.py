"""A calibration board as a person states it: charuco:11x8:20:15:DICT_4X4_50, checkerboard:9x6:25, apriltag:36h11:40."""

import re
from dataclasses import dataclass, replace

from stitch.errors import InputError

_FORMS = (
    "charuco:11x8:20:15:DICT_4X4_50 (squares, their side and that of the markers in mm, OpenCV's dictionary), "
    "checkerboard:9x6:25 (squares, side in mm) or apriltag:36h11:40 (family, side of the black square in mm)"
)
_FAMILIES = ("16h5", "25h9", "36h10", "36h11")
_LARGEST_MM = 5000.0


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
