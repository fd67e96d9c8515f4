"""Scan onto CAD, seam and the whole window line: known meshes in known poses; truth from them, not from the package."""

import csv
import io
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from bench.window import NOISE, furthest, hand_eye_and_fits, joined, path_end, place_window
from bench.window import turned as truth
from data_synth.cells import window_scans, window_views
from data_synth.cells.window_line import EXACT, Errors, WindowLine
from data_synth.cells.window_line_job import write_seam
from data_synth.fixtures.edits import replace_text
from data_synth.shapes import car_door
from data_synth.shapes.car_door import CarDoor, Pane
from stitch.errors import InputError, NoResultError
from stitch.numerics import frames
from stitch.plugins.cells.cad import Box, Regions, cad_surface, coverage, nearest_partners
from stitch.plugins.cells.job_files import POSE_COLUMNS, poses_from_columns, read_columns, write_poses
from stitch.plugins.cells.scan_to_cad import find_cad_start, fit_cad, measure_deviations, split_instances
from stitch.plugins.cells.seam import Limits, Station, bond_gap, find_edge, measure_seam
from stitch.plugins.cells.window import correct_path, read_fit_job, read_seam_job, solve_seam
from tests.command_line import ended

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "window"
# A door of half the size: the same shapes, a quarter of the triangles.
DOOR = {"length": 600.0, "height": 520.0, "belt": 300.0, "window_frame": 34.0}
# A bulge that is 3 mm deep in the body and not in its CAD.
WELD = window_scans.Weld(x=170.0, z=90.0, size=3.0, reach=60.0)


@pytest.fixture(scope="module")
def door():
    return car_door.build(CarDoor(**DOOR))


@pytest.fixture(scope="module")
def pane():
    return car_door.build_pane(Pane(**DOOR))


@pytest.fixture(scope="module")
def pane_cad(pane):
    return cad_surface(pane)


def scan_pane(pane, T, seed):
    far, poses = window_scans.scan_outside(pane, T, NOISE, seed, (2, 1), rays=80, distance=600.0)
    near, close = window_scans.scan_edges(pane, T, Pane(**DOOR), "pane", NOISE, seed + 9, count=8, rays=90)
    return joined(far + near, np.concatenate([poses, close]))


def test_distances_are_those_of_trimesh(pane, pane_cad):
    """Points up to 1.5 mm off either face of the 4 mm pane: the nearest triangle is the one below them."""
    rng = np.random.default_rng(0)
    points, faces = trimesh.sample.sample_surface(pane, 60, seed=1)
    normals = pane.face_normals[faces]
    off = points + rng.uniform(-1.5, 1.5, (60, 1)) * normals
    distance, _, accept = nearest_partners(pane_cad, off, normals)
    count = len(pane.faces)
    place = trimesh.triangles.closest_point(np.tile(pane.triangles, (60, 1, 1)), np.repeat(off, count, axis=0))
    wanted = np.linalg.norm(place.reshape(60, count, 3) - off[:, None], axis=2).min(axis=1)
    assert accept.mean() > 0.8
    assert np.abs(np.abs(distance) - wanted)[accept].max() < 2e-3


def test_fit_without_a_guess(pane, pane_cad):
    seed, T = 3, truth(3)
    scan = scan_pane(pane, T, seed)
    T_start, *_ = find_cad_start(scan, pane_cad)
    found = fit_cad(scan, pane_cad, T_start)
    assert furthest(found.T_base_part, T, pane) < 0.05
    # The truth lies within the stated covariance: chi-square of 6, chance 1e-4, with the sandwich's own doubt.
    shift = frames.make(np.eye(3), pane_cad.centre)
    off = frames.log(np.linalg.inv(T @ shift) @ found.T_base_part @ shift)
    assert off @ np.linalg.solve(found.covariance, off) < 2 * 27.9


def test_weld_dent_shows_in_the_map_and_does_not_pull_the_fit(door):
    """A dent of 3 mm (σ 60 mm) on a door of 600 mm; start 6 mm and 0.5° off."""
    weld = window_scans.Weld(x=170.0, z=90.0, size=3.0, reach=60.0)
    warped, cad, T = window_scans.warp(door, weld), cad_surface(door), truth(1)
    far, poses = window_scans.scan_outside(warped, T, NOISE, 1, (2, 2), rays=110, distance=500.0)
    near, close = window_scans.scan_edges(warped, T, CarDoor(**DOOR), "door", NOISE, 2, count=8, rays=80)
    scan = joined(far + near, np.concatenate([poses, close]))
    centre = frames.make(np.eye(3), cad.centre)
    start = T @ centre @ frames.exp(np.array([6e-3, -5e-3, 6e-3, 4, -3, 3.5])) @ np.linalg.inv(centre)
    found = fit_cad(scan, cad, start)
    assert furthest(found.T_base_part, T, door) < 0.05
    shown = measure_deviations(scan, cad, found.T_base_part, 0.5, 15.0)
    # Compared where the outer skin is flat enough for a dent along y to be one along the normal within 5 %.
    slope = np.gradient(car_door.outer_surface(CarDoor(**DOOR), np.full(3, 170.0), np.array([88.0, 90.0, 92.0])), 2.0)[
        1
    ]
    middle = shown.middle
    at = (np.hypot(middle[:, 0] - weld.x, middle[:, 2] - weld.z) < 25) & (shown.mean < -1)
    assert at.sum() >= 4
    expected = -window_scans.dent(weld, middle[at, 0], middle[at, 2]) / np.hypot(1, slope)
    assert shown.mean[at] == pytest.approx(expected, abs=0.2)
    far_off = np.hypot(middle[:, 0] - weld.x, middle[:, 2] - weld.z) > 4 * weld.reach
    assert np.median(np.abs(shown.mean[far_off])) < 0.05
    assert shown.outside[at].all()


@pytest.mark.slow
def test_two_parts_in_one_scan(pane, pane_cad):
    Ts = [truth(5), truth(5) @ frames.make(np.eye(3), [30.0, -450.0, 40.0])]
    scans = [scan_pane(pane, T, 5 + i) for i, T in enumerate(Ts)]
    columns = (np.concatenate([getattr(s, n) for s in scans]) for n in ("points", "normals", "usable", "area"))
    view = np.repeat([0, 1], [len(s.points) for s in scans])
    both = type(scans[0])(*columns, scans[0].spacing, scans[0].noise, view)
    heaps = split_instances(both, pane_cad, 2)
    middles = [s.points.mean(axis=0) for s in scans]
    whose = [int(np.argmin([np.linalg.norm(h.points.mean(axis=0) - m) for m in middles])) for h in heaps]
    assert sorted(whose) == [0, 1]
    for heap, k in zip(heaps, whose, strict=True):
        assert furthest(fit_cad(heap, pane_cad, Ts[k]).T_base_part, Ts[k], pane) < 0.05
    with pytest.raises(NoResultError, match="2 separate parts"):
        split_instances(both, pane_cad, 3)


def test_forbidden_region_keeps_a_gripper_out_of_the_fit(pane, pane_cad):
    """A plate 1 mm above a third of the pane: with the region the fit stands, and only the box's points are out."""
    T = truth(2)
    scan = scan_pane(pane, T, 2)
    local = frames.transform(np.linalg.inv(T), scan.points)
    box = Box("gripper", np.array([250.0, -99, -99]), np.array([430.0, 99, 999]))
    lifted = scan.points + np.where(box.holds(local), 1.0, 0.0)[:, None] * scan.normals
    scan = replace(scan, points=lifted)
    found = fit_cad(scan, pane_cad, T, Regions(forbidden=(box,)))
    assert furthest(found.T_base_part, T, pane) < 0.05


def test_a_plane_fixes_no_pose(pane_cad):
    box = trimesh.creation.box([300, 200, 10])
    cad = cad_surface(box)
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-140, 140, 4000), rng.uniform(-90, 90, 4000), np.full(4000, 5.0)])
    scan = joined([points - [0, 0, 500.0]], np.array([frames.make(np.eye(3), [0, 0, 500.0])]))
    with pytest.raises(NoResultError, match="leaves a direction open"):
        fit_cad(scan, cad, np.eye(4))


def test_edge_of_two_planes():
    """Top at 2 + 0.1·across, flank at across = −8 + 0.2·height: they meet where both hold."""
    rng = np.random.default_rng(1)
    a, s = rng.uniform(-28, -8.5, 3000), rng.uniform(-10, 10, 6000)
    h = rng.uniform(-3, 1.0, 3000)
    top = np.column_stack([a, s[:3000], 2 + 0.1 * a + 0.02 * rng.standard_normal(3000)])
    flank = np.column_stack([-8 + 0.2 * h + 0.02 * rng.standard_normal(3000), s[3000:], h])
    normals = np.vstack([np.tile([-0.1, 0, 1.0], (3000, 1)), np.tile([1.0, 0, -0.2], (3000, 1))])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    (across, up), covariance, _ = find_edge(np.vstack([top, flank]), normals, 1.0)
    height = (2 + 0.1 * -8) / (1 - 0.1 * 0.2)
    sigma = np.sqrt(np.diag(covariance))
    assert abs(up - height) < 4 * sigma[1] < 0.02
    assert abs(across - (-8 + 0.2 * height)) < 4 * sigma[0] < 0.02


def test_the_sigma_of_an_edge_does_not_count_noise_twice_where_the_surface_is_the_frames_own_plane():
    rng = np.random.default_rng(1)
    top = np.column_stack([rng.uniform([-28, -10], [-8, 10], (3000, 2)), 0.04 * rng.standard_normal(3000)])
    flank = np.column_stack([np.full(3000, -8.0), rng.uniform([-10, -3], [10, -0.5], (3000, 2))])
    flank[:, 0] += 0.02 * rng.standard_normal(3000)
    points = np.vstack([top, flank])
    normals = np.repeat([[0, 0, 1.0], [1.0, 0, 0]], 3000, axis=0)
    heights = np.array([[0, 0, 0.0], [0, 0, 1.5]])
    sigmas = [np.sqrt(find_edge(points + height, normals, 1.0)[1][1, 1]) for height in heights]
    assert sigmas[0] == pytest.approx(sigmas[1], rel=0.1)
    assert sigmas[0] == pytest.approx(0.04 * 3 / np.sqrt(3000), rel=0.4)  # of a parabola's end


def test_bond_gap_is_from_the_glass_inner_face_to_the_flange_behind_it_and_follows_the_pane():
    """Pane 4 mm thick, its outer face at 0.3; flange at −12 leaned by 0.02: 8.3 mm less the lean where both are seen."""
    rng = np.random.default_rng(2)
    places = rng.uniform([-28, -10], [-8, 10], (4000, 2))
    of_pane = np.arange(4000) < 2000
    places[~of_pane, 0] = rng.uniform(-20, 8, 2000)
    height = np.where(of_pane, 0.3, -12 + 0.02 * places[:, 0]) + 0.05 * rng.standard_normal(4000)
    normals = np.tile([0, 0, 1.0], (4000, 1))
    moves = np.where(of_pane[:, None], [0, 0, 0.1], 0.0)[None]
    bond, variance, moved = bond_gap(np.column_stack([places, height]), normals, of_pane, -8.0, 4.0, moves)
    assert bond == pytest.approx(8.3 + 0.02 * 14, abs=4 * np.sqrt(variance))
    assert np.sqrt(variance) < 0.01
    assert moved == pytest.approx([0.1])
    with pytest.raises(NoResultError, match="0 points on the flange"):
        bond_gap(np.column_stack([places, height]), normals, np.ones(4000, bool), -8.0, 4.0, moves)


def test_seam_at_eight_stations(door, pane):
    """Within 0.05 mm of the meshes cut at the stations; the pane stands 0.6 mm out and 2.5 mm down."""
    moved = pane.copy()
    moved.apply_translation([0.7, 0.6, -2.5])
    middle, across, out = window_views.stations(Pane(**DOOR))
    T = truth(4)
    scan = joined(*window_scans.scan_seam([door, moved], T, (middle, across, out), NOISE, 1, rays=110))
    places = [Station(str(i), *v) for i, v in enumerate(zip(middle, across, out, strict=True))]
    seams = measure_seam(scan, T, places, Limits())
    true = np.array([window_scans.true_seam(moved, door, p.T_part_station) for p in places])
    found = np.array([[s.flush, s.gap] for s in seams])
    assert np.abs(found - true).max() < 0.05
    wanted = ["bad" if abs(g - 16) > 2 or abs(f) > 1.5 else "good" for f, g in true]
    assert [s.verdict for s in seams] == wanted
    assert {"bad", "good"} <= set(wanted)


def test_path_follows_the_part():
    nominal, found, tool = truth(1), truth(2), truth(3)[None]
    moved = correct_path(tool, nominal, found)[0]
    assert np.allclose(np.linalg.inv(found) @ moved, np.linalg.inv(nominal) @ tool[0])


def test_a_part_that_moves_is_followed_from_scan_to_scan_and_where_it_is_gone_it_is_lost(tmp_path, monkeypatch):
    """The scanner's poses are moved in place of the part: 3 mm and 2 mrad a step, then 300 mm at once."""
    columns = read_columns(EXAMPLE / "pane.csv", "file", POSE_COLUMNS)
    files = [str(EXAMPLE / name) for name in columns.texts["file"]]
    step = frames.exp(np.array([0.0, 0.002, 0.0, 2.0, -1.0, 2.0]))
    centre = frames.make(np.eye(3), [3567.7, -2954.3, 1932.9])
    moved = [centre @ np.linalg.matrix_power(step, k) @ frames.inverse(centre) for k in range(4)]
    moved[3] = frames.make(np.eye(3), [300.0, 0, 0])
    tables = [tmp_path / f"{k}.csv" for k in range(4)]
    for table, T in zip(tables, moved, strict=True):
        write_poses(table, "file", files, T @ poses_from_columns(columns))
    monkeypatch.setattr("sys.stdin", io.StringIO("".join(f"{table}\n" for table in tables)))
    answers = [json.loads(line) for line in ended("fit", EXAMPLE / "fit.toml", "--follow").out.splitlines()]
    first = np.array(answers[0]["T_base_part"])
    for answer, T in zip(answers[1:3], moved[1:3], strict=True):
        assert np.abs(np.array(answer["T_base_part"]) - T @ first)[:3, 3].max() < 0.01
        assert 0 < max(answer["sigma"]) < 0.01 < answer["latency_s"]
        assert len(answer["path"]) == len(read_columns(EXAMPLE / "path.csv", "name", POSE_COLUMNS).texts["name"])
    assert "lost" in answers[3]
    assert "leave out the other outputs" in ended("fit", EXAMPLE / "fit.toml", "--follow", "--json", code=2).err


@pytest.mark.parametrize(
    "command, name, old, new, message",
    [
        ("fit", "fit.toml", '"pane.stl"', '"none.stl"', "none.stl: not found"),
        ("fit", "fit.toml", "tolerance = 0.5", "tolerance = 0", "tolerance is 0; to fix: write a number above zero"),
        ("fit", "fit.toml", "high = [700.0", "high = [10.0", "the box region[1] is empty"),
        ("fit", "fit.toml", "[nominal]\n", "[nominl]\n", "unknown key 'nominl'; to fix: write 'nominal'"),
        ("seam", "seam.toml", "[part]", "[other]", "unknown key 'other'"),
        ("seam", "seam.toml", '"stations.csv"', '"seam.csv"', "column 'station' is missing"),
    ],
)
def test_bad_job_is_refused_in_one_line(tmp_path, command, name, old, new, message):
    shutil.copytree(EXAMPLE, tmp_path, dirs_exist_ok=True)
    replace_text(tmp_path / name, old, new)
    error = ended(command, tmp_path / name, code=2).err
    assert message in error and error.count("\n") == 1


def test_how_far_two_scans_stand_apart_is_in_the_gap_and_little_in_the_flush(tmp_path):
    shutil.copytree(EXAMPLE, tmp_path, dirs_exist_ok=True)
    job = tmp_path / "seam.toml"
    alone = solve_seam(read_seam_job(job))
    job.write_text("pose_sigma = 0.1\n" + job.read_text())
    stated = read_seam_job(job)
    assert stated.placed.errors.translation == pytest.approx(0.1 / np.sqrt(2))
    for seam, other in zip(solve_seam(stated), alone, strict=True):
        assert seam.sigma_gap == pytest.approx(np.hypot(other.sigma_gap, 0.1), rel=0.2)
        assert seam.sigma_flush < 0.7 * seam.sigma_gap


def test_expected_region_without_points_is_no_fit(pane_cad):
    box = Box("corner", np.array([-1e3, -1e3, -1e3]), np.array([1e3, 1e3, 1e3]))
    assert coverage(box, pane_cad, np.array([[5e3, 0, 0.0]]), np.array([[0, 1.0, 0]])) == 0.0
    with pytest.raises(InputError, match="not found"):
        read_fit_job("nowhere.toml")


def test_scans_thrown_apart_by_a_wrong_pose_are_refused(pane, pane_cad):
    scan = scan_pane(pane, truth(1), 1)
    points = scan.points + np.where(np.arange(len(scan.points)) < 2000, 1e8, 0.0)[:, None]
    thrown = replace(scan, points=points)
    with pytest.raises(NoResultError, match="correct a scanner's pose"):
        find_cad_start(thrown, pane_cad)


@pytest.fixture(scope="module", params=[False, True], ids=["area", "sweeps"])
def placed(tmp_path_factory, request):
    """The whole window line, from files through the commands.

    Scanner noise while sphere and parts are scanned; robot and rail exact, so that the limits are the scanner's.
    """
    folder = tmp_path_factory.mktemp("line")
    scanner_alone = Errors(noise=0.05, turn=0.0, shift=0.0, rail=0.0)
    # Rays as in the full line: at fewer, the pane's flanks of 4 mm are not seen and nothing holds it in its plane.
    grids = (2, 1), (2, 2)
    line = WindowLine(
        3, scanner_alone, scanner_alone, EXACT, DOOR, grids=grids, edges=7, weld=WELD, sweeps=request.param
    )
    in_rack = line.T_cell_window
    hand_eye_and_fits(folder, line)
    place_window(folder, line)
    write_seam(folder, line)
    ended("seam", folder / "seam.toml", "-o", folder / "seam.csv")
    return folder, line, in_rack


@pytest.mark.slow
def test_parts_are_found_and_the_window_goes_where_the_drawing_puts_it(placed):
    folder, line, in_rack = placed
    for part, true, mesh in (("window", in_rack, line.window_mesh), ("body", line.T_cell_body, line.body_mesh)):
        found = np.array(json.loads((folder / f"found-{part}" / "fit.json").read_text())["parts"][0]["T_base_part"])
        assert furthest(found, true, mesh) < 0.05
    assert furthest(np.linalg.inv(line.T_cell_body) @ line.T_cell_window, np.eye(4), line.window_mesh) < 0.05
    # The programmed places are millimetres off: without the found frames the window would miss.
    assert furthest(line.T_cell_body_nominal, line.T_cell_body, line.body_mesh) > 2.0


@pytest.mark.slow
def test_programs_follow_the_parts_as_the_paths_do(placed):
    folder, _, _ = placed
    for part, name in (("window", "grip"), ("body", "place")):
        copy = folder / f"{name}-there.src"
        if not copy.exists():
            there = ("--program", folder / f"{name}.src", "-o", copy, "--frame", "0,0,0,0,0,0")
            ended("export", folder / f"found-{part}", *there)
        *place, a, b, c = map(float, re.findall(r"[XYZABC] (-?[0-9.]+)", copy.read_text().splitlines()[-2]))
        T = frames.make(Rotation.from_euler("ZYX", [a, b, c], degrees=True).as_matrix(), np.array(place))
        assert np.abs(T - path_end(folder, part)).max() < 2e-4


@pytest.mark.slow
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


@pytest.mark.slow
def test_seam_is_that_of_the_meshes(placed):
    folder, line, _ = placed
    window = line.window_mesh.copy().apply_transform(np.linalg.inv(line.T_cell_body) @ line.T_cell_window)
    rows = list(csv.DictReader((folder / "seam.csv").open()))
    assert len(rows) == 8
    for row, station in zip(rows, zip(*line.stations(), strict=True), strict=True):
        true = window_scans.true_seam(window, line.body_mesh, Station("", *station).T_part_station)
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
@pytest.mark.slow
def test_bad_scans_are_refused_in_one_line(placed, old, new, message):
    folder, _, _ = placed
    shutil.copyfile(folder / "window.toml", folder / "bad.toml")
    replace_text(folder / "bad.toml", old, new)
    error = ended("fit", folder / "bad.toml", code=2).err
    assert message in error and error.count("\n") == 1
