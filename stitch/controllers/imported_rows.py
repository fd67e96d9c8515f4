"""Rows of views.csv, frames.csv and points.csv."""

import csv
import io
from collections.abc import Iterable, Sequence

import numpy as np

from stitch import frames
from stitch.controllers.taught import TaughtPoint
from stitch.frames import Array

POSE_COLUMNS = ("x", "y", "z", "qx", "qy", "qz", "qw")


def view_rows(
    points: Sequence[TaughtPoint], T_base_frame: Array, T_tool_flange: Array, scale: float
) -> list[list[str]]:
    """Header and rows of views.csv; `scale` from mm to the session's unit. What a point lacks stays empty."""
    joints = max((len(p.joints) for p in points if p.joints is not None), default=0)
    posed = any(p.T_frame_tool is not None for p in points)
    rows = [["view", *(f"j{i + 1}_deg" for i in range(joints)), *(POSE_COLUMNS if posed else ())]]
    for name, point in zip(numbered_names(p.name for p in points), points, strict=True):
        row = [name]
        if joints:
            row += [""] * joints if point.joints is None else [f"{q:.9g}" for q in np.degrees(point.joints)]
        if posed:
            T = None if point.T_frame_tool is None else T_base_frame @ point.T_frame_tool @ T_tool_flange
            row += [""] * len(POSE_COLUMNS) if T is None else pose_cells(T, scale)
        rows.append(row)
    return rows


def pose_cells(T: Array, scale: float) -> list[str]:
    """Position and quaternion of a pose (4, 4) as cells of a table."""
    return [*(f"{x * scale:.9g}" for x in T[:3, 3]), *(f"{q:.10f}" for q in frames.to_quaternion(T))]


def numbered_names(names: Iterable[str]) -> list[str]:
    """The names, numbered from the second on where one stands again."""
    out: list[str] = []
    taken: set[str] = set()
    for name in names:
        plain, k = name.strip() or "view", 1
        label = plain
        while label in taken:
            k += 1
            label = f"{plain}_{k}"
        taken.add(label)
        out.append(label)
    return out


def csv_text(rows: Sequence[Sequence[str]]) -> str:
    """Rows as the text of a CSV file."""
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows(rows)
    return stream.getvalue()
