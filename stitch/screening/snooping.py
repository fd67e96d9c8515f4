"""Which views do not belong: detection, identification, adaptation (Teunissen 2018, J. Geodesy 92:59).

Overlaps say which views are linked; a view that is not is tried wide, against the surface of the linked ones. Where it
closes, its pose is wrong and it is known by how much; where it closes nowhere, it is no scan of this part. With every
view in its place, each one's own displacement is tested under the scatter of the others.

Few views leave no scatter to test one of them by. What arms do is known in its sizes: joints and links a little wrong,
wandering, and scatter of the poses, each as large as the priors of `pose_errors.py` say. Under these the marginal
likelihood of what the overlaps show, the hand-eye free, is held against the same with one view displaced, every view
and every size as likely as the others (Kass and Raftery 1995, J. Am. Stat. Assoc. 90:773). Sizes are summed over, so
that an arm that is worse than most is no mistake of a row.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise, product

import numpy as np
from scipy.special import logsumexp

from stitch.numerics import frames
from stitch.numerics.distributions import chi2_tail
from stitch.numerics.frames import Array
from stitch.observations.pose_errors import prior_pose_errors, usual_twist
from stitch.observations.surfaces.scanner_errors import rig_scanner_errors
from stitch.observations.surfaces.view_poses import UnconstrainedPoses, unconstrained_poses
from stitch.screening.linkage import STILL_CONTRADICTS, Linkage, find_contradicting_views, linkage
from stitch.screening.placement import (
    Placement,
    evaluate_placement,
    lies_in_a_line,
    needed_closure,
    place_scan,
    place_unlinked_views,
    surface_of,
)
from stitch.screening.pose_tests import (
    BlunderSearch,
    PoseStep,
    expected_poses,
    find_blunders,
    least_displacement,
    pose_tests,
)
from stitch.screening.view_model import UsualEffects, ViewModel, view_model
from stitch.session.capture import Capture, part_size

# Chance at which a step is tried: whether it stands out among the few views that are linked or not, that it links more
# of them is the proof.
_ANY_CHANCE = 1.0
# Views of which one motion tells nothing against another are two; so many leave too few degrees of freedom for their
# scatter alone to accuse one of them.
_FEWEST, _FEW_VIEWS = 3, 8
# On the surface of the others: four robust sigmas of the overlaps.
_TOLERANCE_SIGMAS = 4.0
# Sizes of the arm's errors in those that are usual, of the scatter, and of a displaced view, in usual scatters.
_ARM_SIZES, _SCATTERS, _DISPLACEMENTS = np.geomspace(0.5, 16, 6), np.geomspace(0.5, 4, 4), (10.0, 30.0, 100.0)
# Neighbouring distances share points and normals: the variance of the overlaps' noise in that of independent ones.
_NOISE_FACTOR = 3.0
# Medians and spreads of the logarithm: of an ordinary arm, all joints and links at once, in scales at which one of them
# is likely (0.15 mrad each; 95 % of arms within a factor of four), and of the scatter in usual ones. A prior with more
# room for poor arms takes a row that is off by half a millimetre for one of these.
_ARM_PRIOR, _SCATTER_PRIOR = (1.5, 0.7), (1.0, 0.5)
# Chance that what an ordinary arm leaves is said not to be of one.
_CHANCE = 1e-4


@dataclass(frozen=True)
class MisplacedView:
    """A view that does not belong where its pose puts it."""

    view: int
    # displaced | foreign | several: it closes at several places alike | torn: in itself, so that it contradicts the
    # others wherever it is put
    kind: str
    rotation: float  # rad; NaN for a foreign scan
    distance: float  # length_unit, of the middle of its points; NaN for a foreign scan
    T: Array | None  # (4, 4) T_reference_scanner where the surface puts it
    at_least: tuple[float, float] = (0.0, 0.0)  # rotation and distance of the smallest displacement that is likely


@dataclass(frozen=True)
class PlacedViews:
    """Views where their surfaces put them."""

    unconstrained: UnconstrainedPoses  # with the views where they belong
    linkage: Linkage  # at the poses that overlaps alone give, from the model's
    placed: dict[int, Placement]  # views that nothing linked, and where they belong
    unplaced: list[int]  # views that belong nowhere
    several: set[int]  # of these, views that close at several places alike
    torn: tuple[int, ...]  # views that contradict the others, and still do where they belong
    lines: list[int]  # views whose points lie in a line
    tolerance: float  # distance from the surface of the others that still lies on it, length_unit
    needed: float  # closure at which a scan counts as placed

    @property
    def torn_in_place(self) -> set[int]:
        """Torn views of which one half is in its place, or that common targets hold there: not displaced as a whole."""
        return set(self.torn) - set(self.unplaced)


@dataclass(frozen=True)
class FewViews:
    """What few views say against what ordinary arms leave."""

    odds: float  # to one, for a view that is off against an ordinary arm, if both were as likely before
    view: int  # the likeliest
    share: float  # of the probability that it is this one, if one is off
    is_ordinary: bool  # an ordinary arm leaves as much, one time in ten thousand at the least


@dataclass(frozen=True)
class Snooping(PlacedViews):
    """What linkage and tests say about the views of one capture."""

    capture: Capture
    T_mount: Array  # (4, 4) hand-eye under which they were tested
    misplaced: tuple[MisplacedView, ...]
    suspected: tuple[MisplacedView, ...]  # stand out, but usual effects of the arm would do that too
    steps: tuple[PoseStep, ...]  # from some view on the part or the scanner sits elsewhere
    disconnected: tuple[tuple[int, ...], ...]  # groups of views that no surface links, if there is more than one
    model: ViewModel
    blunder_search: BlunderSearch
    expected: Array  # (V, 4, 4) T_reference_scanner by the robot, steps with it
    few: FewViews | None = None  # of few views that nothing accuses: against what ordinary arms leave

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
    def alone(self) -> tuple[int, ...]:
        """Views that no surface links to the others, if all are single views and the others are the majority; else ().

        Otherwise the session falls into groups, of which nobody can say which one is right.
        """
        if not self.disconnected:
            return ()
        most, *others = self.disconnected
        if any(len(group) > 1 for group in others) or 2 * len(most) <= self.linkage.views:
            return ()
        return tuple(v for group in others for v in group)

    @property
    def not_belonging(self) -> set[int]:
        """Views that are misplaced or not linked."""
        return {m.view for m in self.misplaced} | {v for group in self.disconnected[1:] for v in group}

    @property
    def rotation(self) -> float:
        """Scatter of the flange poses without the blunders, rad."""
        return float(np.sqrt(self.blunder_search.fit.variances[0]))

    @property
    def translation(self) -> float:
        """The same of translations, length_unit."""
        return float(np.sqrt(self.blunder_search.fit.variances[1]))


def snoop_views(
    capture: Capture, T_mount: Array, unconstrained: UnconstrainedPoses, usual: UsualEffects | None = None
) -> Snooping:
    """Return which views of a capture do not belong where the robot has them, and steps, under a hand-eye.

    Views are placed by their surfaces, and each is tested against the robot's pose. One that stands out is misplaced if
    usual effects of an arm cannot explain it, else suspected. Few views without any finding are weighed together.

    Args:
        T_mount: (4, 4) corrected hand-eye.
        unconstrained: the views moved by the overlaps alone.
        usual: effects that an arm may have; asked only where a view stands out or there is a step. None: no effects.
    """
    model_poses = capture.poses(T_mount)
    unconstrained = unconstrained.relative_to(model_poses)
    located = place_views(capture, *_place_across_steps(capture, T_mount, unconstrained, usual))
    located = replace(located, unconstrained=located.unconstrained.relative_to(model_poses))
    model = view_model(capture, T_mount, located.unconstrained)
    tests = pose_tests(model, located.unconstrained, located.unplaced, list(located.placed), usual)
    expected = expected_poses(model, model_poses, located.unconstrained, tests) if tests.steps else model_poses
    standing_out = _displaced_views(capture, model, expected, located, tests)
    misplaced, suspected = standing_out, list[MisplacedView]()
    if standing_out and usual is not None:
        # Only those are misplaced that stand out even beside usual effects of the arm; the others are suspected.
        with_usual = model.with_usual(usual.twists(located.unconstrained))
        beside_usual = find_blunders(with_usual, tests.excluded, tests.steps)
        sure = {*beside_usual.blunders, *tests.beyond_effects, *located.torn_in_place}
        misplaced = [m for m in standing_out if m.view in sure]
        suspected = [m for m in standing_out if m.view not in sure]
    # Lines, and torn scans without a place, hold no other view in its place.
    holding_nothing = {*located.lines, *(set(located.torn) - located.torn_in_place)}
    groups = linkage(located.unconstrained.overlaps, holding_nothing).components
    foreign = [
        MisplacedView(v, "several" if v in located.several else "foreign", np.nan, np.nan, None)
        for v in located.unplaced
        if (v,) in groups
    ]
    few = None
    accused = misplaced or foreign or tests.steps or tests.null_projector.degrees < 1
    if usual is not None and _FEWEST <= model.count <= _FEW_VIEWS and not accused:
        few = _weigh_few_views(usual, located.unconstrained, model)
    return Snooping(
        **vars(located),
        capture=capture,
        T_mount=T_mount,
        misplaced=tuple(sorted([*misplaced, *foreign], key=lambda m: m.view)),
        suspected=tuple(suspected),
        steps=tests.steps,
        disconnected=tuple(group for group in groups if not set(group) <= {m.view for m in foreign}),
        model=model,
        blunder_search=tests,
        expected=expected,
        few=few,
    )


def _place_across_steps(
    capture: Capture, T_mount: Array, unconstrained: UnconstrainedPoses, usual: UsualEffects | None
) -> tuple[Array, UnconstrainedPoses]:
    """Return where views are expected, and where overlaps put them, with a step in the poses if that links more views.

    A step spoils the hand-eye: views on its smaller side may lie too far from the others to be matched. Placed one by
    one, such a view could fit a wrong place of a part that looks alike from several sides. So views are first moved by
    the likeliest step, significant or not: that it links more of them is the proof.

    Args:
        T_mount: (4, 4) hand-eye of the model poses from which `unconstrained` is seen.

    Returns:
        (V, 4, 4) T_reference_scanner, those of the model without a step; and the unconstrained views, seen from these.
    """
    model_poses = capture.poses(T_mount)
    unlinked = list(linkage(unconstrained.overlaps).unlinked)
    if not unlinked:
        return model_poses, unconstrained
    model = view_model(capture, T_mount, unconstrained)
    tests = pose_tests(model, unconstrained, unlinked, [], usual, _ANY_CHANCE)
    if not tests.steps:
        return model_poses, unconstrained
    expected = expected_poses(model, model_poses, unconstrained, tests)
    poses = np.array(unconstrained.poses)
    poses[unlinked] = expected[unlinked]
    tried = [unconstrained_poses(capture, start, unconstrained.overlaps.gate) for start in (expected, poses)]
    best = min((unconstrained, *tried), key=lambda views: len(linkage(views.overlaps).unlinked))
    return (model_poses, unconstrained) if best is unconstrained else (expected, best.relative_to(expected))


def place_views(capture: Capture, model_poses: Array, unconstrained: UnconstrainedPoses) -> PlacedViews:
    """Return where views belong by their surfaces; those that no surface links to the others are searched widely.

    In this order: views that contradict the others are unlinked, since they would link what does not belong together;
    unlinked views are placed one by one; where several were, one displacement common to all is preferred if it links
    them. With new poses, overlaps are matched again and contradictions tested again.

    Args:
        model_poses: (V, 4, 4) T_reference_scanner by the robot.
        unconstrained: the views moved by the overlaps alone from there.
    """
    lines = [v for v, scan in enumerate(capture.scans) if lies_in_a_line(scan)]
    tolerance = _TOLERANCE_SIGMAS * unconstrained.overlaps.gram.scale
    size = part_size([capture])
    groups = linkage(unconstrained.overlaps, lines).components
    torn = find_contradicting_views(capture.scans, unconstrained.poses, tolerance, size, groups=groups)
    links = linkage(unconstrained.overlaps, {*lines, *torn})
    needed = needed_closure(capture, unconstrained.poses, links, tolerance)
    placed, unplaced, several = place_unlinked_views(capture, model_poses, unconstrained, links, tolerance, needed)
    if placed and len(links.unlinked) > 1:
        # One displacement of all explains more than one of each, which may have closed in a wrong place.
        together = _place_together(capture, model_poses, unconstrained, placed, links.unlinked, tolerance)
        if together is not None:
            unconstrained = together
            links = linkage(together.overlaps, lines)
            torn, placed, unplaced, several = (), {}, [], set()
    if placed:
        poses = np.array(unconstrained.poses)
        for v, placement in placed.items():
            poses[v] = placement.T
        unconstrained = unconstrained_poses(capture, poses, unconstrained.overlaps.gate).relative_to(model_poses)
        if torn:
            still = find_contradicting_views(capture.scans, unconstrained.poses, tolerance, size, STILL_CONTRADICTS)
            torn = tuple(v for v in still if v in torn)
    return PlacedViews(unconstrained, links, placed, unplaced, several, torn, lines, tolerance, needed)


def _place_together(
    capture: Capture,
    model_poses: Array,
    unconstrained: UnconstrainedPoses,
    placed: Mapping[int, Placement],
    unlinked: Collection[int],
    tolerance: float,
) -> UnconstrainedPoses | None:
    """Return the views with unlinked ones at one end of the list all displaced alike; None if that links not all.

    The displacement is that of one view that was placed, as one of the scanner on its mount or as one of the part.
    After a knock, or a part clamped anew, single views may overlap too little with the others to be placed.

    Args:
        model_poses: (V, 4, 4) T_reference_scanner by the robot.
        unconstrained: the views where overlaps alone put them.
        placed: where some of the unlinked views belong.
        unlinked: views that no surface links to the others.
        tolerance: distance along the normal that is the same place, length_unit.
    """
    size = part_size([capture])
    for views in end_runs(unlinked, len(model_poses)):
        for v in sorted(set(views) & set(placed), key=lambda v: -placed[v].closure):
            T = placed[v].T
            back = frames.inverse(model_poses[v])
            for moved in (model_poses @ back @ T, T @ back @ model_poses):
                poses = np.array(unconstrained.poses)
                poses[views] = moved[views]
                tried = unconstrained_poses(capture, poses, unconstrained.overlaps.gate).relative_to(model_poses)
                if linkage(tried.overlaps).unlinked:
                    continue
                if not find_contradicting_views(capture.scans, tried.poses, tolerance, size):
                    return tried
    return None


def end_runs(views: Collection[int], count: int) -> list[range]:
    """Return the unbroken runs of some views at the end and at the beginning of a list of so many."""
    rest = [v for v in range(count) if v not in views]
    return [range(rest[-1] + 1, count), range(rest[0])] if rest else []


def _displaced_views(
    capture: Capture, model: ViewModel, expected: Array, located: PlacedViews, tests: BlunderSearch
) -> list[MisplacedView]:
    """Return the views that are off by the tests, and torn ones, with their displacement and where their surface fits.

    Args:
        expected: (V, 4, 4) T_reference_scanner by robot and steps, from which displacements are counted.
        located: where surfaces put the views; torn ones contradict the others wherever they are put.
    """
    unconstrained = located.unconstrained
    blunders = sorted((*tests.unlinked_blunders, *tests.blunders))
    surface_poses = {v: _refine_pose(capture, unconstrained, v, located.tolerance) for v in blunders}
    surface_poses |= {v: unconstrained.poses[v] for v in located.torn if v in located.torn_in_place - {*blunders}}
    displaced = []
    for v, T in surface_poses.items():
        centroid = capture.scans[v].points.mean(axis=0)[None]
        centroid_in_reference = frames.transform(unconstrained.poses[v], centroid)[0]
        least = least_displacement(model, tests, v, centroid_in_reference)
        turn = float(frames.angle_between(expected[v], T))
        shift = float(np.linalg.norm(frames.transform(T, centroid) - frames.transform(expected[v], centroid)))
        kind = "torn" if v in located.torn_in_place else "displaced"
        displaced.append(MisplacedView(v, kind, turn, shift, T, least))
    return displaced


def _refine_pose(capture: Capture, unconstrained: UnconstrainedPoses, view: int, tolerance: float) -> Array:
    """Return T_reference_scanner (4, 4) of one view fitted to the surface of all others, if that has more closure.

    In the fit of all views together, robust weights may have held a displaced view back near its old pose.

    Args:
        tolerance: distance along the normal at which a point lies on the surface, length_unit.
    """
    scan = capture.scans[view]
    T = unconstrained.poses[view]
    others = [v for v in range(len(capture.scans)) if v != view]
    surface = surface_of(capture.scans, unconstrained.poses, others, tolerance)
    best = place_scan(scan, surface, T[None], part_size([capture]))[0]
    return best.T if best.closure > evaluate_placement(scan, T, surface).closure else T


def _weigh_few_views(usual: UsualEffects, unconstrained: UnconstrainedPoses, model: ViewModel) -> FewViews:
    """Return the odds that one of few views is off its pose, against ordinary errors of an arm: a Bayes factor.

    Numerator: the mean, over views and sizes of a displacement, of the marginal likelihood with this view displaced.
    Denominator: the same without any displacement. Both integrate over the sizes of the arm's errors and of white
    scatter; the scanner's errors have fixed sizes.

    Args:
        usual: the measurement, with the model about which the errors of the arm are linearised.
        unconstrained: the views moved by the overlaps alone.
        model: linear model of what these say about the poses.
    """
    measurement = usual.measurement
    prior = prior_pose_errors([measurement], usual.model, [model.centre])
    errors = prior.of_ordinary_arm.project(model.reduced.reduction)
    covariances = errors.scales[:, None, None] ** 2 * errors.components
    rotation, translation = usual_twist(measurement.length_unit)[[0, 3]]
    of_rotation, of_translation, of_noise = model.reduced.components
    white = rotation**2 * of_rotation + translation**2 * of_translation
    scanner = np.hstack([columns[0] for columns in rig_scanner_errors([measurement], [unconstrained]).values()])
    smooth = model.reduced.reduction @ scanner
    z, A = model.z, model.mixed().A[0]
    fixed = _NOISE_FACTOR * of_noise + smooth @ smooth.T
    of_arm = errors.arm_components
    varying = covariances[of_arm].sum(axis=0), white + covariances[~of_arm].sum(axis=0)
    without, square = _log_evidence(z, A, fixed, *varying)
    sizes = translation * np.array(_DISPLACEMENTS)
    each = []
    for columns in model.views:
        # Shifted, or shifted and turned by as much at the part.
        moved = [size * part for size in sizes for part in (columns, columns[:, 3:])]
        evidence = [_log_evidence(z, A, fixed + part @ part.T, *varying)[0] for part in moved]
        each.append(logsumexp(evidence) - np.log(len(moved)))
    best = int(np.argmax(each))
    log_odds = float(logsumexp(each)) - np.log(len(each)) - without
    degrees = len(z) - A.shape[1]
    return FewViews(
        odds=float(np.exp(np.clip(log_odds, -300, 300))),
        view=best,
        share=float(np.exp(each[best] - logsumexp(each))),
        is_ordinary=chi2_tail(square, degrees) > _CHANCE,
    )


def _log_evidence(z: Array, A: Array, fixed: Array, arm: Array, scatter: Array) -> tuple[float, float]:
    """Return the log restricted likelihood of z (n,), summed over sizes of the errors, and the least χ² among these.

    z = A ξ + e with cov e = fixed + a²·arm + s²·scatter, for a and s on a grid, weighted by log-normal priors.

    Args:
        A: (n, r) columns of the free hand-eye.
        fixed: (n, n) covariance that is known.
        arm, scatter: (n, n) covariances that errors of the arm, and white scatter, add at their usual size.
    """
    arm_sizes, sizes = np.array(list(product(_ARM_SIZES, _SCATTERS))).T
    C = fixed + arm_sizes[:, None, None] ** 2 * arm + sizes[:, None, None] ** 2 * scatter
    solved = np.linalg.solve(C, np.column_stack([A, z]))  # (sizes, n, r + 1)
    products = np.column_stack([A, z]).T @ solved
    mean, along = products[:, :-1, :-1], products[:, :-1, -1:]
    squares = products[:, -1, -1] - (along.transpose(0, 2, 1) @ np.linalg.solve(mean, along))[:, 0, 0]
    by_prior = ((arm_sizes, *_ARM_PRIOR), (sizes, *_SCATTER_PRIOR))
    prior = sum(-0.5 * (np.log(values / median) / spread) ** 2 for values, median, spread in by_prior)
    logs = prior - 0.5 * (np.linalg.slogdet(C)[1] + np.linalg.slogdet(mean)[1] + squares)
    return float(logsumexp(logs)), float(squares.min())
