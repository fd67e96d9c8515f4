"""Does the hand-eye's sigma hold? χ² of the hand-eye against the truth; χ²/6 is 1 on the average where sigmas are
right.

Whole fits from a coarse hand-eye. Every cell has views, clouds and an arm of its own; seeds take scenes,
views and kinds of arm in turn. The scans are those of an arm without errors, and the reported poses those of one that
has them, which is the same to first order. Used up: 7000, 7100, 9000 to 9026, 31000 to 31044, 31100 to 31123, 40000 to
40399.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from bench.harness import Row, Table, grouped, markdown
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import SMALL_SCENES, plan_for, small_scene
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

# First distance between partners, as a share of the part: poses scatter by far less.
GATE = 0.05
VIEWS = (4, 5, 6, 7, 8)
SIZES = (0.0, 0.5, 1.0)  # of an ordinary arm; 0: nothing but scatter and the quiet effects that every cell has
_BEYOND = 2.8  # of χ²(6)/6: its 1 % point


def few_jobs(seeds: range) -> Iterator[Row]:
    """A cell a seed."""
    for k, seed in enumerate(seeds):
        size = SIZES[k // (3 * len(VIEWS)) % 3]
        yield {"seed": seed, "scene": SMALL_SCENES[k % 3], "views": VIEWS[k // 3 % len(VIEWS)], "arm": size}


def few_trial(job: Row) -> Row:
    """χ²/6 of the hand-eye of a whole fit, and its six errors over their U."""
    scene, seed, size = job["scene"], job["seed"], job["arm"]
    plan, rail = plan_for(load_scene(scene), seed, job["views"])
    measured = simulate(small_scene(scene), {}, seed, planned=(plan, rail))
    if size:
        arm = draw_arm(plan.arm.joints, size, np.random.default_rng([seed, 77]))
        measured = replace(measured, T_base_flange=on_rail(arm.flange(plan.arm, plan.joints), rail))
    session = session_of(measured)
    measurement = measurement_of(session, prepare_capture(session))

    def errors(views: Sequence[UnconstrainedPoses], T_mount: Array) -> PoseErrors:
        return prior_pose_errors([measurement], Model(T_mount), [v.overlaps.gram.centre for v in views])

    capture = measurement.capture
    gate, scanner = GATE * part_size([capture]), partial(rig_scanner_errors, [measurement])
    fit = correct([capture], measured.T_coarse, gate, scanner_errors=scanner, pose_error_prior=errors).hand_eye
    xi = frames.log(frames.inverse(fit.T_mount) @ measured.T_mount)
    square = float(xi @ np.linalg.solve(fit.covariance, xi)) / 6
    return {"chi2": square, "of_U": (xi / (COVERAGE_FACTOR * np.sqrt(np.diag(fit.covariance)))).tolist()}


def few_summary(rows: list[Row]) -> list[str]:
    """A line for all cells, for every size of the arm and every number of views."""
    groups = {"all": rows}
    groups |= {f"ordinary {size:g}": group for size, group in sorted(grouped(rows, "arm").items())}
    groups |= {f"{views} views": group for views, group in sorted(grouped(rows, "views").items())}
    lines = []
    for name, group in groups.items():
        squares = np.array([row["chi2"] for row in group])
        axes = np.abs([row["of_U"] for row in group]) < 1
        each = axes.mean(axis=0)
        mean = f"{squares.mean():.2f} ± {1.96 * squares.std() / np.sqrt(len(squares)):.2f}"
        figures = [len(group), mean, np.sum(squares > _BEYOND), f"{squares.max():.1f}", f"{axes.mean():.3f}"]
        lines.append([name, *figures, f"{each.min():.3f} … {each.max():.3f}"])
    head = "cells | fits | mean χ²/6 (95 %) | beyond 2.8 | largest | inside U (k = 2) | single axes"
    return [f"{len(rows)} cells from seed {rows[0]['seed']} on:", "", *markdown(head, lines)]


FEW_VIEWS = Table(few_jobs, few_trial, few_summary, range(40_000, 40_400), page="method", block="few")
