"""How far the decimals in which a table states rotations turn its poses: read from the poses themselves."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.screening.hypotheses import ORDERS, euler_angles

# Of a step: numbers that are whole within this were rounded. By chance one row in thousands is.
_WHOLE = 2e-3
_MOST_DECIMALS = 3
# Below so many views chance makes whole numbers.
_FEWEST = 3
_WORDS = {0: "no decimals", 1: "one decimal", 2: "two decimals", 3: "three decimals"}


@dataclass(frozen=True)
class Rounding:
    """Rotations that were written with few decimals."""

    kind: str  # quaternion | euler, as a problem is called
    decimals: int
    rotation: float  # rad, by which rounding turns each pose about an axis, rms

    def describe(self) -> str:
        """Return what rounding alone does, and what to do."""
        what = "quaternions" if self.kind == "quaternion" else "angles"
        return (
            f"The {what} in the table have {_WORDS[self.decimals]}: rounding alone turns each pose by "
            f"{1e3 * self.rotation:.2g} mrad; to fix: export more digits"
        )


def find_rounding(T: Array) -> Rounding | None:
    """Find the decimals of the rotations of poses (V, 4, 4); None where they have more, or too few poses turn."""
    R = Rotation.from_matrix(T[:, :3, :3])
    if len(T) < _FEWEST or frames.angle_between(T[0], T[1:]).max(initial=0.0) == 0:
        return None
    for decimals in range(1, _MOST_DECIMALS + 1):
        step = 0.1**decimals
        if _quaternions_have(R.as_quat(), step):
            # A quaternion is half the rotation vector, and a number rounded to a step scatters by step/√12.
            return Rounding("quaternion", decimals, 2 * step / np.sqrt(12))
    for decimals in range(_MOST_DECIMALS):
        step = 0.1**decimals
        if any(_are_whole(euler_angles(R, order) * 180 / np.pi / step) for order in (*ORDERS, *map(str.lower, ORDERS))):
            return Rounding("euler", decimals, float(np.radians(step)) / np.sqrt(12))
    return None


def _quaternions_have(q: Array, step: float) -> bool:
    """True if each quaternion (V, 4), of any length near 1, has whole numbers of a step."""
    largest = np.abs(q).max(axis=1)
    # What was normalised was shorter or longer by a few steps.
    counts = np.round(largest / step)[:, None] + np.arange(-2, 3)
    numbers = q[:, None] * (counts / largest[:, None])[:, :, None]
    return bool((np.abs(numbers - np.round(numbers)).max(axis=2) < _WHOLE).any(axis=1).all())


def _are_whole(numbers: Array) -> bool:
    return bool((np.abs(numbers - np.round(numbers)) < _WHOLE).all())
