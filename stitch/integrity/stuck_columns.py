"""A column of the positions that holds one value in all rows, though the scanner moved along it."""

from collections.abc import Iterator

import numpy as np

from stitch import frames
from stitch.integrity.fitted_positions import fit_positions
from stitch.integrity.hypotheses import Hypothesis
from stitch.integrity.motion_fit import MotionFit
from stitch.integrity.relative_scans import RelativeScans

# Of the largest span of a column: less is one value.
_ONE_VALUE = 1e-6


def restore_stuck_columns(stated: MotionFit, motions: RelativeScans, length: float) -> Iterator[Hypothesis]:
    """The poses with the values of such a column that the motions ask for, if most rows have others.

    Args:
        length: what a motion may leave open, length_unit.
    """
    h = stated.hypothesis
    T, R_mount = h.T_base_flange, stated.T_mount[:3, :3]
    position, views = T[:, :3, 3], len(T)
    span = np.ptp(position, axis=0)
    for axis in np.flatnonzero(span <= _ONE_VALUE * span.max()):
        Q = np.zeros((views, 3, views))
        Q[np.arange(views), axis, np.arange(views)] = 1.0
        moved = fit_positions(T[:, :3, :3], (position, Q), h.mount, motions, range(views), R_mount)
        column = moved[:, axis]
        if np.median(np.abs(column - np.median(column))) > length:
            fix = (
                f"{'xyz'[axis]} of the positions is {position[0, axis]:.6g} in all rows, and the scans show that it "
                "changes: export the poses again, with this column"
            )
            yield Hypothesis("scale", frames.make(T[:, :3, :3], moved), h.mount, fix)
