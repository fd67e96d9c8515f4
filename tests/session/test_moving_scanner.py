"""A scanner that moves within each scan: its points go back to where each view stood, its odometry to the hand-eye."""

from dataclasses import replace

import igl
import numpy as np
import pytest

from data_synth.scene import load_scene
from data_synth.simulate import simulate
from data_synth.write import write_session
from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.hand_eye import park_martin
from stitch.numerics.odometry import is_stream, motions_between, motions_of_stream, scan_odometry
from stitch.session.reading.session_folder import load_session


def moving(views, **scanner):
    """The first views of the scene, with an ideal arm; the session states the true hand-eye."""
    scene = load_scene("moving-scan")
    scene = replace(scene, repeatability=(0.0, 0.0), small=0.0, scanner=replace(scene.scanner, **scanner))
    measured = simulate(scene, {}, 0, views)
    return replace(measured, T_coarse=measured.T_mount)


def test_points_go_back_to_where_they_would_lie_had_the_scanner_stood(tmp_path):
    """By the distance of the points from the mesh, at the true pose of each view."""
    measured = moving(5, noise=1e-6)
    write_session(tmp_path / "s", measured, "s")
    session = load_session(tmp_path / "s")
    T_part_reference = frames.inverse(measured.scene.T_reference_part)

    def off(v, points):
        placed = frames.transform(T_part_reference @ measured.T_reference_scanner[v], points)
        mesh = np.array(measured.mesh.vertices), np.array(measured.mesh.faces)
        return np.sqrt(igl.point_mesh_squared_distance(placed, *mesh)[0].mean())

    for v in range(5):
        assert off(v, measured.clouds[v].points) > 0.4
        # Before the first view and after the last nothing says how the path goes on.
        assert off(v, session.views[v].cloud.points) < (0.1 if v in (0, 4) else 0.03)


def test_odometry_follows_a_stream_and_separate_views_are_none():
    measured = moving(24, noise=0.02)
    scans = [cloud.points for cloud in measured.clouds]
    assert is_stream(measured.T_base_flange, scans)
    assert not is_stream(measured.T_base_flange[::12], scans[::12])
    mixed = np.random.default_rng(0).permutation(24)
    assert not is_stream(measured.T_base_flange[mixed], [scans[v] for v in mixed])
    steps = [(v, v + 1) for v in range(23)]
    found = motions_between(scan_odometry(scans, [c.time for c in measured.clouds], 1 / 5), steps)
    true = motions_between(measured.T_reference_scanner, steps)
    middle = np.array([np.append(points.mean(axis=0), 1.0) for points in scans[1:]])
    off = np.linalg.norm(np.einsum("nij,nj->ni", found - true, middle)[:, :3], axis=1)
    moved = np.linalg.norm(np.einsum("nij,nj->ni", true - np.eye(4), middle)[:, :3], axis=1)
    assert np.mean(off < 0.25 * moved) >= 0.9


def test_steps_that_went_wrong_do_not_reach_the_hand_eye():
    rng = np.random.default_rng(3)
    T_mount = frames.exp(np.array([0.3, -0.2, 0.9, 40.0, -60.0, 90.0]))
    T_base_flange, odometry = [np.eye(4)], [np.eye(4)]
    for v in range(59):
        # A path that turns on about an axis which itself turns.
        step = frames.exp(np.r_[0.04 * np.array([np.cos(v / 9), np.sin(v / 9), 0.3]), rng.uniform(-5, 5, 3)])
        wrong = frames.exp(np.r_[rng.normal(0, 0.02, 3), rng.normal(0, 3, 3)]) if v in (20, 21) else np.eye(4)
        T_base_flange.append(T_base_flange[-1] @ step)
        odometry.append(odometry[-1] @ frames.inverse(T_mount) @ step @ T_mount @ wrong)
    A, B = motions_of_stream(np.array(T_base_flange), np.array(odometry))
    np.testing.assert_allclose(park_martin(A, B), T_mount, atol=1e-9)


def test_a_moving_scanner_needs_times(tmp_path):
    measured = moving(5)
    clouds = [replace(cloud, time=None) for cloud in measured.clouds]
    write_session(tmp_path / "s", replace(measured, clouds=clouds), "s")
    with pytest.raises(InputError, match="view v000 has no time of its points; to fix: write"):
        load_session(tmp_path / "s")
