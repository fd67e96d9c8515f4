"""Cells of the benchmark of names: scanned once; what their views would show is drawn from data_synth's own laws."""

from dataclasses import dataclass, replace

import numpy as np
from blind_cells import scene_of
from drawn_overlaps import with_moved_points
from ordinary_cells import SCATTER, Cell, cell_of

from data_synth import kinematics, nature
from data_synth.moment import Moment
from data_synth.ordinary_arm import OrdinaryArm
from data_synth.scene import Scene
from data_synth.simulate import moments_of, on_rail
from stitch.diagnosis.candidates import Candidate, candidates_of
from stitch.model.model import Model
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.reml import fit_variances
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.surface_model import SurfaceObservation, surface_model
from stitch.observations.surfaces.view_poses import UnconstrainedPoses


@dataclass(frozen=True)
class World:
    """What is true in one draw of a cell."""

    laws: nature.Nature
    arm: OrdinaryArm | None = None
    joint_errors: Array | float = 0.0  # (V, n) rad
    flange_errors: Array | float = 0.0  # (V, 6) rad, mm, in the flange's frame
    scatter: Array | float = 1.0  # (V, 6) in units of 20 µm and 20 µrad; 1.0: independent from view to view


@dataclass(frozen=True)
class Asked:
    """A cell with what may be asked of it; the same for every draw, but for the numbers that are seen."""

    cell: Cell
    scene: Scene
    moments: list[Moment]
    linear: LinearModel
    candidates: list[Candidate]


def asked(name: str, seed: int, scans_a_stop: int = 1) -> Asked:
    """Simulate, run and linearise a cell."""
    return asked_of(cell_of(name, seed, scans_a_stop))


def asked_of(cell: Cell) -> Asked:
    """Linearise a cell about its true hand-eye."""
    scene, measurement, views = scene_of(cell.scene), cell.measurement, cell.measurement.views
    linear = surface_model(measurement, Model(cell.T_mount), measurement.capture, cell.freed)
    return Asked(
        cell, scene, moments_of(scene, cell.plan, views.time, views.covariates), linear, candidates_of(linear)[0]
    )


def seen(asked: Asked, world: World, rng: np.random.Generator) -> LinearModel:
    """What the overlaps would show of this world, with the noise that their normal equations give."""
    cell, freed = asked.cell, asked.cell.freed
    g = freed.overlaps.gram
    to_centre = frames.make(np.eye(3), -g.centre)
    model = cell.measurement.capture.poses(cell.T_mount)
    twists = frames.log(to_centre @ true_poses(asked, world, rng) @ frames.inverse(to_centre @ model))
    visible = g.visible
    noise = np.sqrt(cell.noise_factor * g.variance / visible.values) * rng.standard_normal(len(visible.values))
    twists = twists - twists.mean(axis=0) + (visible.scale * (visible.vectors @ noise)).reshape(-1, 6)
    freed = with_moved_points(replace(freed, twists=twists), cell.measurement, asked.scene, world.laws, asked.moments)
    return _with_freed(asked.linear, freed)


def with_overlaps_of(asked: Asked, world: World, linear: LinearModel) -> LinearModel:
    """The same twists, but overlaps in which only the laws of this world have moved points."""
    assert isinstance(linear.observation, SurfaceObservation)
    moved = with_moved_points(asked.cell.freed, asked.cell.measurement, asked.scene, world.laws, asked.moments)
    freed = replace(linear.observation.unconstrained, overlaps=moved.overlaps)
    return replace(linear, observation=replace(linear.observation, unconstrained=freed))


def _with_freed(linear: LinearModel, freed: UnconstrainedPoses) -> LinearModel:
    assert isinstance(linear.observation, SurfaceObservation)
    channel = linear.observation.reduced_poses
    z = channel.reduction @ freed.twists.ravel()
    mixed = replace(linear.mixed, z=z[None])
    observation = replace(linear.observation, reduced_poses=replace(channel, z=z), unconstrained=freed)
    return replace(linear, observation=observation, mixed=mixed, null=fit_variances(mixed, both_starts=True))


def true_poses(asked: Asked, world: World, rng: np.random.Generator) -> Array:
    """(V, 4, 4) of the scanner where the part is held to stand still, reference frame."""
    cell, scene, laws = asked.cell, asked.scene, world.laws
    views = len(asked.moments)
    scatter = world.scatter * rng.standard_normal((views, 6)) if isinstance(world.scatter, float) else world.scatter
    off = frames.exp(scatter * SCATTER + world.flange_errors)
    joint_errors = np.broadcast_to(world.joint_errors, cell.plan.joints.shape)
    out = []
    for v, moment in enumerate(asked.moments):
        q, arm = laws.act("joints", moment, moment.joints) + joint_errors[v], laws.act("arm", moment, moment.arm)
        T = kinematics.flange(arm, q) if world.arm is None else world.arm.flange(arm, q[None])[0]
        T = on_rail(T, cell.rail[v]) @ off[v]
        mount = laws.act("mount", moment, cell.T_mount)
        moved = scene.T_reference_part @ frames.inverse(laws.act("part", moment, scene.T_reference_part))
        out.append(moved @ (frames.inverse(T) if cell.measurement.eye_to_hand else T) @ mount)
    return np.array(out)


def true_column(a: Asked, world: World) -> Array:
    """(6V,) twists of the views that the law alone makes."""
    assert isinstance(a.linear.observation, SurfaceObservation)
    still = np.random.default_rng(0)
    bare = replace(world, joint_errors=0.0, flange_errors=0.0, scatter=np.zeros((len(a.moments), 6)))
    with_it, without = (true_poses(a, w, still) for w in (replace(world, scatter=bare.scatter), bare))
    to_centre = frames.make(np.eye(3), -a.linear.observation.unconstrained.overlaps.gram.centre)
    return np.asarray(frames.log(to_centre @ with_it @ frames.inverse(to_centre @ without)).ravel())
