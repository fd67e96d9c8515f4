"""A program's text with moved targets: their numbers change, every other byte stays."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from stitch import frames
from stitch.controllers.pose_numbers import NUMBERS
from stitch.controllers.program import Program
from stitch.controllers.taught import Span
from stitch.export.program_targets import couple_j2_j3
from stitch.frames import Array

# Decimals of positions, of rotations and of joint angles: what each controller stores, so that a moved target is not
# rounded away where its number was written short. FANUC listings have three, whatever they show.
_DECIMALS = {"kuka": (4, 5, 5), "fanuc": (3, 3, 3), "abb": (4, 9, 5), "ur": (7, 7, 7)}
# A move below this (mm and rad together) is none: numbers are not written anew for rounding's sake.
_NEGLIGIBLE_CHANGE = 1e-9


def compensated_texts(program: Program, moves: Array, turns: Array, j2_in_j3: bool = False) -> dict[Path, str]:
    """The program's texts with its targets moved.

    Args:
        moves: (K, 4, 4) of each target's tool in mm: T_meant_commanded.
        turns: (K, n) rad that each joint is commanded farther; counted where a target has joint angles.
        j2_in_j3: the joints are those of a session whose third one is J2 + J3 of this FANUC.
    """
    edits: dict[Path, list[tuple[Span, str]]] = {file: [] for file in program.texts}
    place, turn, joint = _DECIMALS[program.controller]
    for point, move, step in zip(program.points, moves, turns, strict=True):
        file = point.file or program.file
        text = program.texts[file]
        if point.T_frame_tool is not None and np.abs(frames.log(move)).max() > _NEGLIGIBLE_CHANGE:
            old = _span_values(text, point.pose_at)
            new = NUMBERS[program.controller](point.T_frame_tool @ move, old)
            new = _in_half_turns(new, old) if program.controller in ("kuka", "fanuc") else new
            edits[file] += _edits(text, point.pose_at, new, [place] * 3 + [turn] * (len(new) - 3))
        if point.joints is not None and np.abs(step).max() > _NEGLIGIBLE_CHANGE:
            own = couple_j2_j3(step, -1.0) if j2_in_j3 else step
            angles = own if program.controller == "ur" else np.degrees(own)
            new = _span_values(text, point.joints_at) + angles
            edits[file] += _edits(text, point.joints_at, new, [joint] * len(new))
    return {file: _apply_edits(text, edits[file]) for file, text in program.texts.items()}


def number_text(old: str, value: float, decimals: int) -> str:
    """A number in the manner of the one that it replaces; the same text where it says the same."""
    own = len(old.lower().split("e")[0].partition(".")[2])
    text = f"{value:.{max(own, decimals)}f}"
    if float(text) == float(old):
        return old
    if old.lstrip("+-").startswith("."):
        text = text.replace("0.", ".", 1) if text.lstrip("-").startswith("0.") else text
    return "+" + text if old.startswith("+") and value >= 0 else text


def _span_values(text: str, spans: Sequence[Span]) -> Array:
    return np.array([float(text[begin:end]) for begin, end in spans])


def _in_half_turns(new: Array, old: Array) -> Array:
    """Angles in degrees within ±180, as controllers take them, unless they were beyond already."""
    wrapped = (new[3:] + 180) % 360 - 180
    return np.append(new[:3], np.where(np.abs(old[3:]) <= 180, wrapped, new[3:]))


def _edits(text: str, spans: Sequence[Span], new: Array, decimals: Sequence[int]) -> list[tuple[Span, str]]:
    return [
        (span, number_text(text[slice(*span)], float(value), places))
        for span, value, places in zip(spans, new, decimals, strict=True)
    ]


def _apply_edits(text: str, edits: Sequence[tuple[Span, str]]) -> str:
    """From behind, so that places before an edit stay."""
    for (begin, end), new in sorted(edits, reverse=True):
        text = text[:begin] + new + text[end:]
    return text
