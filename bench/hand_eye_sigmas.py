"""Does the hand-eye's sigma hold? χ² of the hand-eye against the truth; χ²/6 is 1 on the average where sigmas are
right.

ORDINARY_ARMS: arms that are a little wrong everywhere. Cells are simulated and run once each; what their views show
under other errors of the poses is then drawn. Each cell counts with its mean over draws; medians are put over the
median of χ²(6)/6. `--set alone=true` fits as if poses scattered independently. Used up: 700 to 753.

FEW_VIEWS: whole fits from a coarse hand-eye. Every cell has views, clouds and an arm of its own; seeds take scenes,
views and kinds of arm in turn. The scans are those of an arm without errors, and the reported poses those of one that
has them, which is the same to first order. Used up: 7000, 7100, 9000 to 9026, 31000 to 31044, 31100 to 31123, 40000 to
40399.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from bench.drawn_cells import GATE, SCATTER, SCENES, Cell, cell_of, scene_of, shown
from bench.harness import Row, Table, grouped, markdown
from data_synth import kinematics
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import plan_for
from data_synth.ordinary_arm import coupled, draw_arm, with_memory
from data_synth.scene import load_scene
from data_synth.simulate import on_rail, simulate
from stitch.fit.correct import correct
from stitch.model.model import COVERAGE_FACTOR, Model
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.observations.pose_errors import PoseErrors, prior_pose_errors
from stitch.observations.surfaces.hand_eye_fit import fit_hand_eye
from stitch.observations.surfaces.scanner_errors import rig_scanner_errors
from stitch.observations.surfaces.view_poses import UnconstrainedPoses
from stitch.session.capture import part_size, prepare_capture
from stitch.session.measurement import measurement_of

KINDS = (
    *(("clean", 0.0), ("ordinary arm", 0.1), ("ordinary arm", 0.3), ("ordinary arm", 1.0), ("ordinary arm", 2.0)),
    *(("memory", 0.5), ("memory", 0.9), ("stops", 1.0), ("coupling", 1.5e-4), ("coupling", 6e-4)),
    *(("joints scatter", 1.5e-5), ("joints scatter", 6e-5)),
)
# Scans of every stop, in the kind of that name.
SCANS_A_STOP = 3
VIEWS = (4, 5, 6, 7, 8)
SIZES = (0.0, 0.5, 1.0)  # of an ordinary arm; 0: nothing but scatter and the quiet effects that every cell has
_MEDIAN, _BEYOND = 0.891, 2.8  # of χ²(6)/6: its median, its 1 % point
_NORMAL = 1.96  # 95 % of a normal number


def arm_jobs(seeds: range, draws: int, alone: bool) -> Iterator[Row]:
    """Every kind of arm in every cell."""
    for kind, size in KINDS:
        for scene in SCENES:
            for seed in seeds:
                yield {"kind": kind, "size": size, "scene": scene, "seed": seed, "draws": draws, "alone": alone}


def arm_trial(job: Row) -> Row:
    """χ²/6 of the hand-eye of every draw, and the share of its six numbers within their 95 %."""
    kind, size = job["kind"], job["size"]
    cell = cell_of(job["scene"], job["seed"], SCANS_A_STOP if kind == "stops" else 1)
    measurement, T = cell.measurement, cell.T_mount
    centre = cell.views.overlaps.gram.centre
    errors = None if job["alone"] else prior_pose_errors([measurement], Model(T), [centre])
    squares, inside = [], []
    for draw in range(job["draws"]):
        rng = np.random.default_rng([cell.seed, draw, round(size * 1e6), len(kind)])
        flange = _erring(cell, kind, size, rng)
        views = shown(cell, (frames.inverse(flange) if measurement.eye_to_hand else flange) @ T, rng)
        fit = fit_hand_eye([measurement.capture], [views], T, errors=errors)
        xi = frames.log(frames.inverse(fit.T_mount) @ T)
        squares.append(float(xi @ np.linalg.solve(fit.covariance, xi)) / 6)
        inside.append(float(np.mean(np.abs(xi) < _NORMAL * np.sqrt(np.diag(fit.covariance)))))
    return {"squares": squares, "inside": inside}


def _erring(cell: Cell, kind: str, size: float, rng: np.random.Generator) -> Array:
    """(V, 4, 4) true flange poses: the arm of a kind at a size, and scatter of 20 µm and 20 µrad in any case."""
    T, views = cell.flange, len(cell.rail)
    scatter = rng.standard_normal((views, 6))
    if kind == "ordinary arm":
        T = on_rail(draw_arm(cell.plan.arm.joints, size, rng).flange(cell.plan.arm, cell.plan.joints), cell.rail)
    elif kind == "coupling":
        T = on_rail(coupled(cell.plan, size, rng), cell.rail)
    elif kind == "joints scatter":
        off = size * rng.standard_normal(cell.plan.joints.shape)
        T = on_rail(kinematics.flange(cell.plan.arm, cell.plan.joints + off), cell.rail)
        scatter = 0.5 * scatter
    elif kind == "memory":
        # Twice as large: 40 µm, as was seen to mislead.
        scatter = 2 * with_memory(views, size, rng)
    elif kind == "stops":
        # What an arm does at a stop it does in all of its scans; a quarter is the scan's own.
        scatter = size * (rng.standard_normal((views, 6))[cell.stops] + 0.25 * scatter)
    return T @ frames.exp(scatter * SCATTER)


def arm_summary(rows: list[Row]) -> list[str]:
    """A line a kind of arm."""
    lines = []
    for (kind, size), group in grouped(rows, "kind", "size").items():
        squares = [square for row in group for square in row["squares"]]
        means = [np.mean(row["squares"]) for row in group]
        inside = np.mean([share for row in group for share in row["inside"]])
        figures = [f"{np.mean(squares):.2f}", f"{np.median(squares) / _MEDIAN:.2f}", f"{inside:.3f}"]
        lines.append([f"{kind} {size:g}", len(squares), *figures, f"{min(means):.2f} … {max(means):.2f}"])
    return markdown("arm | fits | mean χ²/6 | median | inside 95 % | cells", lines)


ORDINARY_ARMS = Table(arm_jobs, arm_trial, arm_summary, range(2), settings={"draws": 10, "alone": False})


def few_jobs(seeds: range) -> Iterator[Row]:
    """A cell a seed."""
    for k, seed in enumerate(seeds):
        size = SIZES[k // (3 * len(VIEWS)) % 3]
        yield {"seed": seed, "scene": SCENES[k % 3], "views": VIEWS[k // 3 % len(VIEWS)], "arm": size}


def few_trial(job: Row) -> Row:
    """χ²/6 of the hand-eye of a whole fit, and its six errors over their U."""
    scene, seed, size = job["scene"], job["seed"], job["arm"]
    plan, rail = plan_for(load_scene(scene), seed, job["views"])
    measured = simulate(scene_of(scene), {}, seed, planned=(plan, rail))
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
