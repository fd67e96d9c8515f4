"""Write what a cell measured as a session folder, and the truth beside it, not inside."""

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from data_synth.cell import Cell, Measured
from stitch import frames


def write_session(out: Path, name: str, cell: Cell, measured: Measured, T_coarse: NDArray[np.float64] | None) -> None:
    """`out` becomes the session, `out`.truth.json holds what nobody in the cell knows.

    Args:
        T_coarse: hand-eye to state in session.toml; None leaves it to be found.
    """
    (out / "clouds").mkdir(parents=True)
    lines = ["view,cloud,x,y,z,qx,qy,qz,qw"]
    for i, (cloud, T) in enumerate(zip(measured.clouds, measured.T_base_flange, strict=True)):
        file = f"clouds/v{i:03d}.ply"
        _write_ply(out / file, cloud)
        numbers = [*T[:3, 3], *frames.to_quaternion(T)]
        lines.append(f"v{i:03d},{file}," + ",".join(f"{x:.12g}" for x in numbers))
    (out / "views.csv").write_text("\n".join(lines) + "\n")
    pose = "" if T_coarse is None else "pose = " + json.dumps(T_coarse.tolist()) + "\n"
    (out / "session.toml").write_text(
        f'format = "stitch-session/1"\nname = "{name}"\nlength_unit = "mm"\nmount = "{cell.mount}"\n\n'
        f'[scanner]\n{pose}noise = {cell.scanner.noise}\nstandoff = {cell.scanner.standoff}\noptical_axis = "+z"\n'
    )
    truth = {"hand_eye": measured.T_mount.tolist(), "poses": measured.T_reference_scanner.tolist()}
    out.with_name(out.name + ".truth.json").write_text(json.dumps(truth, indent=1) + "\n")


def _write_ply(path: Path, points: NDArray[np.float64]) -> None:
    vertex = np.empty(len(points), [(axis, "<f8") for axis in "xyz"])
    for axis, column in zip("xyz", points.T, strict=True):
        vertex[axis] = column
    PlyData([PlyElement.describe(vertex, "vertex")], byte_order="<").write(str(path))
