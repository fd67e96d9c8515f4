"""A cell: a scanner that stands still and a part on the flange (or the reverse), and its views."""

from dataclasses import dataclass, field

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from data_synth.scanner import AreaScanner, scan
from stitch import frames

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Cell:
    """Lengths in mm, angles in rad. The repeatability is a twist of the flange, new for every view."""

    mount: str = "eye_to_hand"
    scanner: AreaScanner = field(default_factory=AreaScanner)
    repeatability_rotation: float = 20e-6
    repeatability_translation: float = 0.02
    tilt_deg: float = 30.0  # largest tilt of the turning axis between views
    turn_deg: float = 20.0  # of the last joint from view to view


@dataclass(frozen=True)
class Measured:
    """What the cell measured and the truth behind it."""

    clouds: list[Array]  # (N, 3) scanner frame
    T_base_flange: Array  # (V, 4, 4) reported
    T_mount: Array  # (4, 4) true hand-eye
    T_reference_scanner: Array  # (V, 4, 4) true


def measure(mesh: trimesh.Trimesh, cell: Cell, views: int, seed: int) -> Measured:
    """Turn the part in front of the scanner, tilting it, and scan it `views` times."""
    rng = np.random.default_rng(seed)
    T_scanner_part = _part_in_front(mesh, cell, views, rng)
    T_flange_part = frames.make(np.eye(3), np.array([0.0, 0.0, 60.0]))
    T_mount = _hand_eye(cell, rng)
    if cell.mount == "eye_to_hand":
        T_base_flange = T_mount @ T_scanner_part @ frames.inverse(T_flange_part)
    else:
        T_base_part = frames.make(Rotation.from_euler("z", 30, degrees=True).as_matrix(), np.array([700.0, 50, 200]))
        T_base_flange = T_base_part @ frames.inverse(T_scanner_part) @ frames.inverse(T_mount)
    sigma = np.array([cell.repeatability_rotation] * 3 + [cell.repeatability_translation] * 3)
    true_flange = T_base_flange @ frames.exp(rng.standard_normal((views, 6)) * sigma)
    if cell.mount == "eye_to_hand":
        reference = frames.inverse(true_flange) @ T_mount
        T_part_scanner = frames.inverse(T_flange_part) @ reference
    else:
        reference = true_flange @ T_mount
        T_part_scanner = frames.inverse(T_base_part) @ reference
    clouds = [scan(mesh, T, cell.scanner, rng) for T in T_part_scanner]
    return Measured(clouds, T_base_flange, T_mount, reference)


def _part_in_front(mesh: trimesh.Trimesh, cell: Cell, views: int, rng: np.random.Generator) -> Array:
    """T_scanner_part (V, 4, 4): part's middle at the standoff, its z across the view, turning and tilting."""
    turn = np.arange(views) * np.radians(cell.turn_deg) + rng.uniform(0, 0.05, views)
    tilt = np.radians(cell.tilt_deg) * rng.uniform(-1, 1, (views, 2))
    lying = Rotation.from_euler("x", -90, degrees=True)
    R = (Rotation.from_euler("xz", tilt) * lying * Rotation.from_euler("z", turn[:, None])).as_matrix()
    middle = mesh.bounds.mean(axis=0)
    aim = np.array([0.0, 0.0, cell.scanner.standoff]) + rng.uniform(-8, 8, (views, 3))
    return frames.make(R, aim - R @ middle)


def _hand_eye(cell: Cell, rng: np.random.Generator) -> Array:
    if cell.mount == "eye_to_hand":
        return frames.make(
            Rotation.from_euler("zyx", [40, 100, 15], degrees=True).as_matrix(), np.array([650.0, -150, 900])
        )
    return frames.make(Rotation.from_euler("zyx", [25, -4, 3], degrees=True).as_matrix(), np.array([45.0, -20, 95]))
