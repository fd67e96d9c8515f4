"""Cells of the benchmark of ordinary arms: scanned once, then what their views would show under errors of the poses."""

from dataclasses import dataclass, replace

import numpy as np
from blind_cells import scene_of

from data_synth import kinematics
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import plan_for
from data_synth.moment import Plan
from data_synth.ordinary_arm import coupled, draw_arm, with_memory
from data_synth.scene import load_scene
from data_synth.simulate import on_rail, simulate
from stitch.fit.correct import COARSE_SAMPLES
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.observations.surfaces.hand_eye_fit import capture_repeatability
from stitch.observations.surfaces.matching import sample_points
from stitch.observations.surfaces.normal_equations import collect_overlaps, next_gate
from stitch.observations.surfaces.view_poses import UnconstrainedPoses, unconstrained_poses
from stitch.session.capture import part_size, prepare_capture
from stitch.session.measurement import Measurement, measurement_of, with_part_origin

SCATTER = np.repeat([20e-6, 0.02], 3)  # of the flange, rad and mm
# Poses of a session in which every stop is scanned so often.
SCANS_A_STOP = 3
# First distance between partners, as a share of the part: poses scatter by far less.
_GATE = 0.05


@dataclass(frozen=True)
class Cell:
    """One simulated session, its views freed about the true hand-eye."""

    scene: str
    seed: int
    plan: Plan
    rail: Array  # (V,)
    T_mount: Array  # (4, 4) true
    measurement: Measurement
    freed: UnconstrainedPoses
    noise_factor: float

    @property
    def flange(self) -> Array:
        """(V, 4, 4) reported."""
        return on_rail(kinematics.flange(self.plan.arm, self.plan.joints), self.rail)

    @property
    def stops(self) -> Array:
        """(V,) number of the stop at which each view was taken."""
        return np.unique(self.plan.joints.round(6), axis=0, return_inverse=True)[1].ravel()


def cell_of(name: str, seed: int, scans_a_stop: int = 1) -> Cell:
    """Simulate a session with nothing wrong but scatter, and free its views about the true hand-eye; of fewer stops
    where each is scanned several times."""
    plan, rail = plan_for(load_scene(name), seed)
    if scans_a_stop > 1:
        again = np.repeat(np.arange(len(rail) // scans_a_stop + 2), scans_a_stop)
        of_views = {key: getattr(plan, key)[again] for key in ("joints", "torque", "velocity")}
        plan, rail = replace(plan, **of_views), rail[again]
    measured = simulate(scene_of(name), {}, seed, planned=(plan, rail))
    session, T_mount = session_of(measured), measured.T_mount
    measurement = with_part_origin(measurement_of(session, prepare_capture(session)), T_mount)
    own = measurement.capture
    poses = own.poses(T_mount)
    begun = collect_overlaps(
        own, poses, _GATE * part_size([own]), [sample_points(scan, COARSE_SAMPLES) for scan in own.scans]
    )
    freed = unconstrained_poses(own, poses, next_gate(begun, own))
    noise_factor = capture_repeatability(own, freed, T_mount).noise_factor
    return Cell(name, seed, plan, rail, T_mount, measurement, freed, noise_factor)


def erring(cell: Cell, kind: str, size: float, rng: np.random.Generator) -> Array:
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


def seen(cell: Cell, T_base_flange: Array, rng: np.random.Generator) -> UnconstrainedPoses:
    """What the overlaps would show of these poses, with the noise that their normal equations give."""
    g = cell.freed.overlaps.gram
    left = frames.inverse(T_base_flange) if cell.measurement.eye_to_hand else T_base_flange
    to_centre = frames.make(np.eye(3), -g.centre)
    model = cell.measurement.capture.poses(cell.T_mount)
    twists = frames.log(to_centre @ left @ cell.T_mount @ frames.inverse(to_centre @ model))
    visible = g.visible
    noise = np.sqrt(cell.noise_factor * g.variance / visible.values) * rng.standard_normal(len(visible.values))
    # The common motion is what no overlap shows.
    return replace(
        cell.freed, twists=twists - twists.mean(axis=0) + (visible.scale * (visible.vectors @ noise)).reshape(-1, 6)
    )
