"""Tests of the poses of views: steps that all views from one on share, single blunders, a factor on lengths.

Single blunders: generalised extreme Studentised deviate (Rosner 1983, Technometrics 25:165). The most deviant view is
let go, the scatter estimated anew, and so on; the number of blunders is the largest count whose last one is
significant, so that several cannot hide in the scatter which they inflate. Beside a step, which all views from one on
have in common, single ones are sought anew.

Steps: under one hand-eye for all views every change point in the order of time is tested, for the part and for the
scanner, as a displacement that all views from there on share: Baarda's test as for single views, an F since the scatter
comes from the same data, times the number of tests (Bonferroni). What drifts, warms up, remembers or follows the pose
is no step, so the scatter holds all by which poses of a good session may err, in sizes that they show.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.least_squares import symmetric_inverse
from stitch.numerics.reml import VarianceFit
from stitch.observations.surfaces.view_poses import UnconstrainedPoses
from stitch.run_data import effect_cure
from stitch.screening.hypotheses import scale_text, sentence
from stitch.screening.problems import DisplacementSize, SessionProblem, displacement_text
from stitch.screening.view_model import (
    Projector,
    UsualEffects,
    ViewModel,
    displacement_lower_bound,
    hstack_columns,
    leave_one_out_p_value,
    left_out_test,
    projector,
    rotation_shift_lower_bounds,
    test_alternative,
    test_alternatives,
)

MovedBody = Literal["part", "scanner"]
MOVED_BODIES: tuple[MovedBody, MovedBody] = ("part", "scanner")
# −2 log likelihood of part against scanner at odds of 20 to 1; closer ones these views do not tell apart.
_DISTINGUISHABLE_DEVIANCE = 2 * np.log(20)
# Chance that a session without blunders loses a view.
FAMILY_WISE = 0.01
# At most a third of the views can be blunders: beyond, nothing says which are the good ones.
_MAX_BLUNDER_SHARE = 1 / 3
# Masking shows within a few steps; a search that has found nothing by then ends.
_MASKING_DEPTH = 3
# Fewer degrees of freedom tell no view from the scatter of the others.
FEWEST_DEGREES = 12
# The most deviant views, tested under the scatter of the others alone.
_LEAVE_ONE_OUT_COUNT = 3
# That a session without a step shows one. What an arm does wrong where its poses change their kind is a step to a list
# without joint angles: at nine equal poses three of four measured objects show the same one, at p of 0.006 to 0.06.
STEP_CHANCE = 1e-4
# Views from which on all by which poses may err takes minutes to hold against a step.
MAX_VIEWS_WITH_EFFECTS = 100
# Fewer views at an end than this are blunders of their own; more changes than this are no steps but a drift.
_MIN_VIEWS_AT_END, _MAX_STEPS = 2, 3
# Fewer views than this show no step beside their scatter.
_MIN_VIEWS_FOR_STEP = 6
# Less of its columns than this outside the mean is rounding.
_NEW_COLUMN_SHARE = 1e-6
# No scanner in use is off by this share of its lengths, and no arm.
_SCALE = 0.01
# Chance of a factor by which a session is refused, and of one that is named where it is refused anyway.
_LENGTH_CHANCE, _LIKELY_LENGTH = 1e-4, 0.01


@dataclass(frozen=True)
class PoseStep:
    """From view `start` on all views share one displacement."""

    start: int
    moved: MovedBody
    distinguishable: bool  # the other one of the two is clearly less likely
    size: DisplacementSize  # of the displacement, of the middle of the part as it is seen
    at_least: DisplacementSize  # the smallest that is likely: along itself a part slides unseen
    p_value: float  # all change points counted

    def describe(self, names: Sequence[str], length_unit: str) -> str:
        """Return a warning with what to do."""
        off = displacement_text(self.size, self.at_least, length_unit)
        other = "scanner" if self.moved == "part" else "part"
        cure = effect_cure("part_slip" if self.moved == "part" else "mount_step")
        return sentence(
            "step",
            before=names[self.start - 1],
            after=names[self.start],
            moved=self.moved,
            unsure="" if self.distinguishable else f" (or the {other}: these views do not show which)",
            by=f"{off} off at the part" if off else "by an amount that these surfaces do not show",
            further=f", or {cure}" if self.distinguishable else "",
        )

    def columns(self, model: ViewModel) -> Array:
        """(n, 6) of the displacement."""
        return np.asarray(model.steps[self.moved][self.start])


@dataclass(frozen=True)
class BlunderSearch:
    """What the poses of the views say by themselves, and their scatter without the blunders."""

    blunders: tuple[int, ...]  # single views that contradict the others, under the scatter of these
    fit: VarianceFit
    mean_columns: Array | None  # (n, K) columns of blunders and steps in the mean
    null_projector: Projector  # null hypothesis with those columns in it
    unplaced: Sequence[int] = ()  # views that nothing holds
    # Views that overlap no other at the robot's poses, and whose surface fits farther from there than poses scatter.
    unlinked_blunders: Sequence[int] = ()
    steps: tuple[PoseStep, ...] = ()
    # Of the unlinked blunders, those that effects of the arm do not explain either, in sizes that the other views show.
    beyond_effects: frozenset[int] = frozenset()

    @property
    def excluded(self) -> list[int]:
        """Views that take no part in the tests of the others."""
        return [*self.unplaced, *self.unlinked_blunders]

    @property
    def standing_off(self) -> list[int]:
        """These, and single blunders under the scatter of the others."""
        return [*self.excluded, *self.blunders]


def pose_tests(
    model: ViewModel,
    unconstrained: UnconstrainedPoses,
    unplaced: list[int],
    placed: list[int],
    usual: UsualEffects | None,
    chance: float = STEP_CHANCE,
) -> BlunderSearch:
    """Return the single views that are off their pose, and the steps: displacements common to all views from one on.

    Placed views are tested first, one by one; then all others, with the placed ones that are off free; then steps, with
    all single views that are off free. A single view may have stood in for a step that begins there: so where there is
    a step, single views are tested again with it free. Last, placed views that are off are held against what an arm may
    do (`BlunderSearch.beyond_effects`).

    Args:
        model: the evidence about the views' poses.
        unconstrained: the views where their surfaces put them.
        unplaced: views that overlap no other, and whose surface fits nowhere: they are free in all tests.
        placed: views that overlap no other at the robot's poses, and were found by their surface elsewhere on the part.
        usual: effects that steps are tested against, beside white scatter; None, or with `MAX_VIEWS_WITH_EFFECTS` views
            or more, which would take minutes: white scatter alone.
        chance: level of the test of steps.
    """
    unlinked_blunders = _find_unlinked_blunders(model, unplaced, placed)
    search = find_blunders(model, [*unplaced, *unlinked_blunders])
    model_with_effects = model
    if usual is not None and model.count < MAX_VIEWS_WITH_EFFECTS:
        errors = usual.errors(unconstrained).project(model.reduced.reduction)
        model_with_effects = replace(model, errors=errors)
    singles = search.mean_columns if unlinked_blunders or search.blunders else None
    steps = find_steps(model_with_effects, model.columns(unplaced), singles, chance)
    if steps:
        unlinked_blunders = _find_unlinked_blunders(model, unplaced, placed, steps)
        search = find_blunders(model, [*unplaced, *unlinked_blunders], steps)
    # Without effects white scatter is all that may happen, and every blunder is beyond it.
    beyond_effects = _find_unlinked_blunders(model_with_effects, unplaced, unlinked_blunders, steps)
    return replace(
        search,
        unplaced=unplaced,
        unlinked_blunders=unlinked_blunders,
        steps=steps,
        beyond_effects=frozenset(beyond_effects),
    )


def find_blunders(model: ViewModel, excluded: Sequence[int] = (), steps: Sequence[PoseStep] = ()) -> BlunderSearch:
    """Return the blunders among the views, by the generalised extreme Studentised deviate (Rosner 1983).

    The most deviant view is freed, the scatter of the others estimated anew, and so on. The number of blunders is the
    largest count whose last view is significant: so several do not hide in the scatter that they inflate.

    Args:
        excluded: views known to be off: they are free and not counted.
        steps: displacements of all views from one on: they are free too.
    """
    freed = list[int]()
    # One state per number of freed views, from none on: fit, columns of the mean, projector.
    states = list[tuple[VarianceFit, Array | None, Projector]]()
    columns = _free_view_columns(model, excluded, steps)
    most_freed = max(int(_MAX_BLUNDER_SHARE * model.count) - len(excluded), 0)
    significant = 0
    while True:
        fit = model.fit(columns)
        under = projector(model, fit, columns)
        states.append((fit, columns, under))
        rest = [v for v in range(model.count) if v not in excluded and v not in freed]
        if len(freed) >= min(most_freed, significant + _MASKING_DEPTH) or under.degrees < FEWEST_DEGREES:
            break
        tests = dict(zip(rest, test_alternatives(under, [model.views[v] for v in rest]), strict=True))
        likely = sorted(rest, key=lambda v: tests[v].rank)[:_LEAVE_ONE_OUT_COUNT]
        # Either test alone holds its level; together they were seen to stay below it (docs/integrity.md).
        chance = {v: min(tests[v].p_value, leave_one_out_p_value(model, columns, v)) for v in likely}
        worst = min(likely, key=lambda v: chance[v])
        freed.append(worst)
        if chance[worst] * len(rest) < FAMILY_WISE:
            significant = len(freed)
        columns = hstack_columns(columns, model.views[worst])
    return BlunderSearch(tuple(freed[:significant]), *states[significant])


def _find_unlinked_blunders(
    model: ViewModel, excluded: Sequence[int], unlinked: Sequence[int], steps: Sequence[PoseStep] = ()
) -> list[int]:
    """Return those of some unlinked views whose displacement the scatter of all other views does not explain.

    The level is `FAMILY_WISE`. Each is tested with the excluded views and the other unlinked ones free.

    Args:
        excluded: views that are free in all tests.
        unlinked: views to test: they overlap no other at the robot's poses, and are where their surface fits.
        steps: displacements of all views from one on: they are free too.
    """
    blunders = []
    for v in unlinked:
        others = [*excluded, *(w for w in unlinked if w != v)]
        p = model.count * leave_one_out_p_value(model, _free_view_columns(model, others, steps), v)
        if p < FAMILY_WISE:
            blunders.append(v)
    return blunders


def _free_view_columns(model: ViewModel, excluded: Sequence[int], steps: Sequence[PoseStep]) -> Array | None:
    """Return the columns (n, K) by which excluded views, and the views behind steps, move freely; None without any."""
    if not len(excluded) and not steps:
        return None
    return hstack_columns(model.columns(excluded), *(step.columns(model) for step in steps))


def find_steps(model: ViewModel, known: Array | None, singles: Array | None, chance: float) -> tuple[PoseStep, ...]:
    """Return the steps in the order of their views: displacements that all views from one on share.

    They are searched with only the views free that are known to be off, and again with all single blunders free. The
    second result is taken where the first has none, or where it has the smaller Akaike criterion.

    Args:
        model: its covariance has all that may happen without a step.
        known: (n, K) columns of views known to be off; None: none.
        singles: (n, K) columns of these and of all single blunders; None: there are no blunders.
        chance: level of the test of a step.
    """
    steps, columns = _search_steps(model, known, chance)
    if singles is not None:
        steps_beside_singles, all_columns = _search_steps(model, singles, chance)
        if not steps or _akaike_criterion(model, all_columns) < _akaike_criterion(model, columns):
            steps = steps_beside_singles
    return tuple(sorted(steps, key=lambda step: step.start))


@dataclass(frozen=True)
class _Pick:
    """What explains most beside what was picked before: a step, or a single view that is off."""

    columns: Array  # (n, 6)
    p_value: float
    tests: int  # of which it is the likeliest
    starts: dict[MovedBody, int] | None = None  # where the step of each begins; None: a single view


def _search_steps(model: ViewModel, first: Array | None, chance: float) -> tuple[list[PoseStep], Array | None]:
    """Return the significant steps, and the columns of the mean with all that was picked: steps and single views.

    In turn the step or single view that explains most is added, significant or not, up to `_MAX_STEPS` beyond the last
    significant one (as Rosner 1983): a body moved there and back makes two steps, and each hides in the scatter that
    the other makes. At the end each step is tested with all others free.

    Args:
        first: (n, K) columns that are in the mean already.
        chance: level of the test of a step.
    """

    def with_columns_of(picks: Sequence[_Pick]) -> Array | None:
        """Return the first columns and those of some picks."""
        return hstack_columns(first, *(pick.columns for pick in picks)) if picks else first

    picked = list[_Pick]()
    significant = 0
    while model.count >= _MIN_VIEWS_FOR_STEP and len(picked) < significant + _MAX_STEPS:
        steps_picked = [pick.starts for pick in picked if pick.starts is not None]
        if len(steps_picked) == _MAX_STEPS:
            break
        taken = {start for starts in steps_picked for start in starts.values()}
        pick = _next_pick(model, with_columns_of(picked), taken)
        if pick is None:
            break
        p = pick.p_value
        if len(picked) > significant:
            # Each of the last two may hide in the scatter that the other makes, and then neither stands out alone.
            columns = with_columns_of(picked[:-1])
            last = picked[-1]
            under = projector(model, model.fit(columns), columns)
            both = test_alternative(under, hstack_columns(last.columns, pick.columns))
            p = min(p, both.p_value * last.tests * pick.tests)
        picked.append(pick)
        significant = len(picked) if p < chance else significant
    picked = picked[:significant]
    steps = []
    for pick in picked:
        if pick.starts is not None:
            others = with_columns_of([other for other in picked if other is not pick])
            steps.append(_likelier_step(model, others, pick.starts, pick.tests))
    # What was picked early may stand out no more beside the rest.
    return [step for step in steps if step.p_value < chance], with_columns_of(picked)


def _next_pick(model: ViewModel, columns: Array | None, taken: Collection[int]) -> _Pick | None:
    """Return the step, or single view, that explains most with some columns free; None where these leave no view.

    Args:
        columns: (n, K) in the mean already.
        taken: views at which earlier steps begin, of the part or of the scanner: these are not tried again.
    """
    under = projector(model, model.fit(columns), columns)
    mean = model.mixed(columns).A[0]

    def is_new(displaced: Array) -> bool:
        """Return whether columns (n, 6) are not contained in the orthonormal columns of the mean."""
        outside = displaced - mean @ (mean.T @ displaced)
        return bool(np.linalg.norm(outside) >= _NEW_COLUMN_SHARE * np.linalg.norm(displaced))

    views = [v for v, response in enumerate(model.views) if is_new(response)]
    view_tests = dict(zip(views, test_alternatives(under, [model.views[v] for v in views]), strict=True))
    if not view_tests:
        return None
    possible_starts = range(_MIN_VIEWS_AT_END, model.count - _MIN_VIEWS_AT_END + 1)
    starts = [k for k in possible_starts if k not in taken]
    steps = {(moved, k): model.steps[moved][k] for moved in MOVED_BODIES for k in starts}
    new_steps = {step: displaced for step, displaced in steps.items() if is_new(displaced)}
    step_tests = dict(zip(new_steps, test_alternatives(under, list(new_steps.values())), strict=True))
    view = min(view_tests, key=lambda v: view_tests[v].rank)
    step = min(step_tests, key=lambda at: step_tests[at].rank, default=None)
    # There is no step where every start is taken already, as with few views.
    if step is None or view_tests[view].rank < step_tests[step].rank:
        return _Pick(model.views[view], view_tests[view].p_value * model.count, model.count)
    best = dict[MovedBody, int]()
    for moved in MOVED_BODIES:
        statistics = {k: step_tests[moved, k].statistic for k in starts if (moved, k) in step_tests}
        best[moved] = max(statistics, key=statistics.__getitem__, default=step[1])
    count = len(MOVED_BODIES) * len(possible_starts) * _MAX_STEPS
    return _Pick(steps[step], step_tests[step].p_value * count, count, best)


def _likelier_step(model: ViewModel, columns: Array | None, best: dict[MovedBody, int], tests: int) -> PoseStep:
    """Return a step as one of the part or one of the scanner, whichever is likelier, with its size and p-value.

    Args:
        columns: (n, K) of all else in the mean.
        best: by body, the view at which its step would begin.
        tests: number of steps tried, by which p is multiplied (Bonferroni).
    """
    with_step = {moved: hstack_columns(columns, model.steps[moved][best[moved]]) for moved in MOVED_BODIES}
    deviance = {moved: model.deviance(with_step[moved]) for moved in MOVED_BODIES}
    likelier = min(MOVED_BODIES, key=lambda moved: deviance[moved])
    distinguishable = bool(abs(deviance["part"] - deviance["scanner"]) > _DISTINGUISHABLE_DEVIANCE)
    start = best[likelier]
    displaced = model.steps[likelier][start]
    p = test_alternative(projector(model, model.fit(columns), columns), displaced).p_value * tests
    under = projector(model, model.fit(with_step[likelier]), columns)
    tested = test_alternative(under, displaced)
    carried = model.mount_twists[start:] if likelier == "scanner" else np.eye(6)[None]
    moved = np.linalg.norm((carried @ tested.estimate).reshape(-1, 2, 3), axis=2)
    least = [rotation_shift_lower_bounds(tested, under.degrees, to_view) for to_view in carried]
    turn, shift = np.median(moved, axis=0).tolist()
    least_turn, least_shift = np.median(least, axis=0).tolist()
    lever = model.lever
    return PoseStep(start, likelier, distinguishable, (turn / lever, shift), (least_turn / lever, least_shift), p)


def _akaike_criterion(model: ViewModel, columns: Array | None) -> float:
    """Return Akaike's criterion for few observations (Hurvich and Tsai 1989), inf where parameters use them up.

    −2 log likelihood + 2kn/(n − k − 1), of n numbers and k free parameters. The criterion for many observations would
    prefer half of the views as free blunders, since then no scatter is left.

    Args:
        columns: (n, K) in the mean beside the hand-eye; None: none.
    """
    count = len(model.z)
    fitted = model.hand_eye.shape[1] + (0 if columns is None else columns.shape[1])
    if count <= fitted + 1:
        return np.inf
    return model.deviance(columns) + 2 * fitted * count / (count - fitted - 1)


def expected_poses(
    model: ViewModel, model_poses: Array, unconstrained: UnconstrainedPoses, tests: BlunderSearch
) -> Array:
    """Return the poses T_reference_scanner (V, 4, 4) at which views are expected: by hand-eye and steps together.

    A hand-eye fitted without the steps is a compromise between both sides. Views that stand off are free in the fit. Of
    each step the smallest displacement that the evidence admits is taken.

    Args:
        model_poses: (V, 4, 4) T_reference_scanner about which the model is linear.
        unconstrained: the views where surfaces put them, with twists from these poses.
    """
    alone = tests.standing_off
    moved = []
    for step in tests.steps:
        # The least that it may have moved, rotations in 1/lever: along itself a part slides unseen.
        others = _free_view_columns(model, alone, [other for other in tests.steps if other is not step])
        under = projector(model, tests.fit, others)
        moved.append(displacement_lower_bound(test_alternative(under, step.columns(model)), under.degrees))
    z = model.z - sum(step.columns(model) @ by for step, by in zip(tests.steps, moved, strict=True))
    X = hstack_columns(model.hand_eye, model.columns(alone))
    CX = np.linalg.solve(model.mixed().covariance(tests.fit.variances)[0], X)
    twists = model.mount_twists @ (symmetric_inverse(X.T @ CX) @ (CX.T @ z))[:6]
    for step, by in zip(tests.steps, moved, strict=True):
        carried = model.mount_twists[step.start :] if step.moved == "scanner" else np.eye(6)[None]
        twists[step.start :] += carried @ by
    twists[:, :3] /= model.lever
    # Surfaces do not say where all views together stand.
    twists += np.mean(np.delete(unconstrained.twists - twists, alone, axis=0), axis=0)
    return frames.moved_about(model.centre, twists, model_poses)


def least_displacement(model: ViewModel, search: BlunderSearch, view: int, middle: Array) -> DisplacementSize:
    """Return the smallest rotation (rad) and shift (length_unit) of a view that its evidence admits, at 99 %.

    All other views that stand off, and the steps, are free.

    Args:
        search: the tests of all views; it has the scatter of the poses.
        view: number of the view.
        middle: (3,) centroid of its points, whose shift counts, reference frame.
    """
    others = [v for v in search.standing_off if v != view]
    under = projector(model, search.fit, _free_view_columns(model, others, search.steps))
    carried = np.eye(6)
    carried[3:, :3] = -frames.skew(middle - model.centre) / model.lever
    tested = test_alternative(under, model.held_responses[view])
    turn, shift = rotation_shift_lower_bounds(tested, under.degrees, carried)
    return turn / model.lever, shift


def length_problem(
    model: ViewModel, T_reference_mount: Array, further: Array | None = None, likely: bool = False
) -> SessionProblem | None:
    """Return the problem that the robot's lengths differ from the scans' by a factor; None if they agree.

    The factor is tested as one more column. It must exceed 1 by `_SCALE`, significantly. Under a wrong factor the part
    would still fit itself, but have the wrong size.

    Args:
        T_reference_mount: (V, 4, 4), length_unit: a factor 1 + κ on them is a left twist (0, κ t) of every view.
        further: (n, K) columns of blunders and steps, which a factor must not stand in for; None: none.
        likely: the poses are known to contradict the scans: then a larger p-value is enough.
    """
    column = np.einsum("vni,vi->n", model.views[:, :, 3:], T_reference_mount[:, :3, 3])[:, None]
    if further is not None and model.deviance(column) + 2 < model.deviance(further) + 2 * further.shape[1]:
        # One number says as much as the six of every view (Akaike 1974): of few views one takes the factor upon itself.
        further = None
    tested, p = left_out_test(model, further, column, column)
    share = float(tested.estimate[0])
    if abs(share) < _SCALE or p > (_LIKELY_LENGTH if likely else _LENGTH_CHANCE):
        return None
    return SessionProblem("scale", (), scale_text(1 + share, float(tested.normal[0, 0]) ** -0.5))
