"""The whole window line, small: files of a simulated cell through the commands, against the simulator's truth."""

import csv
import json
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_synth.cells.window_line import EXACT, Errors, WindowLine
from data_synth.cells.window_line_job import write_line, write_seam
from data_synth.cells.window_scans import Weld, true_seam
from stitch.cli.main import main
from stitch.numerics import frames
from stitch.plugins.cells.seam import Station

# Half a minute; the pieces of the line have tests of their own.
pytestmark = pytest.mark.slow
# A door of half the size: the same shapes, a quarter of the triangles.
DOOR = {"length": 600.0, "height": 520.0, "belt": 300.0, "window_frame": 34.0}
# A bulge that is 3 mm deep in the body and not in its CAD.
WELD = Weld(x=170.0, z=90.0, size=3.0, reach=60.0)


def run(*arguments):
    try:
        main([str(a) for a in arguments])
    except SystemExit as stop:
        assert not stop.code


def path_end(file):
    """The last pose of a path: x, y, z and turns about z, y', x'' in degrees."""
    row = list(csv.DictReader(file.open()))[-1]
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler(
        "ZYX", [float(row[k]) for k in ("a_deg", "b_deg", "c_deg")], degrees=True
    ).as_matrix()
    T[:3, 3] = [float(row[k]) for k in "xyz"]
    return T


def furthest(T, true, mesh):
    return np.linalg.norm(frames.transform(T, mesh.vertices) - frames.transform(true, mesh.vertices), axis=1).max()


@pytest.fixture(scope="module", params=[False, True], ids=["area", "sweeps"])
def placed(tmp_path_factory, request):
    """Scanner noise while sphere and parts are scanned; robot and rail exact, so that the limits are the scanner's."""
    folder = tmp_path_factory.mktemp("line")
    scanner_alone = Errors(noise=0.05, turn=0.0, shift=0.0, rail=0.0)
    # Rays as in the full line: at fewer, the pane's flanks of 4 mm are not seen and nothing holds it in its plane.
    grids = (2, 1), (2, 2)
    line = WindowLine(
        3, scanner_alone, scanner_alone, EXACT, DOOR, grids=grids, edges=7, weld=WELD, sweeps=request.param
    )
    write_line(folder, line)
    in_rack = line.T_cell_window
    run("calibrate", "sphere", folder / "sphere", "-o", folder / "hand-eye.json")
    run("fit", folder / "window.toml", "-o", folder / "found-window")
    run("fit", folder / "body.toml", "-o", folder / "found-body")
    line.place(*(path_end(folder / f"found-{part}" / "path.csv") for part in ("window", "body")))
    write_seam(folder, line)
    run("seam", folder / "seam.toml", "-o", folder / "seam.csv")
    return folder, line, in_rack


def test_parts_are_found_and_the_window_goes_where_the_drawing_puts_it(placed):
    folder, line, in_rack = placed
    for part, true, mesh in (("window", in_rack, line.window_mesh), ("body", line.T_cell_body, line.body_mesh)):
        found = np.array(json.loads((folder / f"found-{part}" / "fit.json").read_text())["parts"][0]["T_base_part"])
        assert furthest(found, true, mesh) < 0.05
    assert furthest(np.linalg.inv(line.T_cell_body) @ line.T_cell_window, np.eye(4), line.window_mesh) < 0.05
    # The programmed places are millimetres off: without the found frames the window would miss.
    assert furthest(line.T_cell_body_nominal, line.T_cell_body, line.body_mesh) > 2.0


def test_programs_follow_the_parts_as_the_paths_do(placed):
    folder, _, _ = placed
    for part, name in (("window", "grip"), ("body", "place")):
        copy = folder / f"{name}-there.src"
        if not copy.exists():
            run(
                "export",
                folder / f"found-{part}",
                "--program",
                folder / f"{name}.src",
                "-o",
                copy,
                "--frame",
                "0,0,0,0,0,0",
            )
        told = [float(x) for x in re.findall(r"[XYZABC] (-?[0-9.]+)", copy.read_text().splitlines()[-2])]
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.from_euler("ZYX", told[3:], degrees=True).as_matrix(), told[:3]
        assert np.abs(T - path_end(folder / f"found-{part}" / "path.csv")).max() < 2e-4


def test_welding_bulge_shows_in_the_map(placed):
    folder, _, _ = placed
    cells = list(csv.DictReader((folder / "found-body" / "deviation.csv").open()))
    at = np.array([[float(cell[k]) for k in ("x", "z", "deviation")] for cell in cells])
    near = np.hypot(at[:, 0] - WELD.x, at[:, 1] - WELD.z) < 25
    # The skin slopes there, so that 3 mm along y are a little less along its normal.
    assert -3.1 < np.median(at[near & (at[:, 2] < -1), 2]) < -2.0
    assert np.hypot(*(at[0, :2] - [WELD.x, WELD.z])) < WELD.reach
    far = np.hypot(at[:, 0] - WELD.x, at[:, 1] - WELD.z) > 4 * WELD.reach
    assert np.median(np.abs(at[far, 2])) < 0.05


def test_seam_is_that_of_the_meshes(placed):
    folder, line, _ = placed
    window = line.window_mesh.copy().apply_transform(np.linalg.inv(line.T_cell_body) @ line.T_cell_window)
    rows = list(csv.DictReader((folder / "seam.csv").open()))
    assert len(rows) == 8
    for row, station in zip(rows, zip(*line.stations(), strict=True), strict=True):
        true = true_seam(window, line.body_mesh, Station("", *station).T_part_station)
        assert np.abs([float(row["flush"]) - true[0], float(row["gap"]) - true[1]]).max() < 0.05
        assert row["verdict"] == "good"


@pytest.mark.parametrize(
    "old, new, message",
    [
        ('session = "window"', 'session = "nowhere"', "nowhere/session.toml: not found"),
        ('hand_eye = "hand-eye.json"', 'hand_eye = "window.toml"', "window.toml: holds no hand_eye with length_unit"),
        (
            'hand_eye = "hand-eye.json"',
            'hand_eye = "none.json"',
            "none.json: not found; to fix: write it with `stitch calibrate sphere SESSION -o none.json`",
        ),
        ('hand_eye = "hand-eye.json"', "", "session has no hand_eye; to fix: name the file"),
        ('session = "window"', 'session = "window"\nscans = "grip.csv"', "no scans; to fix: give scans"),
        ('session = "window"', 'scans = "grip.csv"', "hand_eye goes with session"),
    ],
)
def test_bad_scans_are_refused_in_one_line(placed, capsys, old, new, message):
    folder, _, _ = placed
    text = (folder / "window.toml").read_text()
    assert old in text
    (folder / "bad.toml").write_text(text.replace(old, new))
    with pytest.raises(SystemExit) as stop:
        main(["fit", str(folder / "bad.toml")])
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
