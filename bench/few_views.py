"""Does U of the hand-eye hold where views are few? Whole fits from a coarse hand-eye, χ² against the truth.

Usage: python bench/few_views.py --seed S [--cells N] [--views 4,5,6,7,8]

Every cell has views, clouds and an arm of its own; seeds take scenes, views and kinds of arm in turn. The scans are
those of an arm without errors, and the reported poses those of one that has them, which is the same to first order.
Used up: 7000, 7100, 9000 to 9026 (docs/method.md, "What U rests on").
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from blind_cells import scene_of
from blind_trials import pin

from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import plan_for
from data_synth.ordinary_arm import draw_arm
from data_synth.scene import load_scene
from data_synth.simulate import on_rail, simulate
from stitch import frames
from stitch.frames import Array
from stitch.measurement.capture import part_size, prepare_capture
from stitch.measurement.measurement import measurement_of
from stitch.model.model import COVERAGE_FACTOR, Model
from stitch.observations.pose_errors import PoseErrors, prior_pose_errors
from stitch.observations.surfaces.scanner_errors import rig_scanner_errors
from stitch.observations.surfaces.view_poses import UnconstrainedPoses
from stitch.stages.correct import correct

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
    options = parser.parse_args()
    pin(0)
    views, rows = [int(v) for v in options.views.split(",")], list[tuple[str, float, Array]]()
    for k in range(options.cells):
        scene, count, size = SCENES[k % 3], views[k // 3 % len(views)], SIZES[k // (3 * len(views)) % 3]
        xi, covariance = fitted_error(scene, options.seed + k, count, size)
        inside = np.abs(xi) < COVERAGE_FACTOR * np.sqrt(np.diag(covariance))
        square = float(xi @ np.linalg.solve(covariance, xi)) / 6
        rows += [(name, square, inside) for name in ("all", f"{count} views", f"ordinary {size:g}")]
    print(
        "| cells | fits | mean χ²/6 | beyond | largest | inside U | single axes |\n|---|---:|---:|---:|---:|---:|---|"
    )
    for name in dict.fromkeys(row[0] for row in rows):
        squares = np.array([square for of, square, _ in rows if of == name])
        axes = np.mean([inside for of, _, inside in rows if of == name], axis=0)
        print(
            f"| {name} | {len(squares)} | {squares.mean():.2f} | {np.sum(squares > _BEYOND)} | {squares.max():.1f} "
            f"| {axes.mean():.3f} | {axes.min():.3f} … {axes.max():.3f} |"
        )


if __name__ == "__main__":
    main()
