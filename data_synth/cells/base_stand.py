"""Two robots that cannot reach each other and a stand between them, with known truth, as `stitch base` reads it.

Lengths in m, angles in rad. The main robot touches cups on a level rail; a rod turns on a pivot that slides along it;
the second robot touches the rod's cup. Both bases stand upright to within a spirit level.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tomli_w
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stitch.numerics import frames

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sizes:
    """One sigma each."""

    point: float = 1e-4  # a touched point, along each axis
    slide: float = 1e-4
    angle: float = 1e-4
    length: float = 1e-4
    level: float = 5e-4  # stand and second base


@dataclass
class TwoBases:
    """The true cell, and what is read on it."""

    seed: int
    sizes: Sizes = Sizes()
    settings: int = 4  # of the rod
    T_base1_base2: Array = field(init=False)
    T_base1_stand: Array = field(init=False)

    def __post_init__(self) -> None:
        rng, s = np.random.default_rng(self.seed), self.sizes
        turn = Rotation.from_euler("ZYX", [rng.uniform(-np.pi, np.pi), *rng.normal(0, s.level, 2)])
        self.T_base1_base2 = frames.make(turn.as_matrix(), [rng.uniform(3, 5), rng.uniform(-1.5, 1.5), 1.0])
        # The rail lies across, before the main robot, and the rod swings level over it.
        along = Rotation.from_euler("ZYX", [-np.pi / 2 + rng.normal(0, 0.1), 0.0, rng.normal(0, s.level)])
        self.T_base1_stand = frames.make(along.as_matrix(), [1.17, -0.85, 1.3])
        self.rail = np.array([[-1.7, 0.0, 0.0], [0.0, 0.0, 0.0]])
        # Where the second robot can touch: spread before its base.
        reach = np.array([0.7, 0.0, 0.3]) + rng.uniform(-0.25, 0.25, (self.settings, 3)) * [1.0, 1.0, 0.0]
        wanted = frames.transform(frames.inverse(self.T_base1_stand) @ self.T_base1_base2, reach)
        self.slide = np.full(self.settings, 2.5)
        arm = wanted[:, :2] - np.column_stack([self.slide, 0 * self.slide])
        self.length = np.linalg.norm(arm, axis=1)
        # From the rail's direction back to the first cup, clockwise as seen from above.
        self.angle = np.arctan2(arm[:, 1], -arm[:, 0])
        self.cups = np.column_stack([wanted[:, :2], 0 * self.slide])
        self.rng = rng

    def write(self, file: Path) -> None:
        """Touch, read, and write the stand file."""
        s, rng = self.sizes, self.rng
        rail = frames.transform(self.T_base1_stand, self.rail)
        rod = frames.transform(frames.inverse(self.T_base1_base2) @ self.T_base1_stand, self.cups)
        touched = [points + rng.normal(0, s.point, points.shape) for points in (rail, rod)]
        main = [{"name": f"P{i + 1}", "point": p.tolist()} for i, p in enumerate(touched[0])]
        main[-1]["slide"] = 0.0
        readings = {
            "slide": self.slide + rng.normal(0, s.slide),
            "angle": self.angle + rng.normal(0, s.angle, self.settings),
            "length": self.length + rng.normal(0, s.length, self.settings),
        }
        second = [
            {"name": f"R{i + 1}", "point": p.tolist(), **{key: float(values[i]) for key, values in readings.items()}}
            for i, p in enumerate(touched[1])
        ]
        document = {
            "format": "stitch-base/1",
            "length_unit": "m",
            "angle_unit": "rad",
            "main": {"sigma": {"point": s.point}, "points": main},
            "second": {"sigma": {"point": s.point}, "points": second},
            "rod": {"turn": "clockwise", **{f"sigma_{key}": getattr(s, key) for key in readings}},
            "level": {"stand": s.level, "second_base": s.level},
        }
        file.write_text(tomli_w.dumps(document), encoding="utf-8")
