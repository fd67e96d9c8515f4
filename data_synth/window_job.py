"""A window cell's scans as the files that `stitch fit` and `stitch seam` read."""

import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


def write_scans(table: Path, clouds: list[Array], T_base_scanner: Array) -> None:
    """One PLY per scan beside the table that names them with their poses."""
    rows = []
    for i, (points, T) in enumerate(zip(clouds, T_base_scanner, strict=True)):
        name = f"{table.stem}-{i + 1:02}.ply"
        vertex = np.empty(len(points), [("x", "f4"), ("y", "f4"), ("z", "f4")])
        vertex["x"], vertex["y"], vertex["z"] = points.T
        PlyData([PlyElement.describe(vertex, "vertex")]).write(str(table.parent / name))
        rows.append([name, *numbers(T)])
    _write(table, "file x y z a_deg b_deg c_deg", rows)


def write_stations(file: Path, middle: Array, across: Array, outwards: Array) -> None:
    """Stations 1 … N in the part frame."""
    places = np.hstack([middle, across, outwards])
    rows = [[i + 1, *np.round(place, 6).tolist()] for i, place in enumerate(places)]
    _write(file, "station x y z across_x across_y across_z out_x out_y out_z", rows)


def write_path(file: Path, poses: Array) -> None:
    """A robot path p1 … pN."""
    _write(file, "name x y z a_deg b_deg c_deg", [[f"p{i + 1}", *numbers(T)] for i, T in enumerate(poses)])


def numbers(T: Array) -> list[float]:
    """x, y, z, a, b, c (mm, deg about z, y', x'')."""
    angles = Rotation.from_matrix(T[:3, :3]).as_euler("ZYX", degrees=True)
    return [round(float(v), 7) for v in (*T[:3, 3], *angles)]


def pose_table(T: Array) -> str:
    """The lines of a TOML table that hold a pose."""
    return "\n".join(f"{k} = {v}" for k, v in zip(("x", "y", "z", "a_deg", "b_deg", "c_deg"), numbers(T), strict=True))


def _write(file: Path, header: str, rows: list[list[object]]) -> None:
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(header.split())
        writer.writerows(rows)
