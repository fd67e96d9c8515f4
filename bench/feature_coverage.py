"""Does U of features hold? The table of docs/measure.md.

Run: python bench/feature_coverage.py [--cells 200] [--first-seed 7000]

Sphere plates in cells of known truth, of four kinds: a clean cell; a compliance of the joints that is in the model; an
arm that is a little wrong in every joint and link; a scanner with smooth errors half as large as its noise. Errors of
points, planes, spheres and distances against U (k = 2). An interval holds 95 % of what 95 % would show in so many
cells, of which each counts as one: the numbers of a cell err together.
"""

import argparse
import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np

from data_synth import kinematics
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import plan_for
from data_synth.ordinary_arm import draw_arm
from data_synth.scene import load_scene
from data_synth.shapes.spheres import SpherePlate, centres
from data_synth.simulate import Measured, simulate
from stitch import frames
from stitch.frames import Array
from stitch.measuring.budget import MeasuredFeatures, measure_features, monte_carlo
from stitch.measuring.error_sources import place_errors
from stitch.measuring.feature_file import FeatureList
from stitch.measuring.features import Feature
from stitch.pipeline import run

PAGE = Path(__file__).resolve().parents[1] / "docs" / "measure.md"
BEGIN, END = "<!-- coverage: begin -->", "<!-- coverage: end -->"
KINDS = ("clean", "effect in the model", "ordinary arm", "smooth scanner errors")
GROUPS = {"point": "points", "plane": "planes", "sphere": "spheres", "distance": "distances"}
PLATE = SpherePlate(radius=20.0)
VIEWS, PIXELS, ARM, FIELD = 10, 160, 0.3, 0.01
MONTE_CARLO_CELLS, TRIALS = 1, 1000


def cell(kind: str, seed: int) -> Measured:
    """Return a session of a sphere plate in a cell of one kind."""
    scene = load_scene("spheres")
    scanner = replace(scene.scanner, columns=PIXELS, rows=PIXELS, field_error=0.0, mixed_pixels=0.0)
    if kind == "smooth scanner errors":
        scanner = replace(scanner, field_error=FIELD)
    scene = replace(
        scene,
        scanner=scanner,
        small=0.0,
        plan=replace(scene.plan, views=VIEWS),
        part=replace(scene.part, labelled=False, parameters={"radius": PLATE.radius}),
    )
    if kind != "ordinary arm":
        return simulate(scene, {"joint_compliance": 1.0} if kind == "effect in the model" else {}, seed)
    plan, rail = plan_for(scene, seed)
    arm = draw_arm(scene.arm.joints, ARM, np.random.default_rng([seed, 77]))
    q = plan.joints + arm.offset + arm.sine * np.sin(plan.joints) + arm.cosine * np.cos(plan.joints)
    wrong = replace(scene.arm, a=scene.arm.a + arm.a, d=scene.arm.d + arm.d, alpha=scene.arm.alpha + arm.alpha)
    measured = simulate(replace(scene, arm=wrong), {}, seed, planned=(replace(plan, joints=q), rail))
    return replace(measured, scene=scene, plan=plan, T_base_flange=kinematics.flange(scene.arm, plan.joints))


def features_of(measured: Measured) -> tuple[FeatureList, Array]:
    """Return what is measured, and the true value of every number in the order of the measurement."""
    T, plate = measured.scene.T_reference_part, PLATE
    R = T[:3, :3]
    balls = frames.transform(T, centres(plate))
    wanted = [
        Feature(f"ball {i + 1}", "sphere", at=at, size=2 * plate.radius, within=2.0) for i, at in enumerate(balls)
    ]
    truth: list[float] = [x for at in balls for x in (2 * plate.radius, *at)]
    pairs = [(i, j) for i in range(len(balls)) for j in range(i)]
    for i, j in pairs:
        wanted.append(Feature(f"distance {i + 1}-{j + 1}", "distance", between=(f"ball {i + 1}", f"ball {j + 1}")))
        truth.append(float(np.linalg.norm(balls[i] - balls[j])))
    places = [(-60, 0), (60, 30), (0, -60), (50, -50), (-30, 65)]
    for k, (x, y) in enumerate(places):
        at = frames.transform(T, np.array([[x, y, 0.0]]))[0]
        wanted.append(Feature(f"point {k + 1}", "point", at=at, axis=R[:, 2], radius=8.0, within=2.0))
        truth.append(0.0)
    for k, (x, y) in enumerate([(-50, 0), (50, 0)]):
        at = frames.transform(T, np.array([[x, y, 0.0]]))[0]
        wanted.append(Feature(f"plane {k + 1}", "plane", at=at, axis=R[:, 2], radius=35.0, within=2.0))
        truth += [0.0, 0.0, 0.0]
    return FeatureList(tuple(wanted)), np.array(truth)


def measured_cell(kind: str, seed: int) -> tuple[MeasuredFeatures, Array, list[Array]]:
    """Return the numbers of a cell, their errors, and in a few cells what Monte Carlo makes of U."""
    measured = cell(kind, seed)
    state = run(session_of(measured), effects=("joint_compliance",) if kind == "effect in the model" else ())
    wanted, truth = features_of(measured)
    places = place_errors(state)
    found = measure_features(places, wanted)
    return found, np.array([n.value for n in found.numbers]) - truth, [places, wanted]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=200)
    parser.add_argument("--first-seed", type=int, default=7000)
    parser.add_argument("--no-page", action="store_true")
    arguments = parser.parse_args()
    begun, rows, ratios = time.process_time(), defaultdict(list), []
    for i in range(arguments.cells):
        kind = KINDS[i % len(KINDS)]
        found, errors, (places, wanted) = measured_cell(kind, arguments.first_seed + i)
        for number, error in zip(found.numbers, errors, strict=True):
            rows[kind, GROUPS[number.feature.kind]].append((i, number.name, error, number.U))
        if i < MONTE_CARLO_CELLS:
            ratios.append(monte_carlo(places, wanted, found.fits, TRIALS).ratio)
    lines = table(rows)
    lines += ["", trials_line(ratios)]
    print("\n".join(lines), f"\n{time.process_time() - begun:.0f} CPU seconds")
    if not arguments.no_page:
        page = PAGE.read_text(encoding="utf-8")
        text = "\n".join(lines)
        PAGE.write_text(page.split(BEGIN)[0] + BEGIN + "\n" + text + "\n" + END + page.split(END)[1], encoding="utf-8")


def table(rows: dict[tuple[str, str], list[tuple[int, str, float, float]]]) -> list[str]:
    """Return the lines of the table."""
    out = [
        "| cells | feature | numbers | error ≤ U | U over twice the true spread | largest error / U |",
        "|---|---|---|---|---|---|",
    ]
    for kind in (*KINDS, "all"):
        for group in GROUPS.values():
            own = [row for (k, g), more in rows.items() if g == group and kind in (k, "all") for row in more]
            if not own:
                continue
            error, U = np.array([row[2] for row in own]), np.array([row[3] for row in own])
            spread = np.sqrt(np.mean(U**2) / np.mean((2 * error) ** 2))
            out.append(
                f"| {kind} | {group} | {len(own)} | {100 * np.mean(np.abs(error) <= U):.1f} % | {spread:.2f} | "
                f"{np.max(np.abs(error) / U):.2f} |"
            )
    return out


def trials_line(ratios: list[Array]) -> str:
    """Return the sentence on Monte Carlo."""
    every = np.concatenate(ratios)
    return (
        f"Monte Carlo ({TRIALS:,} trials) over propagation, {len(every)} numbers of {len(ratios)} cells: "
        f"{every.min():.3f} to {every.max():.3f}."
    )


if __name__ == "__main__":
    main()
