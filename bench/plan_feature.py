"""Do views that `stitch plan --for` proposes make a feature better known than random ones? A table of docs/measure.md.

Run: python -m bench.plan_feature [--cells 12] [--first-seed 600]

Cells of three kinds (`feature_coverage.py`) have four views of a sphere plate, of which a point is measured. Four
further views are proposed for that point; as many are drawn from all that see the part. Both are simulated, stitched
and measured.
"""

import argparse
from pathlib import Path

import numpy as np

from bench.feature_coverage import cell, features_of
from data_synth import kinematics
from data_synth.fixtures.in_memory import session_of
from data_synth.moment import Plan
from stitch.measuring.budget import measure_features
from stitch.measuring.error_sources import place_errors
from stitch.measuring.feature_file import FeatureList
from stitch.measuring.features import Feature
from stitch.pipeline import run
from stitch.planning.candidate_views import candidate_joints
from stitch.planning.expected_model import cell_of_state
from stitch.planning.plan import PlanRequest, plan_further_views
from stitch.runs.run import Run

PAGE = Path(__file__).resolve().parents[1] / "docs" / "measure.md"
BEGIN, END = "<!-- further: begin -->", "<!-- further: end -->"
PRESENT, FURTHER = 4, 4
KINDS = ("clean", "ordinary arm", "smooth scanner errors")


def trial(kind: str, seed: int) -> tuple[float, float, float]:
    """U of the point by the present views, with those proposed, and with random ones; mm."""
    measured = cell(kind, seed, PRESENT)
    session = session_of(measured)
    wanted = next(f for f in features_of(measured)[0].features if f.kind == "point")
    state = run(session)
    assert state.fused is not None
    planned = cell_of_state(state, state.fused.points, state.fused.normals)
    request = PlanRequest(split_any=False, views=FURTHER, feature=np.append(wanted.at, wanted.axis))
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
    arguments = parser.parse_args()
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.cells)
    lines = [
        "| cells | U now (µm) | with those proposed | with as many random ones | random / proposed |",
        "|---|---|---|---|---|",
    ]
    rows = []
    for seed in seeds:
        kind = KINDS[seed % len(KINDS)]
        rows.append(trial(kind, seed))
        now, proposed, drawn = (1e3 * U for U in rows[-1])
        lines.append(f"| {kind} | {now:.0f} | {proposed:.0f} | {drawn:.0f} | {drawn / proposed:.2f} |")
        print(lines[-1], flush=True)
    low, median, high = np.quantile([drawn / proposed for _, proposed, drawn in rows], [0.25, 0.5, 0.75])
    lines += ["", f"Median of {len(rows)} cells {median:.2f}, middle half {low:.2f} to {high:.2f}."]
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(page.split(BEGIN)[0] + BEGIN + "\n" + "\n".join(lines) + "\n" + END + page.split(END)[1])


if __name__ == "__main__":
    main()
