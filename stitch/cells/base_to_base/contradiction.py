"""Distances that two instruments give independently: where they differ, one of them is wrong.

The distance between two settings of the rod follows from slide, angle and length alone, whatever the bases are; the
second robot measures the same distance by its joints. So the comparison needs no fit and names its pair of points.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from stitch.cells.base_to_base.stand import Stand, TouchedPoints, rod_points
from stitch.frames import Array


@dataclass(frozen=True)
class DistanceComparison:
    """One distance, by the stand and by a robot's joints."""

    pair: tuple[str, str]
    by_stand: float
    by_robot: float
    sigma: float  # of the difference

    @property
    def difference(self) -> float:
        """By robot minus by stand."""
        return self.by_robot - self.by_stand

    @property
    def sigmas(self) -> float:
        """|difference| over its sigma."""
        return abs(self.difference) / self.sigma


def compare_distances(stand: Stand) -> tuple[DistanceComparison, ...]:
    """Every pair of rod settings, and every pair of rail points whose slide was read; largest contradiction first."""
    found = [_compare_rod_pair(stand, i, j) for i, j in combinations(range(len(stand.slide)), 2)]
    known = np.flatnonzero(np.isfinite(stand.rail_slide)).tolist()
    found += [_compare_rail_pair(stand, i, j) for i, j in combinations(known, 2)]
    return tuple(sorted(found, key=lambda c: -c.sigmas))


def _compare_rod_pair(stand: Stand, i: int, j: int) -> DistanceComparison:
    """Both slides count as one reading where they are equal: the pivot was not moved."""
    cups = rod_points(stand.slide, stand.angle, stand.length, stand.turn)
    apart = cups[j] - cups[i]
    distance = float(np.linalg.norm(apart))
    unit = apart / max(distance, np.finfo(float).tiny)
    variance = 0.0 if stand.slide[i] == stand.slide[j] else 2 * (unit[0] * stand.sigma_slide) ** 2
    for k in (i, j):
        along = np.array([-np.cos(stand.angle[k]), stand.turn * np.sin(stand.angle[k]), 0.0])
        across = np.array([-along[1], along[0], 0.0])
        variance += (unit @ along * stand.sigma_length) ** 2
        variance += (unit @ across * stand.length[k] * stand.sigma_angle) ** 2
    return _distance_comparison(stand.rod, i, j, distance, variance)


def _compare_rail_pair(stand: Stand, i: int, j: int) -> DistanceComparison:
    distance = abs(float(stand.rail_slide[j] - stand.rail_slide[i]))
    return _distance_comparison(stand.rail, i, j, distance, 2 * stand.sigma_slide**2)


def _distance_comparison(
    touched: TouchedPoints, i: int, j: int, by_stand: float, variance: float
) -> DistanceComparison:
    apart: Array = touched.points[j] - touched.points[i]
    by_robot = float(np.linalg.norm(apart))
    unit = apart / max(by_robot, np.finfo(float).tiny)
    variance += float(unit @ (touched.covariance[i] + touched.covariance[j]) @ unit)
    return DistanceComparison((touched.names[i], touched.names[j]), by_stand, by_robot, float(np.sqrt(variance)))
