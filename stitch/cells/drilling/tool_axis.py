"""The tool's true axis in its own frame, from how the robot reports to stand when the tool is upright on a hole.

The rigid motion of hole positions cannot see a tool frame that is turned against the tool; the reference holes can:
there the rangers made the tool upright, so the hole's direction in the reported tool frame is the tool's axis.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import f

from stitch.frames import Array

# With half a dozen reference holes a smaller limit would hide tilts of a degree.
_TILT_P_LIMIT = 0.01
_MIN_HOLES = 4


@dataclass(frozen=True)
class ToolAxis:
    """Mean axis, and whether it differs from z by more than its scatter explains."""

    axis: Array  # (3,) unit vector in the reported tool frame
    tilt: float  # rad, from z
    sigma: float  # rad, of the mean
    p_value: float
    accepted: bool

    def orient(self, R_base_hole: Array) -> Array:
        """Reported orientation (..., 3, 3) that lays the tool's axis along the hole's z; unchanged if not accepted."""
        if not self.accepted:
            return R_base_hole
        turn = np.cross([0.0, 0.0, 1.0], self.axis)
        turn *= self.tilt / np.linalg.norm(turn)
        return np.asarray(R_base_hole @ Rotation.from_rotvec(turn).as_matrix().T)


def find_tool_axis(reported: Array, directions: Array) -> ToolAxis | None:
    """Axis from reported orientations (N, 3, 3) and hole directions (N, 3), both in the base; None below four holes.

    Hotelling's T² of the two small components against zero (Anderson 2003, section 5.2).
    """
    count = len(reported)
    if count < _MIN_HOLES:
        return None
    seen = np.einsum("nji,nj->ni", reported, directions)
    small = seen[:, :2]
    scatter = np.cov(small, rowvar=False)
    mean = small.mean(axis=0)
    F = count * mean @ np.linalg.pinv(scatter) @ mean * (count - 2) / (2 * (count - 1))
    p = float(f.sf(F, 2, count - 2))
    axis = seen.mean(axis=0)
    axis /= np.linalg.norm(axis)
    tilt = float(np.arctan2(np.hypot(axis[0], axis[1]), axis[2]))
    return ToolAxis(axis, tilt, float(np.sqrt(np.trace(scatter) / 2 / count)), p, p < _TILT_P_LIMIT)
