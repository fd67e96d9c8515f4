"""Few views: does the hand-eye's sigma hold, and what is said where one view is off?

FEW_VIEWS: χ² of the hand-eye against the truth; χ²/6 is 1 on the average where sigmas are right. Whole fits from a
coarse hand-eye. Every cell has views, clouds and an arm of its own; seeds take scenes, views and kinds of arm in turn.
The scans are those of an arm without errors, and the reported poses those of one that has them, which is the same to
first order. Used up: 7000, 7100, 9000 to 9026, 31000 to 31044, 31100 to 31123, 40000 to 40399.

FEW_SESSIONS: three to six views on ordinary arms of three sizes, whole runs from what a session states; the same with
one reported pose shifted by 0.4 and 1 mm in a direction drawn at random. Beside it the test of somebody who knows how
this arm scatters: the largest of the χ² of single views, at a chance of one in a hundred. Arms are drawn by
`data_synth`. Development: 8000 to 8059. Used up: 8100 to 8159.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from bench.harness import Row, Table, grouped, markdown, share, with_all
from bench.small_cells import hand_eye_chi_square
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import SMALL_SCENES, plan_for, small_scene
from data_synth.moment import Plan
from data_synth.ordinary_arm import draw_arm
from data_synth.scene import load_scene
from data_synth.simulate import Measured, on_rail, simulate
from stitch.api.pipeline import run
from stitch.errors import NoResultError, StitchError
from stitch.fit.correct import correct
from stitch.model.model import COVERAGE_FACTOR, Model
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.observations.pose_errors import PoseErrors, prior_pose_errors
from stitch.observations.surfaces.scanner_errors import rig_scanner_errors
from stitch.observations.surfaces.view_poses import UnconstrainedPoses, unconstrained_poses
from stitch.run_data import RunData
from stitch.screening.view_model import ViewModel, view_model
from stitch.session.capture import part_size, prepare_capture
from stitch.session.measurement import measurement_of

# First distance between partners, as a share of the part: poses scatter by far less.
GATE = 0.05
# Views, and sizes of an ordinary arm; 0: nothing but scatter and the quiet effects that every cell has.
FEW, ARMS = (4, 5, 6, 7, 8), (0.0, 0.5, 1.0)
_BEYOND = 2.8  # of χ²(6)/6: its 1 % point
VIEWS, SIZES, OFF_BY = (3, 4, 5, 6), (0.3, 0.6, 1.0), (0.0, 0.4, 1.0)
_ARMS, _DRAWS, _LEVEL = 300, 2000, 0.01
# Neighbouring distances share points: the variance of the overlaps' noise over that of independent ones.
_NOISE_FACTOR = 3.0


def ordinary_cell(scene: str, seed: int, views: int, size: float) -> tuple[Measured, Array, Plan, Array]:
    """Return what was measured, poses (V, 4, 4) of an ordinary arm, the plan, and the rail's places (V,)."""
    plan, rail = plan_for(load_scene(scene), seed, views)
    measured = simulate(small_scene(scene), {}, seed, planned=(plan, rail))
    arm = draw_arm(plan.arm.joints, size, np.random.default_rng([seed, 77]))
    return measured, on_rail(arm.flange(plan.arm, plan.joints), rail), plan, rail


def few_jobs(seeds: range) -> Iterator[Row]:
    """A cell a seed."""
    for k, seed in enumerate(seeds):
        size = ARMS[k // (3 * len(FEW)) % 3]
        yield {"seed": seed, "scene": SMALL_SCENES[k % 3], "views": FEW[k // 3 % len(FEW)], "arm": size}


def few_trial(job: Row) -> Row:
    """χ²/6 of the hand-eye of a whole fit, and its six errors over their U."""
    scene, seed, size = job["scene"], job["seed"], job["arm"]
    measured, true, _, _ = ordinary_cell(scene, seed, job["views"], size)
    # Without an arm's errors the poses are those that scatter.
    measured = replace(measured, T_base_flange=true) if size else measured
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


def session_jobs(seeds: range) -> Iterator[Row]:
    """A cell a seed: scenes, numbers of views and sizes of the arm in turn."""
    for seed in seeds:
        k = seed - seeds.start
        yield {"seed": seed, "scene": SMALL_SCENES[k % 3], "views": VIEWS[k // 3 % 4], "arm": SIZES[k // 12 % 3]}


def session_trial(job: Row) -> Row:
    """What is said of the good session and of the two with one view off, and what the knowing test says."""
    seed = job["seed"]
    rng = np.random.default_rng([seed, 5])
    measured, true, plan, rail = ordinary_cell(job["scene"], seed, job["views"], job["arm"])
    v = int(rng.integers(job["views"]))
    direction = rng.standard_normal(3)
    direction /= np.linalg.norm(direction)
    knowing = None
    out: Row = {"off": v}
    for by in OFF_BY:
        reported = np.array(true)
        reported[v] = reported[v] @ frames.make(np.eye(3), by * direction)
        row, state = _said(replace(measured, T_base_flange=reported), v)
        if not by and state is not None and not state.left_out:
            row["chi2"] = hand_eye_chi_square(measured, state) / 6
            knowing = _KnowingTest(measured, state, plan, rail, job["arm"], rng)
        if knowing is not None:
            row["knowing"] = knowing.says(reported)
        out[f"{by:g} mm"] = row
    return out


def _said(measured: Measured, v: int) -> tuple[Row, RunData | None]:
    session = session_of(measured)
    try:
        state = run(session)
    except StitchError as error:
        return {"refused": str(error), "little": False, "doubted": False, "named": False}, None
    doubts = [doubt for doubt in state.doubts if "contradict their scans" in doubt]
    told = [*(item.view for item in state.left_out), *(n for n in state.notes if session.names[v] in n and " off" in n)]
    return {
        "refused": None,
        "little": any("overlap too little" in doubt for doubt in state.doubts),
        "doubted": bool(doubts or told),
        "named": any(session.names[v] in text for text in [*doubts, *told]),
    }, state


class _KnowingTest:
    """χ² of single views under the scatter that this arm, of this size, has."""

    def __init__(
        self, measured: Measured, state: RunData, plan: Plan, rail: Array, size: float, rng: np.random.Generator
    ) -> None:
        """Draw arms of this size, and the threshold."""
        self.state, self.capture = state, state.measurement.capture
        model = self._model(self.capture.T_base_flange)
        assert model is not None
        nominal = on_rail(draw_arm(plan.arm.joints, 0.0, rng).flange(plan.arm, plan.joints), rail)
        arms = [draw_arm(plan.arm.joints, size, rng).flange(plan.arm, plan.joints) for _ in range(_ARMS)]
        columns = np.column_stack([self._twists(nominal, on_rail(T, rail), model.centre) for T in arms])
        turned, moved = measured.scene.repeatability
        scatter = turned**2 * model.reduced.rotation + moved**2 * model.reduced.translation
        of_arms = model.reduced.reduction @ columns
        self.C = of_arms @ of_arms.T / _ARMS + scatter + _NOISE_FACTOR * model.reduced.noise
        drawn = np.linalg.cholesky(self.C) @ rng.standard_normal((len(self.C), _DRAWS))
        self.limit = float(np.quantile([self._largest(model, z) for z in drawn.T], 1 - _LEVEL))

    def says(self, reported: Array) -> bool | None:
        """Whether a view stands out; None where the views come to overlap otherwise."""
        model = self._model(reported)
        if model is None or len(model.z) != len(self.C):
            return None
        return self._largest(model, model.z) > self.limit

    def _model(self, T_base_flange: Array) -> ViewModel | None:
        capture = replace(
            self.capture,
            T_reference_mount=T_base_flange if self.capture.scanner_rides else frames.inverse(T_base_flange),
            T_reference_flange=T_base_flange if self.capture.scanner_rides else self.capture.T_reference_flange,
        )
        try:
            views = unconstrained_poses(capture, capture.poses(self.state.T_mount), 4 * capture.spacing)
        except NoResultError:
            return None
        return view_model(capture, self.state.T_mount, views)

    def _twists(self, nominal: Array, true: Array, centre: Array) -> Array:
        """(6V,) of the views by which an arm errs."""
        if not self.capture.scanner_rides:
            nominal, true = frames.inverse(nominal), frames.inverse(true)
        to_centre = frames.make(np.eye(3), -centre)
        return frames.log(to_centre @ true @ frames.inverse(to_centre @ nominal)).ravel()

    def _largest(self, model: ViewModel, z: Array) -> float:
        """The largest χ² of a single view's displacement, the hand-eye free."""
        A = model.mixed().A[0]
        inverse = np.linalg.inv(self.C)
        P = inverse - inverse @ A @ np.linalg.solve(A.T @ inverse @ A, A.T @ inverse)
        out = 0.0
        for columns in model.views:
            N = columns.T @ P @ columns
            u = columns.T @ (P @ z)
            out = max(out, float(u @ np.linalg.pinv(N, rcond=1e-6, hermitian=True) @ u))
        return out


def session_summary(rows: list[Row]) -> list[str]:
    """A line for each number of views and each displacement."""
    lines = []
    for views, group in with_all(grouped(rows, "views")).items():
        for by in OFF_BY:
            said = [row[f"{by:g} mm"] for row in group]
            asked = [row for row in said if row.get("knowing") is not None]
            lines.append(
                [
                    *(views, f"{by:g} mm", share(row["refused"] for row in said), share(row["little"] for row in said)),
                    *(share(row["doubted"] for row in said), share(row["named"] for row in said) if by else "–"),
                    *(share(row["doubted"] for row in asked), share(row["knowing"] for row in asked)),
                ]
            )
    squares = np.array([row["0 mm"]["chi2"] for row in rows if "chi2" in row["0 mm"]])
    head = "views | off | refused | too little overlap | doubted | by name | doubted, where asked | a test that knows"
    mean = f"{squares.mean():.2f} ± {1.96 * squares.std() / np.sqrt(len(squares)):.2f}"
    return [*markdown(head, lines), "", f"χ²/6 of the hand-eye of {len(squares)} good sessions: {mean} (95 %)."]


FEW_SESSIONS = Table(
    session_jobs, session_trial, session_summary, range(8100, 8160), page="integrity", block="few-sessions"
)
