"""Misplaced views that stand off by one and the same displacement: the part was clamped anew, or the scanner moved."""

from collections.abc import Mapping, Sequence

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.integrity.moved_together import end_runs
from stitch.integrity.snooping import MisplacedView
from stitch.measurement.capture import Capture

# So many views make a step, and this share of those on its side; displacements agree within this share of their size.
_FEWEST, _SHARE, _AGREES = 3, 0.7, 0.2


def find_common_displacement(
    capture: Capture, poses: Array, misplaced: Sequence[MisplacedView]
) -> tuple[range, str] | None:
    """The views at one end of the list that stand off alike, with what moved: part or scanner; None if none do.

    Args:
        poses: (V, 4, 4) T_reference_scanner of the model.
    """
    placed = {m.view: m.T for m in misplaced if m.T is not None}
    runs = end_runs({m.view for m in misplaced}, len(poses))
    for views in (run for run in runs if len(run) >= _FEWEST):
        for what in ("part", "scanner"):
            if _count_sharing_displacement(
                capture, poses, {v: placed[v] for v in views if v in placed}, what
            ) >= _SHARE * len(views):
                return views, what
    return None


def _count_sharing_displacement(capture: Capture, poses: Array, placed: Mapping[int, Array], what: str) -> int:
    """How many views at most share one displacement: a left twist if the part moved, a right one if the scanner did."""
    best = 0
    for v, T in placed.items():
        back = frames.inverse(poses[v])
        alike = 0
        for w, there in placed.items():
            expected = T @ back @ poses[w] if what == "part" else poses[w] @ back @ T
            points = capture.scans[w].points[::50]
            stated, fitted, shared = (frames.transform(pose, points) for pose in (poses[w], there, expected))
            alike += bool(np.linalg.norm(shared - fitted) < _AGREES * np.linalg.norm(fitted - stated))
        best = max(best, alike)
    return best if best >= _FEWEST else 0
