"""Which frames of tf are base and flange, and who carries the scanner: by what moves, then by name."""

from collections.abc import Sequence
from dataclasses import dataclass

from stitch.errors import InputError
from stitch.intake.transform_tree import TransformTree

# As REP 199 and drivers of robots name them, the usual first.
_FLANGES = ("tool0", "flange", "ee_link", "link_ee")
_BASES = ("base_link", "base", "link_0", "world")


@dataclass(frozen=True)
class BagFrames:
    """Names of frames of tf."""

    base: str
    flange: str
    scanner: str
    mount: str
    reason: str
    hand_eye_known: bool  # tf says where the scanner sits


def identify_frames(tree: TransformTree, scanner: str, named: Sequence[str]) -> BagFrames:
    """Tell the frames.

    Args:
        scanner: frame of the scans.
        named: base, flange and, if it is another, scanner, as a person states them.

    Raises:
        InputError: a frame that tf does not know, or nothing that moves.
    """
    scanner = named[2] if len(named) > 2 else scanner
    unknown = next((frame for frame in named if frame not in tree.names), None)
    if unknown is not None:
        raise InputError(f"--frames: tf has no {unknown}; to fix: use {', '.join(tree.names)}")
    path = tree.above(scanner)[::-1]
    moving = [i for i in range(1, len(path)) if tree.moves(path[i])]
    known = len(path) > 1
    if len(named) > 1:
        base, flange, reason = named[0], named[1], "stated with --frames"
        carried = bool(moving) and flange in path
    elif moving:
        first, last = moving[0], moving[-1]
        base = _most_usual_name(path[:first], _BASES) or path[first - 1]
        # Tools that are fixed to the last link beside the scanner's way count too.
        fixed = [f for f in tree.names if path[last] in tree.above(f) and _is_rigid(tree, f, path[last])]
        flange = _most_usual_name(fixed, _FLANGES) or path[last]
        carried, reason = True, f"the scanner's frame {scanner} moves with it"
    else:
        ends = [f for f in tree.names if tree.moves(f)]
        if not ends:
            raise InputError("tf: no frame moves, so that nothing says where the arm is; to fix: record /tf of the arm")
        last_end = max(ends, key=lambda f: len(tree.above(f)))
        chain = tree.above(last_end)[::-1]
        first = next(i for i in range(1, len(chain)) if tree.moves(chain[i]))
        base = _most_usual_name(chain[:first], _BASES) or chain[first - 1]
        fixed = [f for f in tree.names if last_end in tree.above(f) and _is_rigid(tree, f, last_end)]
        flange = _most_usual_name(fixed, _FLANGES) or last_end
        carried, reason = False, f"the scanner's frame {scanner} does not move"
        known = known and bool(set(path) & set(chain))
    return BagFrames(base, flange, scanner, "eye_in_hand" if carried else "eye_to_hand", reason, known)


def _most_usual_name(frames: Sequence[str], usual_names: Sequence[str]) -> str | None:
    """The frame with the most usual name; names may have a prefix of their robot."""
    for name in usual_names:
        fitting = [frame for frame in frames if frame == name or frame.endswith(f"_{name}")]
        if fitting:
            return fitting[-1]
    return None


def _is_rigid(tree: TransformTree, frame: str, link: str) -> bool:
    """Whether nothing moves between a link and a frame above which it lies."""
    path = tree.above(frame)
    return not any(tree.moves(f) for f in path[: path.index(link)])
