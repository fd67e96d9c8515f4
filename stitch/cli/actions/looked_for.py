"""What `--board` and `--ball` say, read."""

from stitch.detection.board import parse_board
from stitch.errors import InputError
from stitch.intake.targets_in_scans import TargetSearch

# Larger balls fit on no table.
_LARGEST_MM = 2000.0


def parse_target_options(board: list[str] | None, ball: list[str] | None) -> TargetSearch:
    """What the options say.

    Raises:
        InputError: no board that is known, or no radius.
    """
    return TargetSearch(tuple(parse_board(text) for text in board or ()), _ball_radii(ball) if ball else None)


def _ball_radii(stated: list[str]) -> tuple[float, ...]:
    """Radii in mm; none for balls of any radius."""
    if stated == ["any"]:
        return ()
    try:
        radii = tuple(float(text) for text in stated)
    except ValueError:
        radii = (0.0,)
    if not all(0 < radius < _LARGEST_MM for radius in radii):
        raise InputError(f"--ball {' --ball '.join(stated)}: to fix: state radii in mm, above 0, or any alone")
    return radii
