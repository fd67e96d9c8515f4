"""[scanner] of session.toml: where it sits, what it is, and which of what it shows counts."""

from pathlib import Path
from typing import Any, cast, get_args

import numpy as np

from stitch import frames
from stitch.errors import InputError
from stitch.frames import Array
from stitch.measurement.session import Scanner, SensorKind
from stitch.reading.session_toml import LARGEST, positive_number
from stitch.reading.text_file import shortened
from stitch.reading.toml_file import table_choice

# Effects of the scanner count its field as x/z and y/z: they know no scanner that looks along x or y.
_AXES = {"+z": np.array([0.0, 0.0, 1.0]), "-z": np.array([0.0, 0.0, -1.0])}


def read_scanner(file: Path, table: dict[str, Any]) -> Scanner:
    """[scanner]; lengths in length_unit.

    Raises:
        InputError: a value that cannot be, and how to fix it.
    """
    axis = table.get("optical_axis", "+z")
    if axis not in tuple(_AXES):
        raise InputError(
            f"{file}: scanner.optical_axis is {shortened(axis)}; turn the clouds until their scanner looks along z, "
            'and write the side: "+z" or "-z"'
        )
    T_mount = None
    if "pose" in table:
        T_mount = _read_pose(file, table["pose"])
    noise, standoff = (positive_number(file, table, "scanner", key) for key in ("noise", "standoff"))
    kind = table_choice(file, table, "kind", get_args(SensorKind)) if "kind" in table else None
    return Scanner(T_mount, noise, standoff, _AXES[axis], cast(SensorKind | None, kind))


def read_crop_box(file: Path, table: dict[str, Any]) -> Array | None:
    """[scanner] within: (2, 3) lowest and highest corner of the box that counts, scanner frame, length_unit.

    Raises:
        InputError: not two corners, or the second one not above the first.
    """
    if "within" not in table:
        return None
    try:
        box = np.array(table["within"])
    except ValueError:
        box = np.zeros(0)
    # Words and true are numbers to NumPy; integers of hundreds of digits are objects.
    is_box = box.shape == (2, 3) and box.dtype.kind in "if" and bool(np.isfinite(box).all())
    if not is_box or not (box[0] < box[1]).all():
        raise InputError(
            f"{file}: scanner.within is {shortened(table['within'])}; state the lowest and the highest corner of the "
            "box that counts, in the scanner's frame: [[-200, -200, 300], [200, 200, 600]]"
        )
    return box.astype(float)


def _read_pose(file: Path, value: Any) -> Array:
    try:
        T = np.array(value, float)
    except (TypeError, ValueError, OverflowError):
        T = np.empty(0)
    if T.shape != (4, 4) or not (np.abs(T) < LARGEST).all():
        raise InputError(f"{file}: scanner.pose is no 4×4 matrix; to fix: write four rows of four numbers")
    off = float(np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max())
    if off > 1e-3 or np.linalg.det(T[:3, :3]) < 0 or np.abs(T[3] - [0, 0, 0, 1]).max() > 1e-9:
        raise InputError(
            f"{file}: scanner.pose is not a rigid motion (R·Rᵀ differs from 1 by {off:.2g}, "
            f"det {np.linalg.det(T[:3, :3]):+.3f}); write a rotation, and 0 0 0 1 in the last row"
        )
    return frames.make(frames.nearest_rotation(T[:3, :3]), T[:3, 3])
