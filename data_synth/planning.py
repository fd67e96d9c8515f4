"""Views that a real cell would take: the scanner looks at the part, the arm reaches there, something is seen."""

from dataclasses import replace

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from data_synth import kinematics
from data_synth.moment import Plan
from data_synth.scanner import Scanner, rays
from data_synth.scanning import cast
from data_synth.scene import Scene, ViewPlan
from stitch.errors import NoResultError
from stitch.numerics import frames

Array = NDArray[np.float64]
_ATTEMPTS = 40
_SOUGHT = 0.6  # rad, 1-sigma of every joint about home
_PROBE = 24  # rays per side for the line of sight


def plan_views(scene: Scene, mesh: trimesh.Trimesh, views: int, rng: np.random.Generator) -> tuple[Plan, Array]:
    """Joint angles of all views and the rail's positions (V,), in the order they are driven.

    Raises:
        NoResultError: a view that the arm cannot reach or that sees too little, after many tries.
    """
    q, rail, velocity = scene.arm.home, [], []
    joints: list[Array] = []
    for view in range(views):
        for _attempt in range(_ATTEMPTS):
            T_part_scanner = _pose(scene.plan, scene.scanner, mesh, view, rng)
            x = _station(scene, T_part_scanner)
            # A path is driven without a jump: only its first view may be sought from elsewhere.
            begin = q if joints or scene.plan.kind != "path" else q + _SOUGHT * rng.standard_normal(q.shape)
            found = kinematics.inverse(scene.arm, _flange(scene, T_part_scanner, x), begin)
            if found is not None and _sees(mesh, T_part_scanner, scene):
                break
        else:
            raise NoResultError(
                f"scene {scene.name}: view {view} cannot be reached within the joint limits, or sees less than "
                f"{scene.plan.minimum_seen:.0%} of the field, in {_ATTEMPTS} tries; move the part or lower plan.tilt"
            )
        velocity.append(_velocity(scene, found, rng))
        q = found
        joints.append(q)
        rail.append(x)
    angles = np.array(joints)
    if scene.plan.kind == "path":
        velocity = list(np.gradient(angles, 1 / scene.plan.rate, axis=0))
    torque = kinematics.gravity_torques(scene.arm, angles)
    return Plan(angles, torque, np.array(velocity), scene.arm, scene.useful), np.array(rail)


def _pose(plan: ViewPlan, scanner: Scanner, mesh: trimesh.Trimesh, view: int, rng: np.random.Generator) -> Array:
    """T_part_scanner of one view, drawn anew on every call."""
    tilt, roll, aim = (np.radians(plan.tilt), np.radians(plan.roll), plan.aim)
    distance = scanner.standoff * (1 + plan.distance * rng.uniform(-1, 1))
    middle = mesh.bounds.mean(axis=0)
    if plan.kind == "turntable":
        # The part's z lies across the view, along the image rows.
        lying = Rotation.from_euler("x", -90, degrees=True)
        turn = Rotation.from_rotvec([0, 0, np.radians(plan.turn) * view])
        R = (Rotation.from_euler("xz", rng.uniform(-tilt, tilt, 2)) * lying * turn).as_matrix()
        T_scanner_part = frames.make(R, np.array([*rng.uniform(-aim, aim, 2), distance]) - R @ middle)
        return np.asarray(frames.inverse(T_scanner_part))
    z = -np.array(plan.towards, float) / np.linalg.norm(plan.towards)
    y = -np.array(plan.up, float)
    y -= z * (y @ z)
    y /= np.linalg.norm(y)
    across = np.column_stack([np.cross(y, z), y, z])
    target = middle + across[:, :2] @ rng.uniform(-aim, aim, 2)
    if plan.kind == "raster":
        row, column = divmod(view, plan.columns)
        cell = np.array([column - (plan.columns - 1) / 2, row - (-(-plan.views // plan.columns) - 1) / 2])
        target = target + across[:, :2] @ (cell * plan.step)
    tilts = Rotation.from_euler("xyz", [*rng.uniform(-tilt, tilt, 2), rng.uniform(-roll, roll)])
    if plan.kind == "path":
        # Once around, swaying: smooth, with turns about every axis.
        phase = 2 * np.pi * view / plan.views
        target = middle + across[:, :2] @ (aim * np.array([np.sin(2 * phase), np.cos(3 * phase)]))
        distance = scanner.standoff * (1 + plan.distance * np.sin(2 * phase))
        tilts = Rotation.from_euler("xyz", [tilt * np.sin(phase), tilt * np.cos(phase), roll * np.sin(2 * phase)])
    R = across @ tilts.as_matrix()
    return frames.make(R, target - R[:, 2] * distance)


def _station(scene: Scene, T_part_scanner: Array) -> float:
    """Where on the rail the base stands: level with the scanner, in steps of a tenth of its length."""
    if not scene.rail:
        return 0.0
    x = (scene.T_reference_part @ T_part_scanner)[0, 3]
    step = scene.rail / 10
    return float(np.clip(np.round(x / step) * step, 0.0, scene.rail))


def _flange(scene: Scene, T_part_scanner: Array, rail: float) -> Array:
    """T_base_flange that brings the scanner there."""
    if scene.mount == "eye_to_hand":
        return scene.T_mount @ frames.inverse(scene.T_reference_part @ T_part_scanner)
    T = scene.T_reference_part @ T_part_scanner @ frames.inverse(scene.T_mount)
    return frames.make(T[:3, :3], T[:3, 3] - [rail, 0.0, 0.0])


def _sees(mesh: trimesh.Trimesh, T_part_scanner: Array, scene: Scene) -> bool:
    scanner = scene.scanner
    probe = rays(replace(scanner, columns=_PROBE, rows=_PROBE if scanner.kind == "area" else 1))
    _, distance, _ = cast(mesh, T_part_scanner, probe)
    inside = np.abs(distance - scanner.standoff) < scanner.depth_of_field / 2
    return float(inside.mean()) >= scene.plan.minimum_seen


def _velocity(scene: Scene, q: Array, rng: np.random.Generator) -> Array:
    """Joint velocities (n,) rad/s of a sweep along the scanner's y, either way; zero for area scanners."""
    if scene.scanner.kind != "line":
        return np.zeros(scene.arm.joints)
    along = scene.T_mount[:3, 1]
    if scene.mount == "eye_to_hand":
        # The scanner stands still: the part moves the other way.
        along = -kinematics.flange(scene.arm, q)[:3, :3].T @ along
    return kinematics.velocity(scene.arm, q, along * scene.scanner.speed * rng.choice([-1.0, 1.0]))
