"""Cells that are scanned once: what their views would show in other worlds is then drawn, as clouds would show it.

True poses and points follow data_synth's own laws, the noise is that of the normal equations.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from data_synth import kinematics
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import plan_for
from data_synth.moment import Moment, Plan
from data_synth.nature import Nature
from data_synth.ordinary_arm import OrdinaryArm
from data_synth.scanner import Cloud
from data_synth.scene import Scene, load_scene
from data_synth.simulate import Measured, moments_of, on_rail, simulate
from stitch.diagnosis.candidates import Candidate, candidates_of
from stitch.fit.correct import COARSE_SAMPLES
from stitch.model.model import Model
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.reml import fit_variances
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.hand_eye_fit import capture_repeatability
from stitch.observations.surfaces.matching import Match, sample_points
from stitch.observations.surfaces.normal_equations import collect_overlaps, gram, next_gate, robust_scale
from stitch.observations.surfaces.surface_model import SurfaceObservation, surface_model
from stitch.observations.surfaces.view_poses import UnconstrainedPoses, unconstrained_poses, visible_step
from stitch.run_data import RunData
from stitch.session.capture import part_size, prepare_capture
from stitch.session.measurement import Measurement, measurement_of, with_part_origin

SCENES = ("blade", "drill-plate", "blade-table")
_PIXELS = {"blade": 110, "blade-table": 110, "drill-plate": 80, "spheres": 80}
SCATTER = np.repeat([20e-6, 0.02], 3)  # of the flange, rad and mm
# First distance between partners, as a share of the part: poses scatter by far less.
GATE = 0.05
# Weights follow the distances; after these steps both stand still.
_STEPS = 8


@dataclass(frozen=True)
class LinearCell:
    """One simulated session, its views freed about the true hand-eye."""

    name: str  # of the scene
    seed: int
    plan: Plan
    rail: Array  # (V,)
    T_mount: Array  # (4, 4) true
    measurement: Measurement
    views: UnconstrainedPoses
    noise_factor: float
    # What is asked of it; the same for every draw, but for the numbers that are seen.
    scene: Scene
    moments: list[Moment]
    linear: LinearModel
    candidates: list[Candidate]


@dataclass(frozen=True)
class World:
    """What is true in one draw of a cell."""

    laws: Nature
    arm: OrdinaryArm | None = None
    joint_errors: Array | float = 0.0  # (V, n) rad
    flange_errors: Array | float = 0.0  # (V, 6) rad, mm, in the flange's frame
    scatter: Array | float = 1.0  # (V, 6) in units of 20 µm and 20 µrad; 1.0: independent from view to view


def scene_of(name: str) -> Scene:
    """Return a scene with small clouds: evidence counts in views, a few thousand points show what millions would."""
    scene = load_scene(name)
    return replace(scene, scanner=replace(scene.scanner, columns=_PIXELS[name], rows=_PIXELS[name]))


def hand_eye_chi_square(measured: Measured, state: RunData) -> float:
    """Return the error of the hand-eye against its covariance; 6 on the average where that is right."""
    xi = frames.log(frames.inverse(state.T_mount) @ measured.T_mount)
    return float(xi @ np.linalg.solve(state.mount_covariance, xi))


@lru_cache(maxsize=16)
def linear_cell(name: str, seed: int) -> LinearCell:
    """Simulate a session with nothing wrong but scatter, free its views, linearise about the true hand-eye."""
    plan, rail = plan_for(load_scene(name), seed)
    scene = scene_of(name)
    measured = simulate(scene, {}, seed, planned=(plan, rail))
    session, T_mount = session_of(measured), measured.T_mount
    measurement = with_part_origin(measurement_of(session, prepare_capture(session)), T_mount)
    capture = measurement.capture
    poses = capture.poses(T_mount)
    samples = [sample_points(scan, COARSE_SAMPLES) for scan in capture.scans]
    coarse = collect_overlaps(capture, poses, GATE * part_size([capture]), samples)
    views = unconstrained_poses(capture, poses, next_gate(coarse, capture))
    noise_factor = capture_repeatability(capture, views, T_mount).noise_factor
    linear = surface_model(measurement, Model(T_mount), capture, views)
    moments = moments_of(scene, plan, measurement.views.time, measurement.views.covariates)
    candidates = candidates_of(linear)[0]
    made = (name, seed, plan, rail, T_mount, measurement, views, noise_factor)
    return LinearCell(*made, scene=scene, moments=moments, linear=linear, candidates=candidates)


def shown(cell: LinearCell, T_reference_scanner: Array, rng: np.random.Generator) -> UnconstrainedPoses:
    """Return what the overlaps would show of true poses (V, 4, 4), with the noise of their normal equations."""
    g = cell.views.overlaps.gram
    to_centre = frames.make(np.eye(3), -g.centre)
    model = cell.measurement.capture.poses(cell.T_mount)
    twists = frames.log(to_centre @ T_reference_scanner @ frames.inverse(to_centre @ model))
    visible = g.visible
    noise = np.sqrt(cell.noise_factor * g.variance / visible.values) * rng.standard_normal(len(visible.values))
    # The common motion is what no overlap shows.
    twists = twists - twists.mean(axis=0) + (visible.scale * (visible.vectors @ noise)).reshape(-1, 6)
    return replace(cell.views, twists=twists)


def seen(cell: LinearCell, world: World, rng: np.random.Generator) -> LinearModel:
    """Return the linear model of what the overlaps would show of this world."""
    views = shown(cell, true_poses(cell, world, rng), rng)
    views = with_moved_points(views, cell.measurement, cell.scene, world.laws, cell.moments)
    assert isinstance(cell.linear.observation, SurfaceObservation)
    reduced = cell.linear.observation.reduced_poses
    z = reduced.reduction @ views.twists.ravel()
    mixed = replace(cell.linear.mixed, z=z[None])
    observation = replace(cell.linear.observation, reduced_poses=replace(reduced, z=z), unconstrained=views)
    return replace(cell.linear, observation=observation, mixed=mixed, null=fit_variances(mixed, both_starts=True))


def with_overlaps_of(cell: LinearCell, world: World, linear: LinearModel) -> LinearModel:
    """Return the model with the same twists, but overlaps in which only the laws of this world have moved points."""
    assert isinstance(linear.observation, SurfaceObservation)
    moved = with_moved_points(cell.views, cell.measurement, cell.scene, world.laws, cell.moments)
    views = replace(linear.observation.unconstrained, overlaps=moved.overlaps)
    return replace(linear, observation=replace(linear.observation, unconstrained=views))


def true_poses(cell: LinearCell, world: World, rng: np.random.Generator) -> Array:
    """Return (V, 4, 4) of the scanner where the part is held to stand still, reference frame."""
    laws, T_reference_part = world.laws, cell.scene.T_reference_part
    views = len(cell.moments)
    scatter = world.scatter * rng.standard_normal((views, 6)) if isinstance(world.scatter, float) else world.scatter
    off = frames.exp(scatter * SCATTER + world.flange_errors)
    joint_errors = np.broadcast_to(world.joint_errors, cell.plan.joints.shape)
    out = []
    for v, moment in enumerate(cell.moments):
        q = laws.act("joints", moment, moment.joints) + joint_errors[v]
        arm = laws.act("arm", moment, moment.arm)
        T = kinematics.flange(arm, q) if world.arm is None else world.arm.flange(arm, q[None])[0]
        T = on_rail(laws.act("base", moment, T), cell.rail[v]) @ off[v]
        mount = laws.act("mount", moment, cell.T_mount)
        moved = T_reference_part @ frames.inverse(laws.act("part", moment, T_reference_part))
        out.append(moved @ (frames.inverse(T) if cell.measurement.eye_to_hand else T) @ mount)
    return np.array(out)


def true_column(cell: LinearCell, world: World) -> Array:
    """Return (6V,) twists of the views that the law alone makes."""
    still = np.random.default_rng(0)
    bare = replace(world, joint_errors=0.0, flange_errors=0.0, scatter=np.zeros((len(cell.moments), 6)))
    with_law = true_poses(cell, replace(world, scatter=bare.scatter), still)
    without = true_poses(cell, bare, still)
    to_centre = frames.make(np.eye(3), -cell.views.overlaps.gram.centre)
    return frames.log(to_centre @ with_law @ frames.inverse(to_centre @ without)).ravel()


def with_moved_points(
    views: UnconstrainedPoses, measurement: Measurement, scene: Scene, laws: Nature, moments: list[Moment]
) -> UnconstrainedPoses:
    """Return views that were freed with the points as they are, freed anew after the laws have moved the points.

    The pairs stay: laws of the sizes that are asked move points by less than the noise.
    """
    if not any(map(laws.touches, ("points", "surface"))):
        return views
    moved = [
        frames.rotate(T, _moved(v, views, measurement, scene, laws, moments[v])) for v, T in enumerate(views.poses)
    ]
    matches = [_with(m, moved[m.v][m.index_v] - moved[m.w][m.index_w]) for m in views.overlaps.matches]
    g, twists = views.overlaps.gram, views.twists
    g = gram(matches, g.views, g.centre, robust_scale(matches))
    for _ in range(_STEPS):
        step = visible_step(g)
        twists = twists + step
        matches = [_with(m, _carried(m, step, g.centre)) for m in matches]
        g = gram(matches, g.views, g.centre, robust_scale(matches))
    return replace(views, twists=twists, overlaps=replace(views.overlaps, matches=matches, gram=g))


def _with(m: Match, further: Array) -> Match:
    """The correspondences with points of the first view further (M, 3) from those of the second."""
    return replace(m, residual=m.residual + np.einsum("ij,ij->i", further, m.normal))


def _carried(m: Match, twists: Array, centre: Array) -> Array:
    """(M, 3) how far twists (V, 6) about a centre carry the first view from the second."""
    turn, shift = np.split(twists[m.v] - twists[m.w], 2)
    return np.cross(turn, m.middle - centre) + shift


def _moved(
    v: int, views: UnconstrainedPoses, measurement: Measurement, scene: Scene, laws: Nature, moment: Moment
) -> Array:
    """(N, 3) how far the laws move the points of view v, scanner frame; 0 for points without a partner."""
    scan, view = measurement.capture.scans[v], measurement.scan_views[v]
    partners = [m.index_v if m.v == v else m.index_w for m in views.overlaps.matches if v in (m.v, m.w)]
    at = np.unique(np.concatenate([np.zeros(0, np.int64), *partners]))
    points, out = scan.points[at], np.zeros_like(scan.points)
    T = frames.inverse(scene.T_reference_part) @ views.poses[v]
    on_part = laws.act("surface", moment, frames.transform(T, points))
    bright = np.full(len(at), 0.5) if view.intensity is None else 0.5 + 0.18 * view.intensity[at]
    cloud = Cloud(frames.transform(frames.inverse(T), on_part), bright, view.cosine[at])
    out[at] = laws.act("points", moment, cloud).points - points
    return out
