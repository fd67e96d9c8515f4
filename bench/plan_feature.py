"""Do views that `stitch plan --for` proposes make a feature better known than random ones? A table of docs/measure.md.

Run: python bench/plan_feature.py [--cells 12] [--first-seed 600]; with --expected for the table of docs/plan.md

Cells of three kinds (`feature_coverage.py`) have four views of a sphere plate, of which a point is measured. Four
further views are proposed for that point; as many are drawn from all that see the part. Both are simulated, stitched
and measured. With --expected nothing is simulated beyond the four views: U is what the linear model of the plan says,
and beside the proposed views stand the best four of a dense set of reachable ones, by exchange from several starts.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
from batch import into_page
from feature_coverage import cell, features_of

from data_synth import kinematics
from data_synth.fixtures.in_memory import session_of
from data_synth.moment import Plan
from data_synth.simulate import Measured
from stitch.frames import Array
from stitch.measurement.session import Session
from stitch.measuring.budget import measure_features
from stitch.measuring.error_sources import place_errors
from stitch.measuring.feature_file import FeatureList
from stitch.measuring.features import Feature
from stitch.pipeline import run
from stitch.planning import plan
from stitch.planning.candidate_views import candidate_joints, with_views
from stitch.planning.detection_chances import view_outlook
from stitch.planning.expected_model import CellModel, PlannedCell, Scatter, cell_of_state
from stitch.planning.plan import KnownPlace, PlanRequest, plan_further_views
from stitch.runs.run import Run
from stitch.system.threads import library_threads_off

PAGE = Path(__file__).resolve().parents[1] / "docs" / "measure.md"
PRESENT, FURTHER = 4, 4
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
        goal, best = _dense_search(session, cell_model, scatter, request, tried)
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


def _dense_search(
    session: Session, cell_model: CellModel, scatter: Scatter, request: PlanRequest, tried: Array
) -> tuple[KnownPlace, float]:
    """The goal over all views that were tried, and the least U that exchange finds there."""
    every = with_views(session, list(tried), in_turn=False)
    coarse = replace(
        cell_model, part=plan.thinned_surface(cell_model.part.points, cell_model.part.normals, plan._POINTS)
    )
    simulated = plan.simulate_views(every, coarse, plan._SAMPLES, plan._MIN_VIEW_SAMPLES)
    goal = plan._place_goal(plan.PossibleViews(every, coarse, simulated, scatter), request)
    present, rng, least = list(range(PRESENT)), np.random.default_rng(0), np.inf
    for _ in range(STARTS):
        chosen = [int(k) for k in rng.choice(np.arange(PRESENT, PRESENT + len(tried)), FURTHER, replace=False)]
        for turn in range(ROUNDS * FURTHER):
            rest = [k for i, k in enumerate(chosen) if i != turn % FURTHER]
            others = [k for k in range(PRESENT, PRESENT + len(tried)) if k not in rest]
            U = goal.U(goal.channel.with_each([*present, *rest], others))
            chosen[turn % FURTHER] = others[int(U.argmin())]
            least = min(least, float(U.min()))
    return goal, least


def trial(kind: str, seed: int) -> tuple[float, float, float]:
    """U of the point by the present views, with those proposed, and with random ones; mm."""
    measured, wanted, planned, request = planned_cell(kind, seed)
    session = session_of(measured)
    proposed = np.array([view.joints for view in plan_further_views(session, planned, request).proposed])
    others = candidate_joints(session, planned.cell, 40)
    drawn = others[np.random.default_rng([seed, 5]).choice(len(others), len(proposed), replace=False)]
    joints = np.vstack([measured.plan.joints, proposed, drawn])
    arm, still = measured.scene.arm, np.zeros_like(joints)
    plan = Plan(joints, kinematics.gravity_torques(arm, joints), still, arm, measured.scene.useful)
    whole = session_of(cell(kind, seed, plan=plan))
    sets = np.split(np.array(whole.names), [PRESENT, PRESENT + len(proposed)])
    without = ([*sets[1], *sets[2]], [*sets[2]], [*sets[1]])
    U = [_U(run(whole.without(names)), wanted) for names in without]
    return U[0], U[1], U[2]


def _U(state: Run, wanted: Feature) -> float:
    return measure_features(place_errors(state), FeatureList((wanted,))).numbers[0].U


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=12)
    parser.add_argument("--first-seed", type=int, default=600)
    parser.add_argument("--expected", action="store_true", help="As the linear model expects, for docs/plan.md.")
    arguments = parser.parse_args()
    heads = ["cells", "U now (µm)"]
    if arguments.expected:
        heads += ["as many random ones", "best of 40 drawn", "proposed", f"best of {DENSE} drawn", "random / proposed"]
    else:
        heads += ["with those proposed", "with as many random ones", "random / proposed"]
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    factors = []
    for seed in range(arguments.first_seed, arguments.first_seed + arguments.cells):
        kind = KINDS[seed % len(KINDS)]
        if arguments.expected:
            now, random, first, proposed, best = (1e3 * U for U in expected(kind, seed))
            numbers = [now, random, first, proposed, best]
        else:
            now, proposed, random = (1e3 * U for U in trial(kind, seed))
            numbers = [now, proposed, random]
        factors.append(random / proposed)
        lines.append(f"| {kind} | " + " | ".join(f"{x:.0f}" for x in numbers) + f" | {factors[-1]:.2f} |")
        print(lines[-1], flush=True)
    low, median, high = np.quantile(factors, [0.25, 0.5, 0.75])
    lines += ["", f"Median of {len(factors)} cells {median:.2f}, middle half {low:.2f} to {high:.2f}."]
    if arguments.expected:
        into_page("expected", lines, PLAN_PAGE)
    else:
        into_page("further", lines, PAGE)


if __name__ == "__main__":
    main()
