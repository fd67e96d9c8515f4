"""One view as it happens: nature bends, warms and shifts, then the scanner measures."""

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from data_synth import kinematics
from data_synth.moment import Moment
from data_synth.nature import Nature
from data_synth.scanner import Cloud, half_field, profile_times
from data_synth.scanning import scan
from data_synth.scene import Scene
from stitch.numerics import frames

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Cell:
    """What is true of the cell before anything is measured."""

    scene: Scene
    mesh: trimesh.Trimesh  # part frame
    laws: Nature
    T_mount: Array  # (4, 4) true at the first view
    field_weights: Array  # (3, 3) of the scanner's smooth error
    targets: dict[str, Array]  # (3,) each, part frame


def take_view(cell: Cell, moment: Moment, rail: float, rng: np.random.Generator) -> tuple[Cloud, Array, Array]:
    """Take one view with the base at `rail` (mm).

    Returns:
        The cloud, T_reference_scanner (4, 4) where the scanner truly stood, and the labelled targets (L, 3) in its
        frame, NaN where not seen.
    """
    scene, laws = cell.scene, cell.laws
    sigma = np.array([scene.repeatability[0]] * 3 + [scene.repeatability[1]] * 3)
    scatter = frames.exp(rng.standard_normal(6) * sigma)
    arm = laws.act("arm", moment, moment.arm)
    mount = laws.act("mount", moment, cell.T_mount)
    T_reference_part = laws.act("part", moment, scene.T_reference_part)
    surface = cell.mesh
    if laws.touches("surface"):
        surface = trimesh.Trimesh(laws.act("surface", moment, surface.vertices), surface.faces, process=False)

    def scanner_at(q: Array) -> Array:
        on_base = laws.act("base", moment, kinematics.flange(arm, q))
        T = on_rail(on_base, np.full(q.shape[:-1], rail)) @ scatter
        return np.asarray((frames.inverse(T) if scene.mount == "eye_to_hand" else T) @ mount)

    q_true = laws.act("joints", moment, moment.joints)
    if scene.joint_repeatability:
        q_true = q_true + scene.joint_repeatability * rng.standard_normal(q_true.shape)
    T_reference_scanner = scanner_at(q_true)
    to_part = frames.inverse(T_reference_part)
    if scene.scanner.kind == "line":
        along = _sweep(scene, moment)
        poses = scanner_at(q_true + along)
        profiles = scan(surface, to_part @ poses, scene.scanner, cell.field_weights, rng)
        cloud = _assemble(cell, moment, along, laws.act("points", moment, profiles))
    else:
        poses = scanner_at(q_true + _sweep(scene, moment)) if scene.scanner.exposure else T_reference_scanner
        ideal = scan(surface, to_part @ poses, scene.scanner, cell.field_weights, rng)
        cloud = laws.act("points", moment, ideal)
    labelled = _labelled(cell, moment, frames.inverse(T_reference_scanner) @ T_reference_part, rng)
    return cloud, T_reference_scanner, labelled


def _labelled(cell: Cell, moment: Moment, T_scanner_part: Array, rng: np.random.Generator) -> Array:
    """(L, 3) targets as the scanner reports them, NaN outside its field."""
    if not cell.targets:
        return np.empty((0, 3))
    scene, laws = cell.scene, cell.laws
    seen = frames.transform(T_scanner_part, laws.act("surface", moment, np.array(list(cell.targets.values()))))
    ideal = Cloud(seen, np.full(len(seen), 0.5), np.ones(len(seen)))
    points = laws.act("points", moment, ideal).points + scene.part.sigma * rng.standard_normal(seen.shape)
    inside = (np.abs(seen[:, :2]) < half_field(scene.scanner) * seen[:, 2:]).all(axis=1)
    inside &= np.abs(seen[:, 2] - scene.scanner.standoff) < scene.scanner.depth_of_field / 2
    return np.where(inside[:, None], points, np.nan)


def _sweep(scene: Scene, moment: Moment) -> Array:
    """(K, n) joint angles of the rows less those of the view."""
    return np.asarray(profile_times(scene.scanner)[:, None] * moment.velocity)


def _assemble(cell: Cell, moment: Moment, along: Array, cloud: Cloud) -> Cloud:
    """Profiles carried into the view's scanner frame by the reported motion, as controllers of line scanners do."""
    assert cloud.time is not None
    scene = cell.scene

    def place(q: Array) -> Array:
        T = kinematics.flange(scene.arm, q)
        return np.asarray((frames.inverse(T) if scene.mount == "eye_to_hand" else T) @ cell.T_mount)

    T_view_profile = frames.inverse(place(moment.joints)) @ place(moment.joints + along)
    profiles = len(along)
    step = scene.scanner.sweep / profiles / scene.scanner.speed
    index = np.round(cloud.time / step + (profiles - 1) / 2).astype(int)
    points = np.einsum("nij,nj->ni", T_view_profile[index, :3, :3], cloud.points) + T_view_profile[index, :3, 3]
    return Cloud(points, cloud.intensity, cloud.incidence, cloud.time)


def on_rail(T: Array, rail: Array) -> Array:
    """Poses (..., 4, 4) with the base moved along x by the rail's positions (...,)."""
    T = np.array(T)
    T[..., 0, 3] += rail
    return T
