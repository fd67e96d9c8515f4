"""Where the views of a capture belong by their surfaces: freed, and those that nothing links tried wide."""

from dataclasses import dataclass, replace

import numpy as np

from stitch.frames import Array
from stitch.integrity.contradiction import STILL_CONTRADICTS, find_contradicting_views
from stitch.integrity.linkage import Linkage, linkage
from stitch.integrity.moved_together import place_together
from stitch.integrity.placing import Placement, lies_in_a_line
from stitch.integrity.unlinked_views import needed_closure, place_unlinked_views
from stitch.measurement.capture import Capture, part_size
from stitch.observations.surfaces.free_poses import UnconstrainedPoses, unconstrained_poses

# On the surface of the others: four robust sigmas of the overlaps.
_TOLERANCE_SIGMAS = 4.0


@dataclass(frozen=True)
class PlacedViews:
    """Views where their surfaces put them."""

    unconstrained: UnconstrainedPoses  # with the views where they belong
    linkage: Linkage  # at the poses that overlaps alone give, from the model's
    placed: dict[int, Placement]  # views that nothing linked, and where they belong
    unplaced: list[int]  # views that belong nowhere
    torn: tuple[int, ...]  # views that contradict the others, and still do where they belong
    lines: list[int]  # views whose points lie in a line
    tolerance: float  # distance from the surface of the others that still lies on it, length_unit
    needed: float  # closure at which a scan counts as placed

    def seen_from(self, model_poses: Array) -> "PlacedViews":
        """The same against other poses (V, 4, 4) by the robot."""
        return replace(self, unconstrained=self.unconstrained.relative_to(model_poses))

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """Views that surfaces link, with all in their places."""
        return linkage(
            self.unconstrained.overlaps, {*self.lines, *(v for v in self.torn if v in self.unplaced)}
        ).components


def place_views(capture: Capture, model_poses: Array, unconstrained: UnconstrainedPoses) -> PlacedViews:
    """Try every view that nothing links.

    Args:
        model_poses: (V, 4, 4) T_reference_scanner by the robot.
        unconstrained: the views freed from there.
    """
    lines = [v for v, scan in enumerate(capture.scans) if lies_in_a_line(scan)]
    tolerance = _TOLERANCE_SIGMAS * unconstrained.overlaps.gram.scale
    groups = linkage(unconstrained.overlaps, lines).components
    torn = find_contradicting_views(capture.scans, unconstrained.poses, tolerance, part_size([capture]), groups=groups)
    linked = linkage(unconstrained.overlaps, {*lines, *torn})
    needed = needed_closure(capture, unconstrained.poses, linked, tolerance)
    placed, homeless = place_unlinked_views(capture, model_poses, unconstrained, linked, (tolerance, needed))
    apart = linked.unlinked
    if placed and len(apart) > 1:
        # One displacement of all explains more than one of each, which may have closed in a wrong place.
        together = place_together(capture, model_poses, unconstrained, placed, unlinked=apart, tolerance=tolerance)
        if together is not None:
            linked = linkage(together.overlaps, lines)
            return PlacedViews(together, linked, {}, [], (), lines=lines, tolerance=tolerance, needed=needed)
    if placed:
        poses = np.array(unconstrained.poses)
        for v, placement in placed.items():
            poses[v] = placement.T
        unconstrained = unconstrained_poses(capture, poses, unconstrained.overlaps.gate).relative_to(model_poses)
        still = (
            find_contradicting_views(
                capture.scans, unconstrained.poses, tolerance, part_size([capture]), STILL_CONTRADICTS
            )
            if torn
            else ()
        )
        torn = tuple(v for v in still if v in torn)
    return PlacedViews(unconstrained, linked, placed, homeless, torn, lines=lines, tolerance=tolerance, needed=needed)
