"""frames.csv: measured poses of a probe or board in the sensor's frame, a row per view."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stitch import frames
from stitch.errors import InputError
from stitch.frames import Array
from stitch.reading.csv_lines import read_csv_lines
from stitch.reading.csv_number import finite_number
from stitch.reading.text_file import require_file, shortened

_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_SIGMA = ("sigma", "sigma_deg")
_PROBE_QUATERNION_TOLERANCE = 1e-3


@dataclass(frozen=True)
class MeasuredFrames:
    """Poses of the probe (tracker) or board (camera), in the order of the file."""

    views: tuple[str, ...]
    T_sensor_probe: Array  # (V, 4, 4), length_unit
    sigma: Array | None  # (V,) of a coordinate, length_unit
    sigma_rotation: Array | None  # (V,) of a rotation, rad


def read_frames(file: Path, known: Sequence[str]) -> MeasuredFrames:
    """Read and check frames.csv against the views known from views.csv.

    Raises:
        InputError: names the line and how to fix it.
    """
    require_file(file, f"a frames session needs {','.join(('view', *_POSE))} there")
    header, rows = read_csv_lines(file)
    missing = [name for name in ("view", *_POSE) if name not in header]
    if missing:
        raise InputError(f"{file} line 1: no column {missing[0]!r}; columns are {', '.join(header) or 'none'}")
    if not rows:
        raise InputError(f"{file}: no poses; write one row per view")
    names: dict[str, int] = {}
    table = np.empty((len(rows), len(_POSE)))
    spread = {name: np.empty(len(rows)) for name in _SIGMA if name in header}
    allowed = set(known)
    for i, (line, cells) in enumerate(rows):
        row = dict(zip(header, (cell.strip() for cell in cells), strict=True))
        _check_name(file, line, row["view"], names, allowed)
        table[i] = [finite_number(file, line, name, row[name]) for name in _POSE]
        norm = float(np.linalg.norm(table[i, 3:]))
        if abs(norm - 1) > _PROBE_QUATERNION_TOLERANCE:
            raise InputError(
                f"{file} line {line}: qx,qy,qz,qw has length {norm:.4f}, not a rotation; "
                "write a unit quaternion, w last"
            )
        for name, values in spread.items():
            values[i] = finite_number(file, line, name, row[name])
            if values[i] <= 0:
                raise InputError(f"{file} line {line}: {name} is {values[i]:g}; write a positive number")
    T = frames.from_quaternion(table[:, :3], table[:, 3:])
    turn = spread.get("sigma_deg")
    return MeasuredFrames(tuple(names), T, spread.get("sigma"), None if turn is None else np.radians(turn))


def _check_name(file: Path, line: int, name: str, names: dict[str, int], allowed: set[str]) -> None:
    if name in names:
        raise InputError(f"{file} line {line}: view {name} stands on line {names[name]} already; leave one out")
    if name not in allowed:
        raise InputError(
            f"{file} line {line}: view {shortened(name)} is not in views.csv; add it there or remove the row"
        )
    names[name] = line
