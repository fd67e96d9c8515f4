"""A window line on disk: what it scans as session folders, its CAD and its programs as job files."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from data_synth.cells.window_job import pose_table, write_path, write_stations
from data_synth.cells.window_line import RADIUS, Scans, WindowLine
from data_synth.write import cloud_file
from stitch.output.session_files import SessionFiles, pose_columns, write_session

Array = NDArray[np.float64]

_FIT = """# Where does the {part} stand? Lengths in mm; poses are x, y, z and a, b, c in degrees about z, y', x''.
format = "stitch-fit/1"
cad = "{part}.stl"
session = "{part}"  # scans with the flange's reported poses, the rail's travel in them
hand_eye = "hand-eye.json"  # as `stitch calibrate sphere -o` wrote it
tolerance = 0.5
path = "{path}.csv"  # of the gripper, programmed for a {part} that stands as [nominal] says

[nominal]
{nominal}
{errors}"""
_SEAM = """# Does the window sit in the body as it should?
format = "stitch-seam/1"
session = "seam"
hand_eye = "hand-eye.json"
fit = "found-body/fit.json"  # as `stitch fit body.toml -o found-body` wrote it
stations = "stations.csv"  # in the body's frame
{errors}"""
_BEFORE = """# How will the window sit in the body, and over its flange? Asked before it is gripped.
format = "stitch-seam/1"
session = "body"
hand_eye = "hand-eye.json"
fit = "found-body/fit.json"
stations = "stations.csv"
[pane]
session = "window"
fit = "found-window/fit.json"
thickness = {thickness}
{errors}"""
# As the data sheets of robot and rail say.
_ERRORS = """
[errors]
rotation = {turn}  # of the flange, rad, new in every view
translation = {shift}  # of the flange, new in every view
carriage = {rail}  # of the rail's carriage, new at every stop
carriage_column = "rail_mm"
"""


def write_line(folder: Path, line: WindowLine) -> None:
    """Everything before the window is gripped: scans of sphere, window and body, CAD, paths, jobs."""
    folder.mkdir(parents=True, exist_ok=True)
    write_scans(folder / "sphere", line.scan_sphere(), line, sphere=True)
    write_scans(folder / "window", line.scan_window(), line)
    write_scans(folder / "body", line.scan_body(), line)
    line.window_mesh.export(folder / "window.stl")
    line.body_cad.export(folder / "body.stl")
    for name, path in (("grip", line.grip_path()), ("place", line.place_path())):
        write_path(folder / f"{name}.csv", path)
        (folder / f"{name}.src").write_text(_program(name, path), encoding="utf-8")
    write_stations(folder / "stations.csv", *line.stations())
    errors = stated_errors(line)
    for part, path, T in (
        ("window", "grip", line.T_cell_window_nominal),
        ("body", "place", line.T_cell_body_nominal),
    ):
        text = _FIT.format(part=part, path=path, nominal=pose_table(T), errors=errors)
        (folder / f"{part}.toml").write_text(text, encoding="utf-8")
    (folder / "seam.toml").write_text(_SEAM.format(errors=errors), encoding="utf-8")
    if line.door.rebate:
        before = _BEFORE.format(thickness=line.pane.glass, errors=errors)
        (folder / "before.toml").write_text(before, encoding="utf-8")


def stated_errors(line: WindowLine) -> str:
    """The table of a job that says how places may err."""
    return _ERRORS.format(turn=line.errors.turn, shift=line.errors.shift, rail=line.errors.rail)


def _program(name: str, T_cell_tool: Array) -> str:
    """The same path as a program of a KUKA, its poses in the cell's frame: x, y, z and A, B, C about z, y', x''."""
    turns = Rotation.from_matrix(T_cell_tool[:, :3, :3]).as_euler("ZYX", degrees=True)
    rows = np.round(np.hstack([T_cell_tool[:, :3, 3], turns]), 5) + 0.0
    moves = ["LIN {" + ",".join(f"{k} {v:.5f}" for k, v in zip("XYZABC", row, strict=True)) + "}" for row in rows]
    return "\n".join([f"DEF {name} ()", *moves, "END", ""])


def write_seam(folder: Path, line: WindowLine) -> None:
    """The scans of the seam, after the window was placed."""
    write_scans(folder / "seam", line.scan_seam(), line)


def write_scans(folder: Path, scans: Scans, line: WindowLine, sphere: bool = False) -> None:
    """One session folder, eye_in_hand; the scanner's drawing gives the coarse hand-eye."""
    names = [f"v{i:03d}" for i in range(len(scans.clouds))]
    files = [f"clouds/{name}.ply" for name in names]
    tables: dict[str, dict[str, Any]] = {
        "scanner": {"pose": line.T_flange_scanner_nominal.tolist(), "noise": line.errors.noise}
    }
    if sphere:
        tables["sphere"] = {"radius": RADIUS}
    # Of the sphere each view is one line at the pose itself.
    moves = (
        ()
        if scans.velocity is None or sphere
        else zip(("sweep_x", "sweep_y", "sweep_z"), scans.velocity.T, strict=True)
    )
    sweeps = dict(moves)
    session = SessionFiles(
        name=folder.name,
        length_unit="mm",
        mount="eye_in_hand",
        tables=tables,
        views={"view": names, "cloud": files, **pose_columns(scans.T_cell_flange), "rail_mm": scans.rail, **sweeps},
        clouds={file: cloud_file(cloud) for file, cloud in zip(files, scans.clouds, strict=True)},
    )
    write_session(folder, session)
