"""Which views do not belong: detection, identification, adaptation (Teunissen 2018, J. Geodesy 92:59).

Overlaps say which views are linked; a view that is not is tried wide, against the surface of the linked ones. Where it
closes, its pose is wrong and it is known by how much; where it closes nowhere, it is no scan of this part. With every
view in its place, each one's own displacement is tested under the scatter of the others.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.integrity.across_steps import across_steps
from stitch.integrity.blunders import Found, find_blunders
from stitch.integrity.expected_poses import expected_poses
from stitch.integrity.homes import Homes, find_homes
from stitch.integrity.least_displacement import least_displacement
from stitch.integrity.linkage import Linkage
from stitch.integrity.placing import judge, place, surface_of
from stitch.integrity.pose_tests import PoseTests, pose_tests
from stitch.integrity.step import Step
from stitch.integrity.usual_effects import UsualEffects
from stitch.integrity.view_model import ViewModel, view_model
from stitch.measurement.capture import Capture, part_size
from stitch.observations.surfaces.free_poses import FreePoses, free_poses


@dataclass(frozen=True)
class Misplaced:
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
    misplaced: tuple[Misplaced, ...]
    suspected: tuple[Misplaced, ...]  # stand out, but usual effects of the arm would do that too
    steps: tuple[Step, ...]  # from some view on the part or the scanner sits elsewhere
    disconnected: tuple[tuple[int, ...], ...]  # groups of views that no surface links, if there is more than one
    model: ViewModel
    found: Found
    freed: FreePoses  # with the views where they belong
    expected: Array  # (V, 4, 4) T_reference_scanner by the robot, steps with it
    tolerance: float  # distance from the surface of the others that still lies on it, length_unit
    needed: float  # closure at which a scan counts as placed

    @property
    def left_out(self) -> tuple[int, ...]:
        """Views that are not to be fused: they do not belong, or not between the same steps as most are."""
        return tuple(sorted(self.not_belonging | (set(range(self.linkage.views)) - set(self.between))))

    @property
    def between(self) -> range:
        """The views between the same two steps, or ends, as most are."""
        ends = [0, *(step.start for step in self.steps), self.linkage.views]
        return max((range(a, b) for a, b in pairwise(ends)), key=len)

    @property
    def not_belonging(self) -> set[int]:
        """Views that are misplaced or not linked."""
        return {m.view for m in self.misplaced} | {v for group in self.disconnected[1:] for v in group}

    def settled(self, sure: Callable[[Misplaced], bool]) -> "Snooping":
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
        return float(np.sqrt(self.found.fit.variances[0]))

    @property
    def translation(self) -> float:
        """The same of translations, length_unit."""
        return float(np.sqrt(self.found.fit.variances[1]))


def snoop(
    capture: Capture,
    T_mount: Array,
    gate: float,
    freed: FreePoses | None = None,
    usual: UsualEffects | None = None,
) -> Snooping:
    """Examine the views of a capture under a hand-eye.

    Args:
        T_mount: (4, 4) corrected hand-eye.
        gate: distance between partners at which the correction ended, length_unit.
        freed: the views freed from there, if that is at hand.
        usual: what may happen to views beside white scatter; asked only where one stands out, or all from one on.

    Raises:
        NoResultError: no two views overlap.
    """
    model_poses = capture.poses(T_mount)
    freed = free_poses(capture, model_poses, gate) if freed is None else freed.seen_from(model_poses)
    homes = find_homes(capture, *across_steps(capture, T_mount, freed, usual)).seen_from(model_poses)
    model = view_model(capture, T_mount, homes.freed)
    tests = pose_tests(model, homes.freed, (homes.homeless, list(homes.placed)), usual)
    expected = expected_poses(model, model_poses, homes.freed, tests) if tests.steps else model_poses
    standing_out = [_sized(capture, model, homes, tests, m) for m in _standing_out(capture, expected, homes, tests)]
    # A torn scan of which one half is in its place, or that common targets hold there, is not displaced as a whole.
    torn = {v for v in homes.torn if v not in homes.homeless}
    sure = {m.view for m in standing_out}
    if sure and usual is not None:
        sure &= _beside_usual(model.with_usual(usual.twists(homes.freed)), tests) | torn
    groups = homes.groups
    foreign = [Misplaced(v, "foreign", np.nan, np.nan, 0.0, None) for v in homes.homeless if (v,) in groups]
    misplaced = [replace(m, kind="torn") if m.view in torn else m for m in standing_out if m.view in sure]
    return Snooping(
        linkage=homes.linkage,
        misplaced=tuple(sorted([*misplaced, *foreign], key=lambda m: m.view)),
        suspected=tuple(m for m in standing_out if m.view not in sure),
        steps=tests.steps,
        disconnected=tuple(g for g in groups if not set(g) <= {m.view for m in foreign}),
        model=model,
        found=tests.found,
        freed=homes.freed,
        expected=expected,
        tolerance=homes.tolerance,
        needed=homes.needed,
    )


def _beside_usual(model: ViewModel, tests: PoseTests) -> set[int]:
    """Views that stand out beside what usually happens to all of them too."""
    again = find_blunders(model, tests.alone, tests.steps)
    return {b.view for b in again.blunders} | tests.sure


def _standing_out(capture: Capture, expected: Array, homes: Homes, tests: PoseTests) -> list[Misplaced]:
    """Views that stand off and torn ones, with where the surface of the others puts them."""
    off = sorted((*tests.off, *tests.found.blunders), key=lambda b: b.view)
    refined = [_refined(capture, homes.freed, b.view, homes.tolerance) for b in off]
    out = [_misplaced(capture, expected[b.view], T, b.view, b.p_value) for b, T in zip(off, refined, strict=True)]
    known = {b.view for b in off} | set(homes.homeless)
    return out + [_misplaced(capture, expected[v], homes.freed.poses[v], v, 0.0) for v in homes.torn if v not in known]


def _sized(capture: Capture, model: ViewModel, homes: Homes, tests: PoseTests, m: Misplaced) -> Misplaced:
    others = [v for v in (*tests.alone, *(b.view for b in tests.found.blunders)) if v != m.view]
    middle = frames.transform(homes.freed.poses[m.view], capture.scans[m.view].points.mean(axis=0)[None])[0]
    return replace(m, at_least=least_displacement(model, tests.found, others, tests.steps, m.view, middle))


def _refined(capture: Capture, freed: FreePoses, view: int, tolerance: float) -> Array:
    """(4, 4) where the surface of the other views puts one: robust weights of all pairs hold it back."""
    others = [v for v in range(len(capture.scans)) if v != view]
    surface = surface_of(capture.scans, freed.poses, others, tolerance)
    best = place(capture.scans[view], surface, freed.poses[view][None], part_size([capture]))[0]
    return (
        best.T if best.closure > judge(capture.scans[view], freed.poses[view], surface).closure else freed.poses[view]
    )


def _misplaced(capture: Capture, T_model: Array, T: Array, view: int, p_value: float) -> Misplaced:
    middle = capture.scans[view].points.mean(axis=0)[None]
    distance = np.linalg.norm(frames.transform(T, middle) - frames.transform(T_model, middle))
    return Misplaced(view, "displaced", float(frames.angle_between(T_model, T)), float(distance), p_value, T)
