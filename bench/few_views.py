"""Does U of the hand-eye hold where views are few? Whole fits from a coarse hand-eye, χ² against the truth.

Usage: python bench/few_views.py --seed S [--cells N] [--views 4,5,6,7,8] [--keep FILE] [--write]

Every cell has views, clouds and an arm of its own; seeds take scenes, views and kinds of arm in turn. The scans are
those of an arm without errors, and the reported poses those of one that has them, which is the same to first order.
Used up: 7000, 7100, 9000 to 9026, 31000 to 31044, 31100 to 31123, 40000 to 40399 (docs/method.md, "What U rests on").
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from batch import into_page
from blind_cells import scene_of
from blind_trials import pin

from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import plan_for
from data_synth.ordinary_arm import draw_arm
from data_synth.scene import load_scene
from data_synth.simulate import on_rail, simulate
from stitch.fit.correct import correct
from stitch.model.model import COVERAGE_FACTOR, Model
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.observations.pose_errors import PoseErrors, prior_pose_errors
from stitch.observations.surfaces.scanner_errors import rig_scanner_errors
from stitch.observations.surfaces.view_poses import UnconstrainedPoses
from stitch.session.capture import part_size, prepare_capture
from stitch.session.measurement import measurement_of

PAGE = Path(__file__).resolve().parents[1] / "docs" / "method.md"
SCENES = ("blade", "drill-plate", "blade-table")
SIZES = (0.0, 0.5, 1.0)  # of an ordinary arm; 0: nothing but scatter and the quiet effects that every cell has
_GATE = 0.05  # first distance between partners, as a share of the part
_BEYOND = 2.8  # of χ²(6)/6, the 1 % point


def fitted_error(scene: str, seed: int, views: int, size: float) -> tuple[Array, Array]:
    """Error of the hand-eye (6,) of one cell, and its covariance (6, 6)."""
    plan, rail = plan_for(load_scene(scene), seed, views)
    measured = simulate(scene_of(scene), {}, seed, planned=(plan, rail))
    if size:
        arm = draw_arm(plan.arm.joints, size, np.random.default_rng([seed, 77]))
        measured = replace(measured, T_base_flange=on_rail(arm.flange(plan.arm, plan.joints), rail))
    session = session_of(measured)
    measurement = measurement_of(session, prepare_capture(session))

    def errors(freed: Sequence[UnconstrainedPoses], T_mount: Array) -> PoseErrors:
        return prior_pose_errors([measurement], Model(T_mount), [f.overlaps.gram.centre for f in freed])

    capture = measurement.capture
    found = correct(
        [capture],
        measured.T_coarse,
        _GATE * part_size([capture]),
        scanner_errors=partial(rig_scanner_errors, [measurement]),
        pose_error_prior=errors,
    ).hand_eye
    return frames.log(frames.inverse(found.T_mount) @ measured.T_mount), found.covariance


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--cells", type=int, default=15)
    parser.add_argument("--views", default="4,5,6,7,8")
    parser.add_argument("--keep", type=Path, help="A line for every cell; those that it holds are not run again.")
    parser.add_argument("--write", action="store_true", help="Put the table into docs/method.md.")
    options = parser.parse_args()
    pin(0)
    views = [int(v) for v in options.views.split(",")]
    kept = options.keep.read_text().splitlines() if options.keep and options.keep.exists() else []
    done = {row["seed"]: row for row in map(json.loads, kept)}
    for k in range(options.cells):
        seed, scene = options.seed + k, SCENES[k % 3]
        count, size = views[k // 3 % len(views)], SIZES[k // (3 * len(views)) % 3]
        if seed in done:
            continue
        xi, covariance = fitted_error(scene, seed, count, size)
        square = float(xi @ np.linalg.solve(covariance, xi)) / 6
        ratio = xi / (COVERAGE_FACTOR * np.sqrt(np.diag(covariance)))
        done[seed] = {"seed": seed, "scene": scene, "views": count, "arm": size, "chi2": square, "of_U": ratio.tolist()}
        if options.keep:
            with options.keep.open("a") as file:
                file.write(json.dumps(done[seed]) + "\n")
    lines = table(list(done.values()))
    print("\n".join(lines))
    if options.write:
        into_page("few", lines, PAGE)


def table(cells: list[dict[str, Any]]) -> list[str]:
    """Return the lines of the table."""
    first = min(cell["seed"] for cell in cells)
    lines = [
        f"{len(cells)} cells from seed {first} on:",
        "",
        "| cells | fits | mean χ²/6 (95 %) | beyond 2.8 | largest | inside U (k = 2) | single axes |",
        "|---|---:|---:|---:|---:|---:|---|",
    ]
    groups = {"all": cells}
    for key, name in (("arm", "ordinary {:g}"), ("views", "{} views")):
        for value in sorted({cell[key] for cell in cells}):
            groups[name.format(value)] = [cell for cell in cells if cell[key] == value]
    for name, own in groups.items():
        squares, axes = np.array([cell["chi2"] for cell in own]), np.abs([cell["of_U"] for cell in own]) < 1
        wide, each = 1.96 * squares.std() / np.sqrt(len(squares)), axes.mean(axis=0)
        lines.append(
            f"| {name} | {len(own)} | {squares.mean():.2f} ± {wide:.2f} | {np.sum(squares > _BEYOND)} "
            f"| {squares.max():.1f} | {axes.mean():.3f} | {each.min():.3f} … {each.max():.3f} |"
        )
    return lines


if __name__ == "__main__":
    main()
