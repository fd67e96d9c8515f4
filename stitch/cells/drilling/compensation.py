"""Correct a group of holes by the rigid motion that its reference holes show."""

from dataclasses import dataclass

import numpy as np

from stitch import frames
from stitch.cells.point_alignment import align_points, on_a_line
from stitch.errors import NoResultError
from stitch.frames import Array


@dataclass(frozen=True)
class GroupCompensation:
    """Nominal to actual drive coordinates of one group."""

    T_actual_nominal: Array  # (4, 4)
    residuals: Array  # (N, 3) actual minus mapped
    errors: Array  # (N, 3) drive errors, actual minus nominal

    def apply(self, positions: Array, directions: Array) -> tuple[Array, Array]:
        """Corrected positions and directions (M, 3) of holes of the group."""
        return frames.transform(self.T_actual_nominal, positions), frames.rotate(self.T_actual_nominal, directions)


def compensate_group(nominal: Array, actual: Array) -> GroupCompensation:
    """Rigid motion from three or more reference holes (N, 3) by SVD (Kabsch 1976; source, formulas 15 and 16).

    Raises:
        NoResultError: fewer than three holes, or holes on a line.
    """
    nominal, actual = np.asarray(nominal, float), np.asarray(actual, float)
    if len(nominal) < 3 or on_a_line(nominal) or on_a_line(actual):
        raise NoResultError("a group needs three or more reference holes off one line; add a reference hole")
    T = align_points(nominal, actual)
    return GroupCompensation(T, actual - frames.transform(T, nominal), actual - nominal)
