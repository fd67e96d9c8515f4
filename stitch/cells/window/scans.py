"""Scans of a part from several robot poses, joined in the robot's base frame."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stitch import frames
from stitch.cells.csv_table import read_columns
from stitch.cells.pose_table import COLUMNS, from_columns
from stitch.clouds import read_cloud
from stitch.errors import InputError
from stitch.frames import Array, Indices
from stitch.scan import Scan, prepare_view

# Fewer points have no neighbourhoods from which normals could be taken.
_FEWEST = 50


@dataclass(frozen=True)
class Joined:
    """N points of all scans, base frame, length_unit."""

    points: Array  # (N, 3)
    normals: Array  # (N, 3) unit, towards the scanner
    usable: NDArray[np.bool_]  # (N,) neither edge nor crease nor grazing
    area: Array  # (N,) surface per point
    spacing: float
    noise: float  # 1-sigma across the surface, from the scans themselves

    def take(self, keep: NDArray[np.bool_] | Indices) -> "Joined":
        """The points of a mask or of indices."""
        return Joined(
            self.points[keep], self.normals[keep], self.usable[keep], self.area[keep], self.spacing, self.noise
        )


def join(scans: Sequence[Scan], T_base_scanner: Array) -> Joined:
    """One cloud of scans in their scanner frames and their poses (V, 4, 4)."""
    pairs = list(zip(scans, T_base_scanner, strict=True))
    return Joined(
        np.vstack([frames.transform(T, scan.points) for scan, T in pairs]),
        np.vstack([frames.rotate(T, scan.normals) for scan, T in pairs]),
        np.concatenate([scan.usable for scan in scans]).astype(bool),
        np.concatenate([scan.area for scan in scans]),
        float(np.median([scan.spacing for scan in scans])),
        float(np.median([scan.noise for scan in scans])),
    )


def read_scans(file: Path) -> Joined:
    """Read a table of scans: `file` and the scanner's pose in the base, x y z a_deg b_deg c_deg.

    Raises:
        InputError: the table or a cloud is missing or malformed, or a cloud has too few points.
    """
    table = read_columns(file, "file", COLUMNS)
    scans = []
    for name in table.texts["file"]:
        points = read_cloud(file.parent / name).points
        if len(points) < _FEWEST:
            raise InputError(f"{file.parent / name}: {len(points)} points are too few; scan again or drop its row")
        scans.append(prepare_view(name, points))
    return join(scans, from_columns(table))
