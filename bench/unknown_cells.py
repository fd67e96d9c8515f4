"""Cells of the benchmark of names: scanned once; what their views would show is drawn from data_synth's own laws."""

from dataclasses import dataclass, replace

import numpy as np
from blind_cells import scene_of
from ordinary_cells import SCATTER, Cell, cell_of

from data_synth import kinematics, nature
from data_synth.moment import Moment
from data_synth.ordinary_arm import OrdinaryArm
from data_synth.scanner import Cloud
from data_synth.scene import Scene
from data_synth.simulate import moments_of, on_rail
from stitch import frames
from stitch.diagnosis.candidates import Candidate, candidates_of
from stitch.frames import Array, Indices
from stitch.model.model import Model
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.free_poses import visible_directions
from stitch.observations.surfaces.point_gram import seen_twists, streamed
from stitch.observations.surfaces.surface_model import Surfaces, surface_model
from stitch.statistics.variance_components import fit_variances


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
    values, vectors, scale = visible_directions(g)
    noise = np.sqrt(cell.noise_factor * g.variance / values) * rng.standard_normal(len(values))
    twists = twists - twists.mean(axis=0) + _of_points(asked, world) + (scale * (vectors @ noise)).reshape(-1, 6)
    return _with_twists(asked.linear, twists)


def white(linear: LinearModel) -> LinearModel:
    """As if poses scattered independently: what sizes are counted in."""
    mixed = replace(linear.mixed, components=linear.mixed.components[:3], scales=None)
    return replace(linear, mixed=mixed, null=fit_variances(mixed, both_starts=True), pose_errors=None)


def _with_twists(linear: LinearModel, twists: Array) -> LinearModel:
    assert isinstance(linear.observation, Surfaces)
    channel = linear.observation.channel
    z = channel.reduction @ twists.ravel()
    mixed = replace(linear.mixed, z=z[None])
    observation = replace(
        linear.observation, channel=replace(channel, z=z), freed=replace(linear.observation.freed, twists=twists)
    )
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


def _of_points(asked: Asked, world: World) -> Array:
    """(V, 6) twists of the views that the overlaps show where points are not where they were."""
    cell, freed = asked.cell, asked.cell.freed
    places = [place for place in ("points", "surface") if world.laws.touches(place)]
    if not places:
        return np.zeros((len(asked.moments), 6))

    def moved(v: int, index: Indices) -> Array:
        scan, seen = cell.measurement.capture.scans[v], cell.measurement.scan_views[v]
        points = scan.points[index]
        T = frames.inverse(asked.scene.T_reference_part) @ freed.poses[v]
        at_part = frames.transform(T, points)
        true = frames.transform(frames.inverse(T), world.laws.act("surface", asked.moments[v], at_part))
        bright = np.full(len(points), 0.5) if seen.intensity is None else 0.5 + 0.18 * seen.intensity[index]
        cloud = Cloud(true, bright, seen.cosine[index])
        return np.asarray(world.laws.act("points", asked.moments[v], cloud).points - points)[None]

    sums = streamed(freed, cell.measurement.capture.noise_factor, moved, lambda: np.zeros((1, 1, 1, 3)))
    return -np.asarray(seen_twists(sums, freed)).reshape(-1, 6)
