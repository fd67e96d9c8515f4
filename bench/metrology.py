"""Does U of features hold, on sphere plates in cells of known truth?

FEATURES: a clean cell; a compliance of the joints that is in the model; an arm that is a little wrong in every joint
and link; a scanner with smooth errors over field and incidence, each half as large as its noise; one whose smooth
errors are new in each scan. All have the small errors that every simulated cell has. MONTE_CARLO puts its spread over
that of propagation. Used up: 20000 to 20223, 30000 to 30003, 40000 to 40203, 42000 to 42064, 43000 to 43119, 46000 to
46019.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from unittest.mock import patch

import numpy as np
import trimesh
from scipy.stats import beta

from bench.harness import Row, Table, markdown
from data_synth import kinematics
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import plan_for
from data_synth.ordinary_arm import draw_arm
from data_synth.scene import load_scene
from data_synth.shapes.spheres import SpherePlate, build_plate, centres
from data_synth.simulate import Measured, simulate
from stitch.api.pipeline import run
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.plugins.metrology.budget import measure_features, monte_carlo
from stitch.plugins.metrology.error_sources import place_errors
from stitch.plugins.metrology.feature_file import FeatureList
from stitch.plugins.metrology.features import Feature
from stitch.plugins.metrology.place_errors import PlaceErrors

NEW_IN_EACH = "smooth errors new in each scan"
ARM_AND_NEW = f"ordinary arm, {NEW_IN_EACH}"
KINDS = ("clean", "effect in the model", "ordinary arm", "smooth scanner errors", NEW_IN_EACH)
GROUPS = {
    "point deviation": "points",
    "plane offset": "planes",
    "plane slope_u": "angles",
    "plane slope_v": "angles",
    "sphere diameter": "diameters",
    "sphere x": "sphere centres",
    "sphere y": "sphere centres",
    "sphere z": "sphere centres",
    "distance distance": "distances",
}
PLATE = SpherePlate(radius=28.0)
VIEWS, PIXELS, INCIDENCE = 8, 130, 0.2
ARM = 0.3  # of an ordinary arm, in plausible sizes
FIELD = 0.01  # of a scanner with smooth errors, mm rms
SCAN_LENGTHS = (0.05, 0.3)  # over which those of a single scan stay alike, as shares of the field
REPEATABILITY = (15e-6, 0.01)  # of the flange, rad and mm


def feature_jobs(seeds: range) -> Iterator[Row]:
    """The kinds in turn."""
    yield from ({"seed": seed, "kind": KINDS[seed % len(KINDS)]} for seed in seeds)


def feature_trial(job: Row) -> Row:
    """Numbers of a cell: the group of the feature, its U and its error."""
    places, features, truth = _measured(job)
    numbers = measure_features(places, features).numbers
    errors = np.array([n.value for n in numbers]) - truth
    return {
        "numbers": [
            (GROUPS[f"{n.feature.kind} {n.quantity}"], n.U, e) for n, e in zip(numbers, errors.tolist(), strict=True)
        ]
    }


def _measured(job: Row) -> tuple[PlaceErrors, FeatureList, Array]:
    """Errors of places in a run of the cell, what is measured there, and its true numbers."""
    kind = job["kind"]
    # The same part in all cells, and a quarter of the simulation.
    with patch("data_synth.simulate.part_mesh", lambda scene: _plate()):
        measured = cell(kind, job["seed"])
    state = run(session_of(measured), effects=("joint_compliance",) if kind == "effect in the model" else ())
    return place_errors(state), *features_of(measured)


@cache
def _plate() -> trimesh.Trimesh:
    return build_plate(PLATE)


def cell(kind: str, seed: int, day: int = 0) -> Measured:
    """Return a session of a sphere plate in a cell of one kind, at other poses every day."""
    scene = load_scene("spheres")
    scanner = replace(scene.scanner, columns=PIXELS, rows=PIXELS)
    hidden = {"joint_compliance": 1.0} if kind == "effect in the model" else {}
    if kind == "smooth scanner errors":
        scanner = replace(scanner, field_error=FIELD)
        hidden = {"incidence_bias": INCIDENCE}
    if kind in (NEW_IN_EACH, ARM_AND_NEW):
        length = np.exp(np.random.default_rng([seed, 78]).uniform(*np.log(SCAN_LENGTHS)))
        scanner = replace(scanner, scan_error=FIELD, scan_error_length=float(length))
    part = replace(scene.part, labelled=False, parameters={"radius": PLATE.radius})
    scene = replace(scene, scanner=scanner, plan=replace(scene.plan, views=VIEWS), part=part)
    scene = replace(scene, repeatability=REPEATABILITY)
    plan, rail = plan_for(scene, seed + 100_000 * day)
    if kind not in ("ordinary arm", ARM_AND_NEW):
        return simulate(scene, hidden, seed, planned=(plan, rail), day=day)
    arm = draw_arm(scene.arm.joints, ARM, np.random.default_rng([seed, 77]))
    q = plan.joints + arm.offset + arm.sine * np.sin(plan.joints) + arm.cosine * np.cos(plan.joints)
    wrong = replace(scene.arm, a=scene.arm.a + arm.a, d=scene.arm.d + arm.d, alpha=scene.arm.alpha + arm.alpha)
    measured = simulate(replace(scene, arm=wrong), {}, seed, planned=(replace(plan, joints=q), rail), day=day)
    return replace(measured, scene=scene, plan=plan, T_base_flange=kinematics.flange(scene.arm, plan.joints))


def features_of(measured: Measured) -> tuple[FeatureList, Array]:
    """Return what is measured, and the true value of every number in the order of the measurement."""
    T, plate = measured.scene.T_reference_part, PLATE
    R = T[:3, :3]
    balls = frames.transform(T, centres(plate))
    size = 2 * plate.radius
    features = [Feature(f"ball {i + 1}", "sphere", at=at, size=size, within=2.0) for i, at in enumerate(balls)]
    truth: list[float] = [x for at in balls for x in (size, *at)]
    pairs = [(i, j) for i in range(len(balls)) for j in range(i)]
    for i, j in pairs:
        features.append(Feature(f"distance {i + 1}-{j + 1}", "distance", between=(f"ball {i + 1}", f"ball {j + 1}")))
        truth.append(float(np.linalg.norm(balls[i] - balls[j])))
    places = [(-60, 0), (60, 30), (0, -60), (50, -50), (-30, 65)]
    for k, (x, y) in enumerate(places):
        at = frames.transform(T, np.array([[x, y, 0.0]]))[0]
        features.append(Feature(f"point {k + 1}", "point", at=at, axis=R[:, 2], radius=8.0, within=2.0))
        truth.append(0.0)
    for k, (x, y) in enumerate([(-50, 0), (50, 0)]):
        at = frames.transform(T, np.array([[x, y, 0.0]]))[0]
        features.append(Feature(f"plane {k + 1}", "plane", at=at, axis=R[:, 2], radius=35.0, within=2.0))
        truth += [0.0, 0.0, 0.0]
    return FeatureList(tuple(features)), np.array(truth)


def feature_summary(rows: list[Row]) -> list[str]:
    """A line a kind of cell and of feature."""
    numbers = [(row["kind"], group, row["seed"], abs(error) / U) for row in rows for group, U, error in row["numbers"]]
    lines = []
    for kind in (*KINDS, "all"):
        for group in dict.fromkeys(GROUPS.values()):
            chosen = [(seed, ratio) for k, g, seed, ratio in numbers if g == group and kind in (k, "all")]
            if not chosen:
                continue
            seeds, ratios = np.array(chosen).T
            low, high = covered_interval(seeds, ratios <= 1)
            share, spread = f"{100 * np.mean(ratios <= 1):.1f} %", f"{0.5 / np.sqrt(np.mean(ratios**2)):.2f}"
            lines.append([kind, group, len(ratios), share, f"{low:.0f} to {high:.0f} %", spread, f"{ratios.max():.2f}"])
    head = "cells | feature | numbers | error ≤ U | 95 % interval | U over twice the true spread | largest error / U"
    seconds = sum(row["cpu_seconds"] for row in rows) / len(rows)
    return [f"{len(rows)} cells, {seconds:.1f} CPU seconds each.", "", *markdown(head, lines)]


def covered_interval(seeds: Array, covered: Array) -> Array:
    """(2,) bounds in per cent: Clopper and Pearson's of as many free numbers as the scatter of the cells allows.

    Numbers of one cell err together, by its hand-eye.
    """
    of_cell = np.array([covered[seeds == seed].mean() for seed in np.unique(seeds)])
    count, p = float(len(of_cell)), covered.mean()
    if of_cell.var() > 0:
        count = min(p * (1 - p) * (count - 1) / of_cell.var(), len(covered))
    within, beyond = count * p, count * (1 - p)
    low = beta.ppf(0.025, within, beyond + 1) if within else 0.0
    high = beta.ppf(0.975, within + 1, beyond) if beyond else 1.0
    return 100 * np.array([low, high])


FEATURES = Table(feature_jobs, feature_trial, feature_summary, range(47_000, 47_200), page="measure", block="coverage")


def trials_jobs(seeds: range, trials: int) -> Iterator[Row]:
    """The same cells."""
    yield from ({**job, "trials": trials} for job in feature_jobs(seeds))


def trials_trial(job: Row) -> Row:
    """Spread by Monte Carlo over that of propagation, of every number."""
    places, features, _ = _measured(job)
    fits = measure_features(places, features).fits
    return {"ratios": monte_carlo(places, features, fits, job["trials"]).ratio.tolist()}


def trials_summary(rows: list[Row]) -> list[str]:
    """One sentence."""
    ratios = np.concatenate([row["ratios"] for row in rows])
    what = f"Monte Carlo ({rows[0]['trials']:,} trials) over propagation, {len(ratios)} numbers of {len(rows)} cells"
    return [f"{what}: {ratios.min():.3f} to {ratios.max():.3f}."]


MONTE_CARLO = Table(
    trials_jobs, trials_trial, trials_summary, range(40_200, 40_204), page="measure", block="monte-carlo",
    settings={"trials": 4000},
)  # fmt: skip
