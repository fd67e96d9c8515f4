"""Cells of two scanners by kinematics of their own: two that stand before an arm with the blade, or two on its flange.

The arm is what its controller reports of the flange, with scatter. Two on one flange scan at the same stops, with the
same error of the arm. What one scanner does wrong is hidden in it alone: lengths along its rays, or a bowl.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from data_synth.cells.axis_cell import pose_of
from data_synth.scanner import Cloud, Scanner, field_map
from data_synth.scanning import scan
from data_synth.shapes import build_shape
from data_synth.write import cloud_file
from stitch.output import session_files
from stitch.output.session_files import SessionFiles, pose_columns

Array = NDArray[np.float64]
KINDS = ("stands", "rig")
NAMES = ("left", "right")
# What is hidden at amplitude 1: a share of the range, mm per ρ².
SIZES = {"range_scale": 5e-4, "field_curvature": 1.0}
_ARM_SCATTER = np.repeat([20e-6, 0.02], 3)
_SCANNER = Scanner(noise=0.02, standoff=420.0, depth_of_field=500.0, field_error=0.006)
# Of a scanner's scale, as data sheets have it.
_SCALE = 2e-4


@dataclass(frozen=True)
class ScannerCell:
    """What such a cell wrote down, and what is true of it; mm."""

    kind: str
    T_base_flange: Array  # (2, V, 4, 4) reported, of each scanner's views
    clouds: tuple[list[Cloud], list[Cloud]]
    T_mount: Array  # (2, 4, 4) T_base_scanner or T_flange_scanner
    coarse: Array  # (2, 4, 4) as stated
    times: Array  # (2, V) s


def scanner_cell(
    kind: str, seed: int, hidden: dict[str, tuple[int, float]] | None = None, views: int = 10, rays: int = 110
) -> ScannerCell:
    """Simulate a cell, of `rays` × `rays` a scan.

    `hidden` has by name of the law whose scanner errs, and times what it does at amplitude 1.
    """
    scanner = replace(_SCANNER, columns=rays, rows=rays)
    rng = np.random.default_rng([seed, KINDS.index(kind), 2])
    mesh = build_shape("blade")
    middle = np.asarray(mesh.bounds.mean(axis=0))
    weights = [field_map(scanner, rng) for _ in NAMES]
    scales = 1 + rng.normal(0, _SCALE, 2)
    turned = Rotation.from_rotvec(rng.normal(0, 0.3, 3)).as_matrix()
    on_flange = np.array([0.0, 0.0, 120.0]) + rng.normal(0, 8.0, 3)
    in_cell = np.array([950.0, 40.0, 400.0]) + rng.normal(0, 8.0, 3)
    holds = on_flange if kind == "stands" else in_cell
    T_holder_part = pose_of(turned, holds - turned @ middle)
    T_mount = np.array([_mount(kind, k, in_cell, rng) for k in range(2)])
    flanges, clouds = np.zeros((2, views, 4, 4)), ([], [])
    for v in range(views):
        off = pose_of(Rotation.from_rotvec((twist := rng.normal(0, _ARM_SCATTER))[:3]).as_matrix(), twist[3:])
        look = _look(middle, rng)
        for k in range(2):
            if kind == "stands":
                # Each scanner has stops of its own, at which the arm shows it the part from some side.
                off = pose_of(Rotation.from_rotvec((twist := rng.normal(0, _ARM_SCATTER))[:3]).as_matrix(), twist[3:])
                look = _look(middle, rng)
                flange = T_mount[k] @ np.linalg.inv(T_holder_part @ look)
                T_part_scanner = np.linalg.inv(flange @ off @ T_holder_part) @ T_mount[k]
            else:
                # The first looks; the second sees what it sees from beside it.
                flange = T_holder_part @ look @ np.linalg.inv(T_mount[0])
                T_part_scanner = np.linalg.inv(T_holder_part) @ flange @ off @ T_mount[k]
            flanges[k, v] = flange
            cloud = scan(mesh, T_part_scanner, scanner, weights[k], rng)
            cloud = replace(cloud, points=cloud.points * scales[k])
            clouds[k].append(_erring(cloud, k, hidden or {}))
    stated = [
        T @ pose_of(Rotation.from_rotvec(rng.normal(0, 0.01, 3)).as_matrix(), rng.normal(0, 3.0, 3)) for T in T_mount
    ]
    start = np.arange(views) * 30.0
    return ScannerCell(kind, flanges, clouds, T_mount, np.array(stated), np.array([start, start + 5.0]))


def _erring(cloud: Cloud, k: int, hidden: dict[str, tuple[int, float]]) -> Cloud:
    points = cloud.points
    for law, (scanner, amplitude) in hidden.items():
        if scanner != k:
            continue
        size = amplitude * SIZES[law]
        if law == "range_scale":
            points = points * (1 + size)
        else:
            rho2 = (points[:, 0] ** 2 + points[:, 1] ** 2) / points[:, 2] ** 2
            points = points + points / np.linalg.norm(points, axis=1)[:, None] * (size * rho2)[:, None]
    return replace(cloud, points=points)


def _mount(kind: str, k: int, place: Array, rng: np.random.Generator) -> Array:
    if kind == "rig":
        # Side by side, turned inwards: they look at one spot.
        side = (2 * k - 1) * 110.0
        R = Rotation.from_rotvec([0, -np.arctan2(side, 420.0), 0]).as_matrix()
        return pose_of(
            Rotation.from_rotvec(rng.normal(0, 0.02, 3)).as_matrix() @ R,
            np.array([side, 30.0, 80.0]) + rng.normal(0, 5, 3),
        )
    azimuth = np.pi + (2 * k - 1) * 0.6 + rng.normal(0, 0.1)
    away = np.array([np.cos(azimuth), np.sin(azimuth), 0.4])
    return _towards(place, away, rng)


def _look(middle: Array, rng: np.random.Generator) -> Array:
    """(4, 4) T_part_scanner from some side above the blade."""
    away = rng.normal(0, 1, 3) * [1.0, 1.0, 0.5] + [0, 0, 1.2]
    return _towards(middle + rng.normal(0, 10.0, 3), away, rng)


def _towards(aim: Array, away: Array, rng: np.random.Generator) -> Array:
    away = away / np.linalg.norm(away)
    x = np.cross([0.3, 0.2, 1.0], -away)
    x = x / np.linalg.norm(x)
    R = np.column_stack([x, np.cross(-away, x), -away]) @ Rotation.from_rotvec([0, 0, rng.uniform(-2, 2)]).as_matrix()
    return pose_of(R, aim + away * 420.0 * rng.uniform(0.95, 1.05))


def write_scanners(folder: Path, cell: ScannerCell) -> list[Path]:
    """Write a session folder a scanner, with a coarse hand-eye, and return them."""
    paths = []
    for k, scanner in enumerate(NAMES):
        names = [f"v{v:03d}" for v in range(len(cell.clouds[k]))]
        columns: dict[str, object] = {"view": names, "cloud": [f"clouds/{name}.ply" for name in names]}
        columns |= {"time_s": cell.times[k]} | pose_columns(cell.T_base_flange[k])
        table = {"name": scanner, "noise": _SCANNER.noise, "standoff": _SCANNER.standoff}
        files = SessionFiles(
            name=f"cell-{scanner}",
            length_unit="mm",
            mount="eye_to_hand" if cell.kind == "stands" else "eye_in_hand",
            views=columns,
            tables={"scanner": table | {"pose": cell.coarse[k].tolist()}},
            clouds={f"clouds/{n}.ply": cloud_file(cloud) for n, cloud in zip(names, cell.clouds[k], strict=True)},
        )
        paths.append(folder / f"cell-{scanner}")
        session_files.write_session(paths[-1], files)
    return paths
