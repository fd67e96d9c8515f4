"""Which views do not belong: detection, identification, adaptation (Teunissen 2018, J. Geodesy 92:59).

Overlaps say which views are linked; a view that is not is tried wide, against the surface of the linked ones. Where it
closes, its pose is wrong and it is known by how much; where it closes nowhere, it is no scan of this part. With every
view in its place, each one's own displacement is tested under the scatter of the others.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.integrity.placement import (
    STILL_CONTRADICTS,
    Linkage,
    Placement,
    evaluate_placement,
    find_contradicting_views,
    lies_in_a_line,
    linkage,
    needed_closure,
    place_scan,
    place_unlinked_views,
    surface_of,
)
from stitch.integrity.pose_tests import (
    BlunderSearch,
    PoseStep,
    PoseTests,
    expected_poses,
    find_blunders,
    least_displacement,
    pose_tests,
)
from stitch.integrity.view_model import UsualEffects, ViewModel, view_model
from stitch.measurement.capture import Capture, part_size
from stitch.observations.surfaces.view_poses import UnconstrainedPoses, unconstrained_poses

# Views that nothing links because a step stands between them and the others: the linked ones tell it.
#
# A step pulls the hand-eye, and the side of it that has fewer views stands farther from the others than what two scans
# share reaches. Tried wide, such a view would close somewhere on a part that looks alike from several sides, and would
# be called displaced. One step explains more than that: the views are tried from where it puts them first. The
# likeliest step is tried whether it stands out among the few views that are linked or not: that it links more of them
# is the proof.

# Chance at which a step is tried.
_ANY_CHANCE = 1.0


def place_across_steps(
    capture: Capture, T_mount: Array, unconstrained: UnconstrainedPoses, usual: UsualEffects | None
) -> tuple[Array, UnconstrainedPoses]:
    """Where views are expected, and where overlaps put them: beside a step, if that links more of them.

    Args:
        T_mount: (4, 4) hand-eye of the model poses from which `unconstrained` is seen.

    Returns:
        (V, 4, 4) T_reference_scanner, those of the model without a step; and the views freed, seen from these.
    """
    model_poses, apart = capture.poses(T_mount), list(linkage(unconstrained.overlaps).unlinked)
    if not apart:
        return model_poses, unconstrained
    model = view_model(capture, T_mount, unconstrained)
    tests = pose_tests(model, unconstrained, (apart, []), usual, _ANY_CHANCE)
    if not tests.steps:
        return model_poses, unconstrained
    expected = expected_poses(model, model_poses, unconstrained, tests)
    poses = np.array(unconstrained.poses)
    poses[apart] = expected[apart]
    tried = [unconstrained_poses(capture, start, unconstrained.overlaps.gate) for start in (expected, poses)]
    best = min((unconstrained, *tried), key=lambda found: len(linkage(found.overlaps).unlinked))
    return (model_poses, unconstrained) if best is unconstrained else (expected, best.relative_to(expected))


# Unlinked views at one end of the list, displaced together as one of them was found to be.
#
# After a knock of the scanner, or a part clamped anew, each of them alone may overlap too little with the others to be
# placed, and would be taken for a scan of another part.


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


# Where the views of a capture belong by their surfaces: freed, and those that nothing links tried wide.

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


@dataclass(frozen=True)
class MisplacedView:
    """A view that does not belong where its pose puts it."""

    view: int
    kind: str  # displaced | foreign | torn: in itself, so that it contradicts the others wherever it is put
    rotation: float  # rad; NaN for a foreign scan
    distance: float  # length_unit, of the middle of its points; NaN for a foreign scan
    p_value: float  # family-wise, 0 where it is not even linked
    T: Array | None  # (4, 4) T_reference_scanner where the surface puts it
    at_least: tuple[float, float] = (0.0, 0.0)  # rotation and distance of the smallest displacement that is likely


@dataclass(frozen=True)
class Snooping:
    """What linkage and tests say about the views of one capture."""

    linkage: Linkage  # at the poses that overlaps alone give, from the model's
    misplaced: tuple[MisplacedView, ...]
    suspected: tuple[MisplacedView, ...]  # stand out, but usual effects of the arm would do that too
    steps: tuple[PoseStep, ...]  # from some view on the part or the scanner sits elsewhere
    disconnected: tuple[tuple[int, ...], ...]  # groups of views that no surface links, if there is more than one
    model: ViewModel
    blunder_search: BlunderSearch
    unconstrained: UnconstrainedPoses  # with the views where they belong
    expected: Array  # (V, 4, 4) T_reference_scanner by the robot, steps with it
    tolerance: float  # distance from the surface of the others that still lies on it, length_unit
    needed: float  # closure at which a scan counts as placed

    @property
    def left_out(self) -> tuple[int, ...]:
        """Views that are not to be fused: they do not belong, or not between the same steps as most are."""
        return tuple(sorted(self.not_belonging | (set(range(self.linkage.views)) - set(self.largest_segment))))

    @property
    def largest_segment(self) -> range:
        """The views between the same two steps, or ends, as most are."""
        ends = [0, *(step.start for step in self.steps), self.linkage.views]
        return max((range(a, b) for a, b in pairwise(ends)), key=len)

    @property
    def not_belonging(self) -> set[int]:
        """Views that are misplaced or not linked."""
        return {m.view for m in self.misplaced} | {v for group in self.disconnected[1:] for v in group}

    def with_misplaced(self, sure: Callable[[MisplacedView], bool]) -> "Snooping":
        """The same with those suspected views misplaced of which one is sure."""
        misplaced = (*self.misplaced, *(m for m in self.suspected if sure(m)))
        return replace(
            self,
            misplaced=tuple(sorted(misplaced, key=lambda m: m.view)),
            suspected=tuple(m for m in self.suspected if not sure(m)),
        )

    @property
    def rotation(self) -> float:
        """Scatter of the flange poses without the blunders, rad."""
        return float(np.sqrt(self.blunder_search.fit.variances[0]))

    @property
    def translation(self) -> float:
        """The same of translations, length_unit."""
        return float(np.sqrt(self.blunder_search.fit.variances[1]))


def snoop_views(
    capture: Capture,
    T_mount: Array,
    gate: float,
    unconstrained: UnconstrainedPoses | None = None,
    usual: UsualEffects | None = None,
) -> Snooping:
    """Examine the views of a capture under a hand-eye.

    Args:
        T_mount: (4, 4) corrected hand-eye.
        gate: distance between partners at which the correction ended, length_unit.
        unconstrained: the views freed from there, if that is at hand.
        usual: what may happen to views beside white scatter; asked only where one stands out, or all from one on.

    Raises:
        NoResultError: no two views overlap.
    """
    model_poses = capture.poses(T_mount)
    unconstrained = (
        unconstrained_poses(capture, model_poses, gate)
        if unconstrained is None
        else unconstrained.relative_to(model_poses)
    )
    homes = place_views(capture, *place_across_steps(capture, T_mount, unconstrained, usual)).seen_from(model_poses)
    model = view_model(capture, T_mount, homes.unconstrained)
    tests = pose_tests(model, homes.unconstrained, (homes.unplaced, list(homes.placed)), usual)
    expected = expected_poses(model, model_poses, homes.unconstrained, tests) if tests.steps else model_poses
    standing_out = [
        _with_lower_bound(capture, model, homes, tests, m) for m in _displaced_views(capture, expected, homes, tests)
    ]
    # A torn scan of which one half is in its place, or that common targets hold there, is not displaced as a whole.
    torn = {v for v in homes.torn if v not in homes.unplaced}
    sure = {m.view for m in standing_out}
    if sure and usual is not None:
        sure &= _beyond_usual_effects(model.with_usual(usual.twists(homes.unconstrained)), tests) | torn
    groups = homes.groups
    foreign = [MisplacedView(v, "foreign", np.nan, np.nan, 0.0, None) for v in homes.unplaced if (v,) in groups]
    misplaced = [replace(m, kind="torn") if m.view in torn else m for m in standing_out if m.view in sure]
    return Snooping(
        linkage=homes.linkage,
        misplaced=tuple(sorted([*misplaced, *foreign], key=lambda m: m.view)),
        suspected=tuple(m for m in standing_out if m.view not in sure),
        steps=tests.steps,
        disconnected=tuple(g for g in groups if not set(g) <= {m.view for m in foreign}),
        model=model,
        blunder_search=tests.blunder_search,
        unconstrained=homes.unconstrained,
        expected=expected,
        tolerance=homes.tolerance,
        needed=homes.needed,
    )


def _beyond_usual_effects(model: ViewModel, tests: PoseTests) -> set[int]:
    """Views that stand out beside what usually happens to all of them too."""
    again = find_blunders(model, tests.excluded, tests.steps)
    return {b.view for b in again.blunders} | tests.sure


def _displaced_views(capture: Capture, expected: Array, placed: PlacedViews, tests: PoseTests) -> list[MisplacedView]:
    """Views that stand off and torn ones, with where the surface of the others puts them."""
    off = sorted((*tests.displaced, *tests.blunder_search.blunders), key=lambda b: b.view)
    refined = [_refine_pose(capture, placed.unconstrained, b.view, placed.tolerance) for b in off]
    out = [_displaced_view(capture, expected[b.view], T, b.view, b.p_value) for b, T in zip(off, refined, strict=True)]
    known = {b.view for b in off} | set(placed.unplaced)
    return out + [
        _displaced_view(capture, expected[v], placed.unconstrained.poses[v], v, 0.0)
        for v in placed.torn
        if v not in known
    ]


def _with_lower_bound(
    capture: Capture, model: ViewModel, placed: PlacedViews, tests: PoseTests, m: MisplacedView
) -> MisplacedView:
    others = [v for v in (*tests.excluded, *(b.view for b in tests.blunder_search.blunders)) if v != m.view]
    middle = frames.transform(placed.unconstrained.poses[m.view], capture.scans[m.view].points.mean(axis=0)[None])[0]
    return replace(m, at_least=least_displacement(model, tests.blunder_search, others, tests.steps, m.view, middle))


def _refine_pose(capture: Capture, unconstrained: UnconstrainedPoses, view: int, tolerance: float) -> Array:
    """(4, 4) where the surface of the other views puts one: robust weights of all pairs hold it back."""
    others = [v for v in range(len(capture.scans)) if v != view]
    surface = surface_of(capture.scans, unconstrained.poses, others, tolerance)
    best = place_scan(capture.scans[view], surface, unconstrained.poses[view][None], part_size([capture]))[0]
    return (
        best.T
        if best.closure > evaluate_placement(capture.scans[view], unconstrained.poses[view], surface).closure
        else unconstrained.poses[view]
    )


def _displaced_view(capture: Capture, T_model: Array, T: Array, view: int, p_value: float) -> MisplacedView:
    middle = capture.scans[view].points.mean(axis=0)[None]
    distance = np.linalg.norm(frames.transform(T, middle) - frames.transform(T_model, middle))
    return MisplacedView(view, "displaced", float(frames.angle_between(T_model, T)), float(distance), p_value, T)
