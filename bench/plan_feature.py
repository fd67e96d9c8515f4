"""Do views that `stitch plan --for` proposes make a feature better known than random ones? A table of docs/measure.md.

Run: python bench/plan_feature.py [--cells 21] [--first-seed 640]; with --expected for the table of docs/plan.md

Cells of three kinds (`feature_coverage.py`) have four views of a sphere plate, of which a point is measured. Four
further views are proposed for that point; three times as many are drawn from all that see the part. Each four are
simulated, stitched and measured with the first. Errors of the arm hardly show in so few views, and each run takes
others for likely, so that U is told as each run states it, and with sizes of errors that all runs of a cell share:
their mean. With --expected nothing is simulated beyond the four views: U is what the linear model of the plan says,
and beside the proposed views stand the best four of a dense set of reachable ones, by exchange from several starts.
"""

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
from batch import into_page
from feature_coverage import cell, features_of
from scipy.stats import bootstrap

from data_synth import kinematics
from data_synth.fixtures.in_memory import session_of
from data_synth.moment import Plan
from data_synth.simulate import Measured
from stitch.api.pipeline import run
from stitch.numerics.frames import Array
from stitch.numerics.reml import MixedModel, VarianceFit
from stitch.numerics.variance_posterior import mean_variances
from stitch.plugins.metrology import error_sources
from stitch.plugins.metrology.budget import Number, measure_features
from stitch.plugins.metrology.error_sources import place_errors
from stitch.plugins.metrology.feature_file import FeatureList
from stitch.plugins.metrology.features import Feature
from stitch.plugins.metrology.planning import plan
from stitch.plugins.metrology.planning.detection_chances import view_outlook
from stitch.plugins.metrology.planning.expected_model import CellModel, PlannedCell, Scatter, cell_of_state
from stitch.plugins.metrology.planning.plan import KnownPlace, PlanRequest
from stitch.plugins.metrology.planning.planned_views import candidate_joints, with_views
from stitch.run_data import RunData
from stitch.session.session import SessionData
from stitch.system.threads import library_threads_off

PAGE = Path(__file__).resolve().parents[1] / "docs" / "measure.md"
PRESENT, FURTHER, RANDOM = 4, 4, 3
KINDS = ("clean", "ordinary arm", "smooth scanner errors")
PLAN_PAGE = PAGE.with_name("plan.md")
DENSE, DRAWS, STARTS, ROUNDS = 120, 100, 3, 6


def planned_cell(kind: str, seed: int) -> tuple[Measured, Feature, PlannedCell, PlanRequest]:
    """Return a cell of few views, the point, and what is planned for it."""
    measured = cell(kind, seed, PRESENT)
    wanted = next(f for f in features_of(measured)[0].features if f.kind == "point")
    state = run(session_of(measured))
    assert state.fused is not None
    planned = cell_of_state(state, state.fused.points, state.fused.normals)
    request = PlanRequest(split_any=False, views=FURTHER, feature=np.append(wanted.at, wanted.axis))
    return measured, wanted, planned, request


def expected(kind: str, seed: int) -> tuple[float, float, float, float, float]:
    """Expected U (mm) of the point: now, with random views (median), with the best of 40 drawn, with those proposed,
    with the best of a dense set."""
    measured, wanted, planned, request = planned_cell(kind, seed)
    session, cell_model = session_of(measured), planned.cell
    with library_threads_off():
        now = view_outlook(session, cell_model, planned.fitted_scatter, wanted.at)
        scatter = now.fitted_scatter.believed
        tried = candidate_joints(session, cell_model, DENSE)
        goal = _goal_over(session, cell_model, scatter, request, tried)
        best = _dense_search(goal, len(tried))
        present, count, rng = list(range(PRESENT)), PRESENT + len(tried), np.random.default_rng(seed)
        drawn = [rng.choice(np.arange(PRESENT, count), FURTHER, replace=False) for _ in range(DRAWS)]
        random = np.median([goal.U(goal.channel.normal([*present, *views])) for views in drawn])
        searched = []
        for closer in (0, plan._CLOSER):
            with patch.object(plan, "_CLOSER", closer):
                goals, chosen, _ = plan._search_views(session, cell_model, scatter, now, request)
            found = next(g for g in goals if isinstance(g, KnownPlace))
            searched.append(float(found.U(found.channel.normal([*present, *chosen]))))
    return float(goal.U(goal.channel.normal(present))), float(random), searched[0], searched[1], best


def _goal_over(
    session: SessionData, cell_model: CellModel, scatter: Scatter, request: PlanRequest, tried: Array
) -> KnownPlace:
    """The goal over the present views and some more (K, n)."""
    every = with_views(session, list(tried), in_turn=False)
    coarse = replace(
        cell_model, part=plan.thinned_surface(cell_model.part.points, cell_model.part.normals, plan._POINTS)
    )
    simulated = plan.simulate_views(every, coarse, plan._SAMPLES, plan._MIN_VIEW_SAMPLES)
    return plan._place_goal(plan.PossibleViews(every, coarse, simulated, scatter), request)


def _dense_search(goal: KnownPlace, tried: int) -> float:
    """The least U that exchange finds among so many views beside the present ones."""
    present, rng, least = list(range(PRESENT)), np.random.default_rng(0), np.inf
    for _ in range(STARTS):
        chosen = [int(k) for k in rng.choice(np.arange(PRESENT, PRESENT + tried), FURTHER, replace=False)]
        for turn in range(ROUNDS * FURTHER):
            rest = [k for i, k in enumerate(chosen) if i != turn % FURTHER]
            others = [k for k in range(PRESENT, PRESENT + tried) if k not in rest]
            U = goal.U(goal.channel.with_each([*present, *rest], others))
            chosen[turn % FURTHER] = others[int(U.argmin())]
            least = min(least, float(U.min()))
    return least


@dataclass(frozen=True)
class Trial:
    """One cell; of the 1 + RANDOM sets of further views the proposed one is first. Lengths in mm."""

    kind: str
    now: float  # U that the plan expects of the present views
    expected: Array  # (1 + RANDOM,) U that it expects with a set
    stated: Array  # (1 + RANDOM,) U of the measured point
    shared: Array  # (1 + RANDOM,) the same with the sizes of errors that all sets share
    errors: Array  # (1 + RANDOM,) of the measured point

    @property
    def factors(self) -> Array:
        """(3,) U with random views (median) over U with the proposed ones: stated, with shared sizes, expected."""
        return np.array([np.median(U[1:]) / U[0] for U in (self.stated, self.shared, self.expected)])

    @property
    def squares(self) -> Array:
        """(2,) squared errors with the proposed views, and with random ones, in units of what these make usual."""
        squares = (self.errors / np.median(self.shared[1:])) ** 2
        return np.array([squares[0], squares[1:].mean()])


def trial(kind: str, seed: int) -> Trial:
    """Measure the point of a cell with the proposed views, and with random ones."""
    measured, wanted, planned, request = planned_cell(kind, seed)
    session, rng = session_of(measured), np.random.default_rng([seed, 5])
    with library_threads_off():  # as `plan_further_views`, without the chances of effects
        now = view_outlook(session, planned.cell, planned.fitted_scatter, wanted.at, chances=False)
        scatter = now.fitted_scatter.believed
        sets = [plan._search_views(session, planned.cell, scatter, now, request)[2]]
        others, count = candidate_joints(session, planned.cell, 40), len(sets[0])
        sets += [others[rng.choice(len(others), count, replace=False)] for _ in range(RANDOM)]
        goal = _goal_over(session, planned.cell, scatter, request, np.vstack(sets))
        starts = PRESENT + count * np.arange(len(sets))
        present = list(range(PRESENT))
        expects = [goal.U(goal.channel.normal([*present, *range(k, k + count)])) for k in starts]
    states = [run(session_of(cell(kind, seed, plan=_plan_of(measured, more)))) for more in sets]
    sizes = list[Array]()

    def noted(mixed: MixedModel, fitted: VarianceFit) -> Array:
        found = mean_variances(mixed, fitted)
        if mixed.fixed is None:  # else only the scanner's share in the noise is asked for
            sizes.append(found)
        return found

    with patch.object(error_sources, "mean_variances", noted):
        stated = [_number(state, wanted) for state in states]
    with patch.object(error_sources, "mean_variances", lambda *_: np.mean(sizes, axis=0)):
        shared = [_number(state, wanted).U for state in states]
    U, errors = (np.array(x) for x in zip(*((number.U, number.value) for number in stated), strict=True))
    present_U = float(goal.U(goal.channel.normal(present)))
    return Trial(kind, present_U, np.array(expects, float), U, np.array(shared), errors)


def _plan_of(measured: Measured, further: Array) -> Plan:
    """The views of a cell and some more (K, n)."""
    joints, arm = np.vstack([measured.plan.joints, further]), measured.scene.arm
    return Plan(joints, kinematics.gravity_torques(arm, joints), np.zeros_like(joints), arm, measured.scene.useful)


def _number(state: RunData, wanted: Feature) -> Number:
    return measure_features(place_errors(state), FeatureList((wanted,))).numbers[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=21)
    parser.add_argument("--first-seed", type=int, default=640)
    parser.add_argument("--expected", action="store_true", help="As the linear model expects, for docs/plan.md.")
    arguments = parser.parse_args()
    cells = [
        (KINDS[seed % len(KINDS)], seed) for seed in range(arguments.first_seed, arguments.first_seed + arguments.cells)
    ]
    if arguments.expected:
        into_page("expected", expected_table(cells), PLAN_PAGE)
    else:
        into_page("further", measured_table(cells), PAGE)


def expected_table(cells: Sequence[tuple[str, int]]) -> list[str]:
    """Lines of the table of docs/plan.md."""
    heads = ("cells", "U now (µm)", "as many random ones", "best of 40 drawn", "proposed", f"best of {DENSE} drawn")
    lines = _head(*heads, "random / proposed")
    factors = []
    for kind, seed in cells:
        numbers = expected(kind, seed)
        factors.append(numbers[1] / numbers[3])
        lines.append(_row(kind, numbers, factors[-1:]))
    low, median, high = np.quantile(factors, [0.25, 0.5, 0.75])
    return [*lines, "", f"Median of {len(factors)} cells {median:.2f}, middle half {low:.2f} to {high:.2f}."]


def measured_table(cells: Sequence[tuple[str, int]]) -> list[str]:
    """Lines of the table of docs/measure.md."""
    heads = ("cells", "U now (µm)", "with those proposed", "with as many random ones", "random / proposed")
    lines = _head(*heads, "at the same sizes of errors", "expected")
    trials = list[Trial]()
    for kind, seed in cells:
        trials.append(trial(kind, seed))
        told = trials[-1]
        lines.append(_row(kind, (told.now, told.stated[0], np.median(told.stated[1:])), told.factors))
    factors = np.array([t.factors for t in trials])
    intervals = [bootstrap((column,), np.median, rng=0).confidence_interval for column in factors.T]
    words = [
        f"{m:.2f} ({i.low:.2f} to {i.high:.2f})" for m, i in zip(np.median(factors, axis=0), intervals, strict=True)
    ]
    squares = np.array([t.squares for t in trials]).T
    of_errors = bootstrap(tuple(squares), _error_factor, paired=True, vectorized=True, rng=0).confidence_interval
    over = {k: np.median(np.concatenate([t.shared / t.expected for t in trials if t.kind == k])) for k in KINDS}
    return [
        *lines,
        "",
        f"Medians of {len(trials)} cells with 95 % intervals: {words[0]}; at the same sizes {words[1]}; expected "
        f"{words[2]}.",
        f"True errors, rms: {_error_factor(*squares):.2f} ({of_errors.low:.2f} to {of_errors.high:.2f}). U over the "
        "expected one, median: " + ", ".join(f"{kind} {x:.2f}" for kind, x in over.items()) + ".",
    ]


def _error_factor(proposed: Array, random: Array, axis: int = -1) -> Array:
    return np.sqrt(random.mean(axis=axis) / proposed.mean(axis=axis))


def _head(*heads: str) -> list[str]:
    return ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]


def _row(kind: str, lengths: Iterable[float], factors: Iterable[float]) -> str:
    """A line of a table, printed; lengths in mm."""
    line = " | ".join([kind, *(f"{1e3 * x:.0f}" for x in lengths), *(f"{x:.2f}" for x in factors)])
    print(f"| {line} |", flush=True)
    return f"| {line} |"


if __name__ == "__main__":
    main()
