"""Where the views of a capture belong by their surfaces: freed, and those that nothing links tried wide."""

from dataclasses import dataclass, replace

import numpy as np

from stitch.frames import Array
from stitch.integrity.contradiction import STILL, contradicting
from stitch.integrity.linkage import Linkage, linkage
from stitch.integrity.moved_together import moved_together
from stitch.integrity.placing import Placement, lies_in_a_line
from stitch.integrity.unlinked_views import needed_closure, placed_views
from stitch.measurement.capture import Capture, part_size
from stitch.observations.surfaces.free_poses import FreePoses, free_poses

# On the surface of the others: four robust sigmas of the overlaps.
_TOLERANCE_SIGMAS = 4.0


@dataclass(frozen=True)
class Homes:
    """Views where their surfaces put them."""

    freed: FreePoses  # with the views where they belong
    linkage: Linkage  # at the poses that overlaps alone give, from the model's
    placed: dict[int, Placement]  # views that nothing linked, and where they belong
    homeless: list[int]  # views that belong nowhere
    torn: tuple[int, ...]  # views that contradict the others, and still do where they belong
    lines: list[int]  # views whose points lie in a line
    tolerance: float  # distance from the surface of the others that still lies on it, length_unit
    needed: float  # closure at which a scan counts as placed

    def seen_from(self, model_poses: Array) -> "Homes":
        """The same against other poses (V, 4, 4) by the robot."""
        return replace(self, freed=self.freed.seen_from(model_poses))

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """Views that surfaces link, with all in their places."""
        return linkage(self.freed.overlaps, {*self.lines, *(v for v in self.torn if v in self.homeless)}).components


def find_homes(capture: Capture, model_poses: Array, freed: FreePoses) -> Homes:
    """Try every view that nothing links.

    Args:
        model_poses: (V, 4, 4) T_reference_scanner by the robot.
        freed: the views freed from there.
    """
    lines = [v for v, scan in enumerate(capture.scans) if lies_in_a_line(scan)]
    tolerance = _TOLERANCE_SIGMAS * freed.overlaps.gram.scale
    groups = linkage(freed.overlaps, lines).components
    torn = contradicting(capture.scans, freed.poses, tolerance, part_size([capture]), groups=groups)
    linked = linkage(freed.overlaps, {*lines, *torn})
    needed = needed_closure(capture, freed.poses, linked, tolerance)
    placed, homeless = placed_views(capture, model_poses, freed, linked, (tolerance, needed))
    apart = linked.unlinked
    if placed and len(apart) > 1:
        # One displacement of all explains more than one of each, which may have closed in a wrong place.
        together = moved_together(capture, model_poses, freed, placed, unlinked=apart, tolerance=tolerance)
        if together is not None:
            linked = linkage(together.overlaps, lines)
            return Homes(together, linked, {}, [], (), lines=lines, tolerance=tolerance, needed=needed)
    if placed:
        poses = np.array(freed.poses)
        for v, placement in placed.items():
            poses[v] = placement.T
        freed = free_poses(capture, poses, freed.overlaps.gate).seen_from(model_poses)
        still = contradicting(capture.scans, freed.poses, tolerance, part_size([capture]), STILL) if torn else ()
        torn = tuple(v for v in still if v in torn)
    return Homes(freed, linked, placed, homeless, torn, lines=lines, tolerance=tolerance, needed=needed)
