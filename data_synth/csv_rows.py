"""Tables of a simulated cell as CSV, and poses as their rows."""

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

POSE = "x y z a_deg b_deg c_deg"


def pose_numbers(T: Array, digits: int) -> list[float]:
    """x, y, z (mm) and the turns about z, y', x'' (deg) of a pose (4, 4)."""
    angles = Rotation.from_matrix(T[:3, :3]).as_euler("ZYX", degrees=True)
    return [round(float(v), digits) for v in (*T[:3, 3], *angles)]


def write_rows(file: Path, header: str, rows: Iterable[Sequence[object]]) -> None:
    """Write rows under a header, whose names are separated by blanks."""
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(header.split())
        writer.writerows(rows)
