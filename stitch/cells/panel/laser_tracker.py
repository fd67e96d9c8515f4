"""What a laser tracker's points are worth."""

from dataclasses import dataclass

import numpy as np

from stitch.frames import Array


@dataclass(frozen=True)
class LaserTracker:
    """Lengths in mm. The maker's 10 µm + 5 µm/m is taken as one sigma of every coordinate, which is cautious."""

    position: Array  # (3,) in the world frame
    constant: float = 0.010
    per_length: float = 5e-6

    def sigma(self, points: Array) -> Array:
        """Sigma of each coordinate of points (..., 3) in the world frame -> (...)."""
        return np.asarray(self.constant + self.per_length * np.linalg.norm(points - self.position, axis=-1))
