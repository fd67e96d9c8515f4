"""Does U of features hold, and does a certificate pass what is right and fail what is wrong? On sphere plates in cells
of known truth, by a simulator that shares no code with the model.

FEATURES: a clean cell; a compliance of the joints that is in the model; an arm that is a little wrong in every joint
and link; a scanner with smooth errors over field and incidence, each half as large as its noise; one whose smooth
errors are new in each scan. All have the small errors that every simulated cell has. Used up: 20000 to 20223, 30000
to 30003, 40000 to 40203, 42000 to 42064, 43000 to 43119, 46000 to 46019, 46200 to 46239,
46300 to 46339, 46400 to 46439.

CERTIFICATES: the hand-eye from one day and the artefact on another, at other poses: clean cells, and arms that are a
little wrong in every joint and link; all scanners have smooth errors that are new in each scan. The hand-eye of the
model is right, or off by so many of its U in a direction drawn at random; or one number is off by 3 U, or two by 1 mm.
Used up: 60000 to 60039, 61000 to 61039,
62000 to 62003.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from unittest.mock import patch

import numpy as np
import trimesh
from scipy.stats import beta

from bench.harness import Row, Table, markdown, share
from data_synth import kinematics
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import plan_for
from data_synth.ordinary_arm import draw_arm
from data_synth.scene import load_scene
from data_synth.shapes.spheres import SpherePlate, build_plate, centres
from data_synth.simulate import Measured, simulate
from stitch.api.pipeline import run
from stitch.errors import NoResultError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.output.result_document import model_of
from stitch.plugins.metrology.budget import MeasuredFeatures, measure_features
from stitch.plugins.metrology.error_sources import place_errors
from stitch.plugins.metrology.feature_file import FeatureList
from stitch.plugins.metrology.features import Feature
from stitch.plugins.metrology.verification import Verification, verify
from stitch.run_data import HandEyeTransfer

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
VIEWS, PIXELS, OVER_INCIDENCE = 8, 130, 0.2
ARM = 0.3  # of an ordinary arm, in plausible sizes
FIELD = 0.01  # of a scanner with smooth errors, mm rms
SCAN_LENGTHS = (0.05, 0.3)  # over which those of a single scan stay alike, as shares of the field
REPEATABILITY = (15e-6, 0.01)  # of the flange, rad and mm
CERTIFIED = (NEW_IN_EACH, ARM_AND_NEW)
U_CALIBRATED = 0.002  # mm, of a laboratory
OFF_BY = (0.0, 3.0, 5.0, 13.0)


def feature_jobs(seeds: range) -> Iterator[Row]:
    """The kinds in turn."""
    yield from ({"seed": seed, "kind": KINDS[seed % len(KINDS)]} for seed in seeds)


def feature_trial(job: Row) -> Row:
    """Numbers of a cell: the group of the feature, its U and its error."""
    kind = job["kind"]
    # The same part in all cells, and a quarter of the simulation.
    with patch("data_synth.simulate.part_mesh", lambda scene: _plate()):
        measured = cell(kind, job["seed"])
    state = run(session_of(measured), effects=("joint_compliance",) if kind == "effect in the model" else ())
    features, truth = features_of(measured)
    numbers = measure_features(place_errors(state), features).numbers
    errors = np.array([n.value for n in numbers]) - truth
    return {
        "numbers": [
            (GROUPS[f"{n.feature.kind} {n.quantity}"], n.U, e) for n, e in zip(numbers, errors.tolist(), strict=True)
        ]
    }


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
        hidden = {"incidence_bias": OVER_INCIDENCE}
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
            inside, spread = f"{100 * np.mean(ratios <= 1):.1f} %", f"{0.5 / np.sqrt(np.mean(ratios**2)):.2f}"
            lines.append(
                [kind, group, len(ratios), inside, f"{low:.0f} to {high:.0f} %", spread, f"{ratios.max():.2f}"]
            )
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


def certificate_jobs(seeds: range) -> Iterator[Row]:
    """The kinds in turn."""
    yield from ({"seed": seed, "kind": CERTIFIED[seed % len(CERTIFIED)]} for seed in seeds)


def certificate_trial(job: Row) -> Row:
    """Return the verdict for every wrong hand-eye, and for wrong numbers under the right one."""
    rng = np.random.default_rng([job["seed"], 5])
    with patch("data_synth.simulate.part_mesh", lambda scene: _plate()):
        part, artefact = (cell(job["kind"], job["seed"], day) for day in range(2))
    model = model_of(run(session_of(part)))
    features, truth = features_of(artefact)
    wanted = _calibrated(features, truth, rng)
    direction = rng.standard_normal(3)
    direction *= 2 * np.sqrt(np.diag(model.covariance))[3:] / np.linalg.norm(direction)
    verdicts = {}
    for by in OFF_BY:
        shift = frames.make(np.eye(3), by * direction)
        try:
            state = run(session_of(artefact), replace(model, T_mount=model.T_mount @ shift))
        except NoResultError:  # millimetres off: no certificate, and the run says that the hand-eye is another's
            verdicts[f"{by:g} U"] = [False]
            continue
        measured, hand_eye = measure_features(place_errors(state), wanted), state.hand_eye_transfer
        assert hand_eye is not None
        result = verify(measured, None, hand_eye)
        verdicts[f"{by:g} U"] = [result.passed, hand_eye.holds, result.agreeing / len(result.numbers)]
        if not by:
            verdicts["one number by 3 U"] = [_with_wrong_numbers(measured, hand_eye, {0: 3.0}).passed]
            verdicts["two numbers by 1 mm"] = [_with_wrong_numbers(measured, hand_eye, {1: None, 6: None}).passed]
    return {"verdicts": verdicts}


def _calibrated(features: FeatureList, truth: np.ndarray, rng: np.random.Generator) -> FeatureList:
    """Features with the first of their true numbers, off as the laboratory's U allows."""
    first = np.cumsum([0, *(4 if f.kind == "sphere" else 3 if f.kind == "plane" else 1 for f in features.features)])
    known = [
        replace(f, calibrated=float(truth[k] + U_CALIBRATED / 2 * rng.standard_normal()), calibrated_U=U_CALIBRATED)
        for f, k in zip(features.features, first, strict=False)
    ]
    return replace(features, features=tuple(known))


def _with_wrong_numbers(
    measured: MeasuredFeatures, hand_eye: HandEyeTransfer, wrong: dict[int, float | None]
) -> Verification:
    """The verdict where some features' first numbers are off by so many U, or by 1 mm."""
    numbers = list(measured.numbers)
    first: dict[str, int] = {}
    for k, number in enumerate(numbers):
        first.setdefault(number.feature.name, k)
    places = list(first.values())
    for which, by in wrong.items():
        number = numbers[places[which]]
        numbers[places[which]] = replace(number, value=number.value + (1.0 if by is None else by * number.U))
    return verify(replace(measured, numbers=tuple(numbers)), None, hand_eye)


def certificate_summary(rows: list[Row]) -> list[str]:
    """A line for each kind of cell and each thing that is wrong."""
    lines = []
    for kind in (*CERTIFIED, "all"):
        chosen = [row["verdicts"] for row in rows if kind in (row["kind"], "all")]
        for case in chosen[0] if chosen else ():
            passed = [verdicts[case][0] for verdicts in chosen]
            agreeing = [verdicts[case][2] for verdicts in chosen if len(verdicts[case]) > 1]
            within = f"{100 * np.mean(agreeing):.1f} %" if agreeing else "–"
            counts = [share(verdict is expected for verdict in passed) for expected in (True, False, None)]
            lines.append((kind, case, *counts, within))
    return markdown("cell | off | passed | failed | undecided | numbers within U", lines)


CERTIFICATES = Table(
    certificate_jobs, certificate_trial, certificate_summary, range(61017, 61040), page="measure", block="certificate"
)
