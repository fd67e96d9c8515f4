"""Exports of laser trackers: a name, x, y, z and, for 6D probes, a rotation; in mm or m.

Columns by name, whatever their case and unit ("X [mm]", "Qw", "Rx (deg)"). Rotations: a quaternion by its
letters (w, x, y, z, or 0 to 3 with w first), or Rx, Ry, Rz in degrees about the fixed x, y, z axes.
Separators are commas, semicolons or tabs; with semicolons or tabs numbers may have decimal commas.
"""

import csv
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.numerics.frames import Array
from stitch.plugins.intake.controllers.taught_points import fixed_xyz, pose_from_quaternion
from stitch.session.reading.csv_files import finite_number

CONVENTION = "quaternion by its letters, or Rx, Ry, Rz in degrees about fixed x, y, z: Rz·Ry·Rx; mm or m by the header"

_NAMES = ("name", "point", "pointname", "target", "id", "view", "measurement")
_QUATERNIONS = (("qx", "qy", "qz", "qw"), ("q1", "q2", "q3", "q0"))
_ANGLES = ("rx", "ry", "rz")


@dataclass(frozen=True)
class TrackerPoint:
    """One measurement of the tracker."""

    name: str
    line: int
    position: Array  # (3,) mm
    T_sensor_probe: Array | None  # (4, 4) mm, for 6D probes


def split_header(text: str) -> tuple[list[str], str]:
    """Return names of the columns, lower case without units, and the separator."""
    first = next((line for line in text.splitlines() if line.strip()), "")
    separator = next((s for s in ";\t," if s in first), ",")
    plain = [re.sub(r"[\[(].*|[\s_°]", "", cell.strip().strip('"').lower()) for cell in first.split(separator)]
    return [name.removesuffix("deg") for name in plain], separator


def read(file: Path, text: str) -> list[TrackerPoint]:
    """Return measurements in the order of the file.

    Raises:
        InputError: names the line and how to fix it.
    """
    header, separator = split_header(text)
    if not all(axis in header for axis in "xyz"):
        raise InputError(f"{file} line 1: no columns x, y, z in {', '.join(header)}; to fix: name them in the header")
    first = text.strip().splitlines()[0].lower()
    scale = 1000.0 if re.search(r"x\s*[\[(]\s*m\s*[\])]", first) else 1.0
    quaternion = next((q for q in _QUATERNIONS if all(n in header for n in q)), None)
    angles = quaternion is None and all(n in header for n in _ANGLES)
    if angles and not re.search(r"deg|°", first):
        raise InputError(
            f"{file} line 1: rx, ry, rz may be degrees or a rotation vector; to fix: write Rx (deg) … for a "
            "tracker's angles, actual_TCP_pose_0 … for a UR's pose"
        )
    out: list[TrackerPoint] = []
    reader = csv.reader(text.splitlines(), delimiter=separator, skipinitialspace=True)
    rows = [(reader.line_num, cells) for cells in reader if any(cell.strip() for cell in cells)]
    for line, cells in rows[1:]:
        if len(cells) < len(header):
            raise InputError(
                f"{file} line {line}: {len(cells)} cells, the header has {len(header)}; to fix: correct the line"
            )
        row = dict(zip(header, cells, strict=False))
        if separator != ",":
            row = {key: cell.replace(",", ".") for key, cell in row.items()}
        name = next((row[n].strip() for n in _NAMES if row.get(n, "").strip()), f"m{len(out) + 1}")
        position = scale * np.array([finite_number(file, line, axis, row[axis]) for axis in "xyz"])
        out.append(TrackerPoint(name, line, position, _pose(file, line, row, position, quaternion, angles)))
    return out


def _pose(
    file: Path, line: int, row: dict[str, str], position: Array, quaternion: tuple[str, ...] | None, angles: bool
) -> Array | None:
    if angles:
        return fixed_xyz(np.append(position, [finite_number(file, line, n, row[n]) for n in _ANGLES]))
    if quaternion is None:
        return None
    q = np.array([finite_number(file, line, n, row[n]) for n in quaternion])
    try:
        return pose_from_quaternion(position, q)
    except ValueError as error:
        raise InputError(f"{file} line {line}: {error}") from None
