"""The deviation map: signed distances of scanned points from the CAD with its stock, and cells out of tolerance."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from stitch import frames
from stitch.cells.pose_table import write_columns
from stitch.cells.window.allowance import Allowance
from stitch.cells.window.cad import CadSurface, nearest_partners
from stitch.cells.window.joined_scans import JoinedScans
from stitch.frames import Array

# A cell with fewer points has no mean worth a verdict.
_MIN_MAP_POINTS = 5


@dataclass(frozen=True)
class DeviationCells:
    """C cells of the map: points of one cube that look the same way, averaged."""

    middle: Array  # (C, 3) part frame
    mean: Array  # (C,) deviation, positive outside
    spread: Array  # (C,) 1-sigma of the points
    count: NDArray[np.int64]  # (C,)


@dataclass(frozen=True)
class Deviations:
    """N points that have a place on the CAD, part frame."""

    points: Array  # (N, 3)
    distance: Array  # (N,) positive outside
    tolerance: float
    cells: DeviationCells

    @property
    def outside(self) -> NDArray[np.bool_]:
        """(C,) cells whose mean is beyond the tolerance."""
        return np.asarray(np.abs(self.cells.mean) > self.tolerance)


def measure_deviations(
    scan: JoinedScans,
    cad: CadSurface,
    T_base_part: Array,
    tolerance: float,
    cell: float,
    allowance: Allowance | None = None,
) -> Deviations:
    """Distances of all usable points from the CAD, or from the CAD with its allowance; cells average the noise away.

    Args:
        T_base_part: (4, 4) where the part lies.
        tolerance, cell: of a cell's mean, and its edge length; the CAD's unit.
    """
    T = frames.inverse(T_base_part)
    local = frames.transform(T, scan.points[scan.usable])
    found = nearest_partners(cad, local, frames.rotate(T, scan.normals[scan.usable]))
    points, distance, normal = local[found.accept], found.distance[found.accept], found.normal[found.accept]
    if allowance is not None:
        distance = distance - allowance.at(points)
    key = np.hstack([np.floor(points / cell), np.round(normal)]).astype(np.int64)
    _, where, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    where = where.ravel()

    def mean(values: Array) -> Array:
        return np.asarray(np.bincount(where, values, len(count)) / count)

    average = mean(distance)
    middle = np.column_stack([mean(points[:, k]) for k in range(3)])
    spread = np.sqrt(np.maximum(mean((distance - average[where]) ** 2), 0.0))
    full = count >= _MIN_MAP_POINTS
    cells = DeviationCells(middle[full], average[full], spread[full], count[full].astype(np.int64))
    return Deviations(points, distance, tolerance, cells)


def write_deviation_ply(file: Path, deviations: Deviations) -> None:
    """Points with the scalar `deviation` and a colour: blue inside, red outside, full at the tolerance."""
    share = np.clip(deviations.distance / deviations.tolerance, -1, 1)
    vertex = np.empty(
        len(share), [(n, "f4") for n in ("x", "y", "z", "deviation")] + [(n, "u1") for n in ("red", "green", "blue")]
    )
    vertex["x"], vertex["y"], vertex["z"] = deviations.points.T
    vertex["deviation"] = deviations.distance
    pale = 235 * (1 - np.abs(share))
    vertex["red"], vertex["green"] = np.where(share > 0, 235, pale), pale
    vertex["blue"] = np.where(share < 0, 235, pale)
    PlyData([PlyElement.describe(vertex, "vertex")]).write(str(file))


def write_deviation_csv(file: Path, deviations: Deviations) -> None:
    """One row per cell, the worst first."""
    c, order = deviations.cells, np.argsort(-np.abs(deviations.cells.mean))
    columns = {axis: c.middle[order, k] for k, axis in enumerate("xyz")}
    columns |= {"deviation": c.mean[order], "spread": c.spread[order]}
    verdicts = ["bad" if bad else "good" for bad in deviations.outside[order]]
    write_columns(file, {**columns, "points": c.count[order].tolist(), "verdict": verdicts})
