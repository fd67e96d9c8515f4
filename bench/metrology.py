"""Do what is said of measured features and of planned views hold?

FEATURES: does U of features hold, on sphere plates in cells of known truth? A clean cell; a compliance of the joints
that is in the model; an arm that is a little wrong in every joint and link; a scanner with smooth errors over field and
incidence, each half as large as its noise; one whose smooth errors are new in each scan. All have the small errors that
every simulated cell has. MONTE_CARLO puts its spread over that of propagation. Used up: 20000 to 20223, 30000 to 30003,
40000 to 40203, 42000 to 42064, 43000 to 43119, 46000 to 46019.

CHANCES: do the chances that `stitch plan` states hold? A cell with one hidden effect of the size that nature draws,
times 0.2 to 2. Before any scan the plan says how likely an effect of that size and shape is detected, named, misnamed;
then every scan is simulated, and the verdict of a diagnosis taken. The simulator shares no code with the plan. Some 4 s
a cell; seeds count cells.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from itertools import pairwise
from unittest.mock import patch

import numpy as np
import trimesh
from scipy.stats import beta

from bench.harness import Row, Table, markdown, share
from bench.unknown_laws import nearest_form
from data_synth import kinematics
from data_synth.fixtures.blade_cells import captured, measured_blade
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import plan_for
from data_synth.ordinary_arm import draw_arm
from data_synth.scene import load_scene
from data_synth.shapes.spheres import SpherePlate, build_plate, centres
from data_synth.simulate import Measured, simulate
from stitch.api.pipeline import run
from stitch.diagnosis.candidates import candidates_of
from stitch.diagnosis.evidence import gather_evidence
from stitch.diagnosis.score import scatter_limit
from stitch.model.model import Model
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.observations.pose_errors import prior_pose_errors
from stitch.observations.surfaces.hand_eye_fit import fit_hand_eye
from stitch.observations.surfaces.surface_model import surface_model
from stitch.observations.surfaces.view_poses import unconstrained_poses
from stitch.plugins.metrology.budget import measure_features, monte_carlo
from stitch.plugins.metrology.error_sources import place_errors
from stitch.plugins.metrology.feature_file import FeatureList
from stitch.plugins.metrology.features import Feature
from stitch.plugins.metrology.place_errors import PlaceErrors
from stitch.plugins.metrology.planning import expected_model as expected
from stitch.plugins.metrology.planning.detection_chances import DRAWS, ExpectedDiagnosis
from stitch.session.measurement import measurement_of, with_part_origin

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
LAWS = (
    *("joint_compliance", "range_scale", "gear_harmonic", "backlash", "part_slip", "joint_offset", "incidence_bias"),
    *("link_geometry", "mount_drift", "gear_eccentricity", "lens_distortion", "settling"),
)
FIRST_SEED = 700
_VIEWS, _PIXELS = 12, 150
_SIZES = (0.2, 2.0)  # of nature's own, log-uniform
_BINS = (0.0, 0.25, 0.75, 1.0)
_ENOUGH = 20


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


def chance_jobs(seeds: range) -> Iterator[Row]:
    """Every third cell has nothing hidden, mounts take turns."""
    for index in seeds:
        law = None if index % 3 == 2 else LAWS[(index - index // 3) % len(LAWS)]
        yield {"index": index, "law": law, "mount": ("eye_to_hand", "eye_in_hand")[index // 3 % 2]}


def chance_trial(job: Row) -> Row:
    """What the plan says before any scan, and what a diagnosis says of the scans."""
    rng = np.random.default_rng([FIRST_SEED, job["index"]])
    law, size = job["law"], float(np.exp(rng.uniform(*np.log(_SIZES))))
    cell = partial(measured_blade, FIRST_SEED + job["index"], views=_VIEWS, mount=job["mount"], pixels=_PIXELS)
    measured = cell(hidden={} if law is None else {law: size})
    predicted = planned(measured, law, rng)
    return {"size": size, **predicted, **diagnosed(measured, predicted)}


def planned(measured: Measured, law: str | None, rng: np.random.Generator) -> Row:
    """Return what the plan says: it knows the part, the poses, the coarse hand-eye and the usual scatter."""
    session, scene = session_of(measured), measured.scene
    half = np.tan(np.radians(scene.scanner.field_of_view / 2)) * np.ones(2)
    reach, axis = scene.scanner.standoff, np.array([0.0, 0.0, 1.0])
    field = expected.FieldOfView(half, 0.7 * reach, 1.3 * reach, standoff=reach, axis=axis)
    part = expected.surface_of_mesh(measured.mesh.copy()).moved(scene.T_reference_part)
    cell = expected.CellModel(Model(measured.T_coarse), part, field, expected.stated_scatter(session))
    views = expected.simulate_views(session, cell)
    linear = expected.expected_model(views, cell)
    scatter = expected.expected_scatter(linear, cell.scatter.noise)
    hand_eye = expected.expected_hand_eye(expected.with_scatter(linear, scatter.believed), views)
    predicted: Row = {"covariance": hand_eye.covariance.tolist()}
    if law is None:
        return predicted
    candidates, _ = candidates_of(linear, empirical=False)
    candidate = next(c for c in candidates if c.name == law)
    true = measured.hidden[law]
    form = nearest_form(candidate, true)
    values = np.array([true.get(p.name, 0.0) for p in candidate.parameters])
    shift = np.repeat((form.columns @ values[form.keep])[:, None], DRAWS, axis=1)
    fitted = expected.with_scatter(linear, scatter.fitted)
    chance = ExpectedDiagnosis(fitted, candidates).chance(law, shift, rng)
    return predicted | {"detected": chance.detected, "named": chance.named, "misnamed": chance.misnamed}


def diagnosed(measured: Measured, predicted: Row) -> Row:
    """Return the verdict about the simulated scans; of a cell with nothing hidden, the error of the hand-eye too."""
    session, capture = session_of(measured), captured(measured)
    measurement = with_part_origin(measurement_of(session, capture), measured.T_mount)
    views = unconstrained_poses(capture, capture.poses(measured.T_mount), 4 * capture.spacing)
    model = Model(measured.T_mount)
    linear = surface_model(measurement, model, capture, views)
    evidence = gather_evidence(linear, candidates_of(linear)[0], scatter_limit(session))
    row: Row = {"verdict": evidence.verdict, "said": [r.name for r in evidence.named]}
    if not measured.hidden:
        errors = prior_pose_errors([measurement], model, [views.overlaps.gram.centre])
        T_mount = fit_hand_eye([capture], [views], measured.T_mount, errors=errors).T_mount
        xi = frames.log(frames.inverse(measured.T_mount) @ T_mount)
        row["chi_square"] = float(xi @ np.linalg.solve(np.array(predicted["covariance"]), xi))
    return row


def chance_summary(rows: list[Row]) -> list[str]:
    """What was predicted against what came, in bins of the predicted chance."""
    hidden = [row for row in rows if row["law"] is not None]
    empty = [row for row in rows if row["law"] is None]
    came: dict[str, Callable[[Row], bool]] = {
        "detected": lambda r: r["verdict"] != "adequate",
        "named": lambda r: r["verdict"] == "missing_effect" and r["said"] == [r["law"]],
        "misnamed": lambda r: r["verdict"] == "missing_effect" and r["said"] != [r["law"]],
    }
    lines = []
    for what, hit in came.items():
        for low, high in pairwise(_BINS):
            cells = [row for row in hidden if low <= row[what] < high or row[what] == high == 1.0]
            if cells:
                mean = f"{np.mean([row[what] for row in cells]):.0%}"
                lines.append([what, f"{low:.0%} to {high:.0%}", len(cells), mean, share(map(hit, cells))])
    text = markdown("of what | chance stated | cells | mean of it | came", lines)
    if empty:
        alarms = share(row["verdict"] != "adequate" for row in empty)
        square = f"{np.mean([row['chi_square'] for row in empty]) / 6:.2f}"
        text += [
            "",
            f"Nothing hidden: {alarms} alarm; χ²/6 of the hand-eye under the stated covariance {square} on average.",
        ]
    if len(rows) < _ENOUGH:
        text += ["", f"Only {len(rows)} cells so far: too few to say that the chances are calibrated."]
    return text


CHANCES = Table(chance_jobs, chance_trial, chance_summary, range(40), page="plan", block="chances")
