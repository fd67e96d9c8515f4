"""Unlinked views at one end of the list, displaced together as one of them was found to be.

After a knock of the scanner, or a part clamped anew, each of them alone may overlap too little with the others to be
placed, and would be taken for a scan of another part.
"""

from collections.abc import Collection, Mapping

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.integrity.contradiction import find_contradicting_views
from stitch.integrity.linkage import linkage
from stitch.integrity.placing import Placement
from stitch.measurement.capture import Capture, part_size
from stitch.observations.surfaces.free_poses import UnconstrainedPoses, unconstrained_poses


def place_together(
    capture: Capture,
    model_poses: Array,
    unconstrained: UnconstrainedPoses,
    placed: Mapping[int, Placement],
    *,
    unlinked: Collection[int],
    tolerance: float,
) -> UnconstrainedPoses | None:
    """The views freed from there, if that links them all and none contradicts; None if no common displacement does.

    Args:
        model_poses: (V, 4, 4) T_reference_scanner by the robot.
        unconstrained: the views where overlaps alone put them.
        placed: where some of the unlinked views belong.
        tolerance: distance that is the same place, length_unit.
    """
    for views in end_runs(unlinked, len(model_poses)):
        for v in sorted(set(views) & set(placed), key=lambda v: -placed[v].closure):
            T, back = placed[v].T, frames.inverse(model_poses[v])
            for moved in (model_poses @ back @ T, T @ back @ model_poses):
                poses = np.array(unconstrained.poses)
                poses[views] = moved[views]
                tried = unconstrained_poses(capture, poses, unconstrained.overlaps.gate).relative_to(model_poses)
                apart = linkage(tried.overlaps).unlinked
                if not (apart or find_contradicting_views(capture.scans, tried.poses, tolerance, part_size([capture]))):
                    return tried
    return None


def end_runs(views: Collection[int], count: int) -> list[range]:
    """The unbroken runs of some views at the end and at the beginning of a list of so many."""
    rest = [v for v in range(count) if v not in views]
    return [range(rest[-1] + 1, count), range(rest[0])] if rest else []
