"""Boxes of the part frame: where the scan must show the part, and where nothing of it may be believed."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from stitch.cells.window.cad import CadSurface
from stitch.frames import Array


@dataclass(frozen=True)
class Box:
    """An axis-parallel box of the part frame."""

    name: str
    low: Array  # (3,)
    high: Array  # (3,)

    def holds(self, points: Array) -> NDArray[np.bool_]:
        """(N,) which points (N, 3) lie inside."""
        return np.asarray(((points >= self.low) & (points <= self.high)).all(axis=1))


@dataclass(frozen=True)
class Regions:
    """Expected: the fit rests on them alone, and the scan must cover them. Forbidden: clamps, glue, other parts."""

    expected: tuple[Box, ...] = field(default=())
    forbidden: tuple[Box, ...] = field(default=())

    def used(self, points: Array) -> NDArray[np.bool_]:
        """(N,) which points (N, 3), part frame, the fit may use."""
        inside = np.ones(len(points), bool)
        if self.expected:
            inside = np.any([box.holds(points) for box in self.expected], axis=0)
        for box in self.forbidden:
            inside &= ~box.holds(points)
        return inside


def coverage(box: Box, cad: CadSurface, points: Array, normals: Array) -> float:
    """Share of the CAD in the box, on its better seen side, that has a scanned point (N, 3) close by; part frame.

    Of a thin sheet only one side can be seen, so samples that look the way the scan's points in the box look count.
    """
    inside = box.holds(points)
    samples = np.flatnonzero(box.holds(cad.samples))
    if not len(samples) or not inside.any():
        return 0.0
    facing = cad.normals[samples] @ normals[inside].mean(axis=0) > 0.5
    cell = max(3 * cad.spacing, float(np.ptp(cad.samples[samples], axis=0).max()) / 20)
    wanted = {tuple(c) for c in np.floor(cad.samples[samples[facing]] / cell).astype(int)}
    seen = {tuple(c) for c in np.floor(points[inside] / cell).astype(int)}
    return len(wanted & seen) / max(len(wanted), 1)
