"""Does U of features hold? The table of docs/measure.md.

Run: python bench/feature_coverage.py [--cells 200] [--first-seed 40000], then with --trials 4000 for a few cells of
other seeds; either appends to the same rows. Used up: 20000 to 20223, 30000 to 30003, 40000 to 40203.

Sphere plates in cells of known truth, of four kinds: a clean cell; a compliance of the joints that is in the model; an
arm that is a little wrong in every joint and link; a scanner with smooth errors over field and incidence, each half as
large as its noise. All have the small errors that every simulated cell has.
"""

import argparse
import json
import time
from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import beta

from data_synth import kinematics
from data_synth import simulate as simulation
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import plan_for
from data_synth.moment import Plan
from data_synth.ordinary_arm import draw_arm
from data_synth.scene import load_scene
from data_synth.shapes.spheres import SpherePlate, build_plate, centres
from data_synth.simulate import Measured, simulate
from stitch.api.pipeline import run
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.plugins.metrology.budget import MeasuredFeatures, measure_features, monte_carlo
from stitch.plugins.metrology.error_sources import place_errors
from stitch.plugins.metrology.feature_file import FeatureList
from stitch.plugins.metrology.features import Feature
from stitch.plugins.metrology.place_errors import PlaceErrors

PAGE = Path(__file__).resolve().parents[1] / "docs" / "measure.md"
BEGIN, END = "<!-- coverage: begin -->", "<!-- coverage: end -->"
KINDS = ("clean", "effect in the model", "ordinary arm", "smooth scanner errors")
GROUPS = {"point": "points", "plane": "planes", "sphere": "spheres", "distance": "distances"}
PLATE = SpherePlate(radius=28.0)
VIEWS, PIXELS, INCIDENCE = 8, 130, 0.2


@dataclass(frozen=True)
class Sizes:
    """How large things are in a cell; lengths in mm."""

    arm: float = 0.3  # of an ordinary arm, in plausible sizes
    field: float = 0.01  # of a scanner with smooth errors, rms
    drift: float = 0.0  # of the mount, in sizes of the simulator
    repeatability: tuple[float, float] = (15e-6, 0.01)  # of the flange, rad and mm


def cell(kind: str, seed: int, views: int = VIEWS, plan: Plan | None = None, sizes: Sizes = Sizes()) -> Measured:
    """Return a session of a sphere plate in a cell of one kind; of the views of a plan, if one is given."""
    scene = load_scene("spheres")
    scanner = replace(scene.scanner, columns=PIXELS, rows=PIXELS)
    hidden = {"mount_drift": sizes.drift} if sizes.drift else {}
    if kind == "smooth scanner errors":
        scanner, hidden["incidence_bias"] = replace(scanner, field_error=sizes.field), INCIDENCE
    if kind == "effect in the model":
        hidden["joint_compliance"] = 1.0
    part = replace(scene.part, labelled=False, parameters={"radius": PLATE.radius})
    scene = replace(scene, scanner=scanner, plan=replace(scene.plan, views=views), part=part)
    scene = replace(scene, repeatability=sizes.repeatability)
    plan, rail = plan_for(scene, seed) if plan is None else (plan, np.zeros(len(plan.joints)))
    if kind != "ordinary arm":
        return simulate(scene, hidden, seed, planned=(plan, rail))
    arm = draw_arm(scene.arm.joints, sizes.arm, np.random.default_rng([seed, 77]))
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


def measured_cell(
    kind: str, seed: int, sizes: Sizes = Sizes()
) -> tuple[MeasuredFeatures, Array, tuple[PlaceErrors, FeatureList]]:
    """Return the numbers of a cell, their errors, and what Monte Carlo takes."""
    measured = cell(kind, seed, sizes=sizes)
    state = run(session_of(measured), effects=("joint_compliance",) if kind == "effect in the model" else ())
    wanted, truth = features_of(measured)
    places = place_errors(state)
    found = measure_features(places, wanted)
    return found, np.array([n.value for n in found.numbers]) - truth, (places, wanted)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=200)
    parser.add_argument("--first-seed", type=int, default=40_000)
    parser.add_argument("--trials", type=int, default=0, help="Only Monte Carlo against propagation, so many trials.")
    parser.add_argument("--rows", type=Path, default=Path("runs/feature_coverage.jsonl"), help="A line for every cell.")
    arguments = parser.parse_args()
    arguments.rows.parent.mkdir(parents=True, exist_ok=True)
    mesh = build_plate(PLATE)  # the same in all cells, and a quarter of the simulation
    simulation.part_mesh = lambda scene: mesh
    for seed in range(arguments.first_seed, arguments.first_seed + arguments.cells):
        begun, kind = time.process_time(), KINDS[seed % len(KINDS)]
        found, errors, (places, wanted) = measured_cell(kind, seed)
        row: dict[str, Any] = {"seed": seed, "kind": kind}
        if arguments.trials:
            row["trials"] = arguments.trials
            row["ratios"] = monte_carlo(places, wanted, found.fits, arguments.trials).ratio.tolist()
        else:
            row["numbers"] = [
                (GROUPS[n.feature.kind], n.name, n.U, e) for n, e in zip(found.numbers, errors.tolist(), strict=True)
            ]
        with arguments.rows.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row | {"seconds": time.process_time() - begun}) + "\n")
    write_table([json.loads(line) for line in arguments.rows.read_text(encoding="utf-8").splitlines()])


def write_table(cells: list[dict[str, Any]]) -> None:
    """Print the table of all cells and write it into the page, if any counts for coverage."""
    rows, covered = defaultdict(list), [cell for cell in cells if "numbers" in cell]
    for cell in covered:
        for group, name, U, error in cell["numbers"]:
            rows[cell["kind"], group].append((cell["seed"], name, error, U))
    lines = [
        f"{len(covered)} cells, {sum(cell['seconds'] for cell in covered) / len(covered):.1f} CPU seconds each.",
        "",
    ]
    lines += [*table(rows), "", trials_line([cell for cell in cells if "ratios" in cell])]
    print("\n".join(lines))
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(page.split(BEGIN)[0] + BEGIN + "\n" + "\n".join(lines) + "\n" + END + page.split(END)[1])


def table(rows: dict[tuple[str, str], list[tuple[int, str, float, float]]]) -> list[str]:
    """Return the lines of the table."""
    out = [
        "| cells | feature | numbers | error ≤ U | 95 % interval | U over twice the true spread | largest error / U |",
        "|---|---|---|---|---|---|---|",
    ]
    for kind in (*KINDS, "all"):
        for group in GROUPS.values():
            own = [row for (k, g), more in rows.items() if g == group and kind in (k, "all") for row in more]
            if not own:
                continue
            share = np.array([abs(error) / U for _, _, error, U in own])
            low, high = covered_interval(np.array([row[0] for row in own]), share <= 1)
            out.append(
                f"| {kind} | {group} | {len(own)} | {100 * np.mean(share <= 1):.1f} % | {low:.0f} to {high:.0f} % | "
                f"{0.5 / np.sqrt(np.mean(share**2)):.2f} | {share.max():.2f} |"
            )
    return out


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


def trials_line(cells: list[dict[str, Any]]) -> str:
    """Return the sentence on Monte Carlo."""
    if not cells:
        return "Monte Carlo was not run."
    every = np.concatenate([cell["ratios"] for cell in cells])
    return (
        f"Monte Carlo ({cells[0]['trials']:,} trials) over propagation, {len(every)} numbers of {len(cells)} cells: "
        f"{every.min():.3f} to {every.max():.3f}."
    )


if __name__ == "__main__":
    main()
