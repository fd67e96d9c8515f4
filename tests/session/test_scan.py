"""Normals, noise and thinning of scans against a sphere and against all points.

A scanner that moves within each scan: its points go back to where each view stood, its odometry to the hand-eye.
"""

from dataclasses import replace

import igl
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.in_memory import session_of
from data_synth.scene import load_scene
from data_synth.simulate import simulate
from data_synth.write import write_session
from stitch.effects import EFFECTS
from stitch.effects.contract import missing_need
from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.hand_eye import park_martin
from stitch.numerics.odometry import is_stream, motions_between, motions_of_stream, scan_odometry
from stitch.session import capture
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of
from stitch.session.reading import session_folder
from stitch.session.reading.session_folder import load_session
from stitch.session.scan import fit_planes, prepare_scan
from stitch.session.session import Cloud, Scanner
from stitch.session.thinning import distinct_points


def test_normals_and_noise_of_a_sphere():
    """Normals point along the radius and the noise is the one put in."""
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(20000, 3)) * [1, 1, 0.3] - [0, 0, 2]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points = np.array([0, 0, 400.0]) + direction * (40 + 0.03 * rng.standard_normal(len(direction)))[:, None]
    scan = prepare_scan("s", points)
    inner = scan.usable
    assert inner.mean() > 0.5
    assert np.median(np.einsum("ij,ij->i", scan.normals, direction)[inner]) > 0.995
    assert scan.noise == pytest.approx(0.03, rel=0.04)


def test_normals_of_a_bent_surface_do_not_lean_towards_the_scanner():
    """A ball seen in even steps of angle, against its radii, beside the normals of planes."""
    x, y = np.meshgrid(np.linspace(-0.092, 0.092, 40), np.linspace(-0.092, 0.092, 40))
    rays = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    depth, centre, radius = 400 * rays[:, 2], np.array([0.0, 0.0, 400.0]), 35.0
    root = depth**2 - 400**2 + radius**2
    rays, distance = rays[root > 0], (depth - np.sqrt(np.maximum(root, 0)))[root > 0]
    points = rays * (distance + 0.02 * np.random.default_rng(4).standard_normal(len(distance)))[:, None]
    scan, radial = prepare_scan("ball", points), (points - centre) / radius
    cosine = -np.einsum("ij,ij->i", radial, rays)
    slanted = scan.usable & (cosine < 0.57)
    towards = -rays - cosine[:, None] * radial
    planes = fit_planes(points, scan.tree.query(points, k=16)[1])[1]
    planes *= np.sign(np.einsum("ij,ij->i", planes, radial))[:, None]
    lean, of_planes = (
        np.einsum("ij,ij->i", normals - radial, towards)[slanted].mean() for normals in (scan.normals, planes)
    )
    assert slanted.sum() > 200 and of_planes > 0.005
    assert abs(lean) < 0.25 * of_planes


def test_normals_and_noise_do_not_depend_on_how_the_scanner_s_axes_are_turned():
    rng = np.random.default_rng(6)
    x, y = rng.uniform(-20, 20, (2, 900))
    points = np.column_stack([x, y, 300 + x**2 / 60 - x * y / 90 + 0.01 * rng.standard_normal(900)])
    turn = Rotation.from_rotvec([0.3, -0.2, 0.8]).as_matrix()
    scan, turned = prepare_scan("bent", points), prepare_scan("bent", points @ turn.T)
    assert np.abs(scan.normals @ turn.T - turned.normals).max() < 1e-9
    assert abs(scan.noise - turned.noise) < 1e-9 * scan.noise


def test_two_profiles_do_not_show_how_the_surface_bends_between_them():
    """Across them a normal is known by the difference of two means of some eight points, as if the surface were flat."""
    noise, apart, rng = 0.01, 1.0, np.random.default_rng(5)
    x, y = (own.ravel() for own in np.meshgrid(np.arange(-20, 20, 0.5), [0.0, apart]))
    scan = prepare_scan("two", np.column_stack([x, y, 300 + x**2 / 80 + noise * rng.standard_normal(len(x))]))
    across = (scan.normals[:, 1] / scan.normals[:, 2])[np.abs(x) < 17]
    assert np.sqrt(np.mean(across**2)) < 1.5 * noise * np.sqrt(2 / 8) / apart


@pytest.mark.parametrize("widths", [(1, 1, 1e-3), (1, 1e-2, 1e-6), (1, 1e-7, 1e-7), (1, 1, 1), (1, 0, 0), (0, 0, 0)])
def test_planes_are_those_of_the_eigenvectors(widths):
    """Of planes, ridges, lines, balls and single points, against LAPACK: the direction, where there is one."""
    rng = np.random.default_rng(1)
    turns = np.linalg.qr(rng.normal(size=(50, 3, 3)))[0]
    points = (400 + (rng.normal(size=(50, 16, 3)) * widths) @ turns).reshape(-1, 3)
    around = points.reshape(50, 16, 3)
    centroid, normals, variation, left = fit_planes(points, np.arange(len(points)).reshape(50, 16))
    centred = around - around.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(centred.transpose(0, 2, 1) @ centred)
    assert np.allclose(centroid, around.mean(axis=1), rtol=1e-14)
    assert np.allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-12)
    assert np.allclose(variation, values[:, 0] / np.maximum(values.sum(axis=1), 1e-300), atol=1e-12)
    assert np.allclose(left**2, np.maximum(values[:, 0], 0) / 13, atol=1e-12 * max(values.max(), 1))
    clear = values[:, 1] - values[:, 0] > 1e-6 * values[:, 2]
    assert np.allclose(np.abs(np.einsum("ni,ni->n", normals, vectors[:, :, 0]))[clear], 1, atol=1e-12)


def test_an_origin_amid_what_is_measured_is_not_where_the_scanner_looks_from():
    """Half of a plate tilted through the origin would turn its back on it; from the standoff all faces the scanner."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-60, 60, (2, 4000))
    points = np.column_stack([x, y, 0.4 * x + 0.02 * rng.standard_normal(len(x))])
    axis = np.array([0.0, 0.0, 1.0])
    scanner = Scanner(None, None, 420.0, axis)
    assert np.array_equal(scanner.eye(points), [0, 0, -420]) and not scanner.eye(points + 400 * axis).any()
    assert not replace(scanner, standoff=None).eye(points).any()
    amid = prepare_scan("p", points, eye=scanner.eye(points))
    ahead = prepare_scan("p", points + 420 * axis)
    assert (amid.normals[:, 2] < 0).all() and np.allclose(amid.normals, ahead.normals, atol=1e-6)
    assert np.allclose(amid.confidence, ahead.confidence) and np.array_equal(amid.usable, ahead.usable)


def test_a_thinned_scan_keeps_the_surface_of_all_points(blade_capture):
    """Fewer points, the normals and edges of all of them; what is small enough already stays as it is."""
    measured, capture = blade_capture
    whole = capture.scans[0]
    index = np.arange(0, len(whole.points), 3)
    scan = prepare_scan("v", whole.points, index)
    assert np.array_equal(scan.points, whole.points[index])
    assert np.array_equal(scan.usable, whole.usable[index])
    # Each has its own estimate of the noise, and by that a few points bend or do not.
    other = np.flatnonzero((scan.normals != whole.normals[index]).any(axis=1))
    left = fit_planes(whole.points, whole.tree.query(whole.points[index[other]], k=16)[1])[3]
    assert (left > 2**0.5 * min(scan.noise, whole.noise)).all() and (
        left <= 2**0.5 * max(scan.noise, whole.noise)
    ).all()
    assert scan.spacing > whole.spacing and scan.area.sum() == pytest.approx(whole.area.sum(), rel=0.02)
    assert np.array_equal(prepare_scan("v", whole.points, np.arange(len(whole.points))).normals, whole.normals)


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_an_intensity_that_is_not_finite_counts_as_none(blade_capture, wrong):
    measured, capture = blade_capture
    session = session_of(measured)
    assert measurement_of(session, capture).has_intensity
    assert session.views[1].cloud is not None
    session.views[1].cloud.scalars["intensity"] = np.full(len(session.views[1].cloud.points), 0.5)
    session.views[1].cloud.scalars["intensity"][3] = wrong
    measurement = measurement_of(session, capture)
    assert not measurement.has_intensity and missing_need(measurement, EFFECTS["intensity_bias"]) == ("intensity",)


def test_profiles_show_no_surface(recwarn):
    """All points in a plane through the scanner: said in one line, and no arithmetic warns on the way."""
    measured = measured_blade(3, views=3, pixels=40)
    along = np.linspace(-30, 30, 400)
    profile = np.column_stack([along, np.zeros(400), 300 - 0.01 * along**2])
    clouds = [replace(c, points=profile, intensity=np.ones(400), incidence=np.ones(400)) for c in measured.clouds]
    with pytest.raises(InputError, match="every cloud is one profile.*to fix.*stitch calibrate sphere"):
        prepare_capture(session_of(replace(measured, clouds=clouds)))
    assert not recwarn


def test_scans_are_the_same_where_neighbours_do_not_fit_in_memory_at_once(monkeypatch):
    session = session_of(measured_blade(3, views=2, pixels=40))
    at_once = prepare_capture(session).scans
    monkeypatch.setattr(capture, "_AT_ONCE", 100)
    for own, other in zip(prepare_capture(session).scans, at_once, strict=True):
        for name in ("points", "normals", "usable", "area", "spacing", "noise"):
            assert np.array_equal(getattr(own, name), getattr(other, name)), name


def test_a_scan_that_holds_every_point_twice_is_the_scan_without_copies():
    """Normals, noise and spacing would be taken from a point's own copy."""
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-50, 50, (2, 3000))
    points = np.column_stack([x, y, 400 + 0.004 * x**2 + 0.03 * rng.standard_normal(3000)])
    intensity = rng.uniform(size=3000)
    for order in (np.repeat(np.arange(3000), 2), np.tile(np.arange(3000), 2)):
        again = distinct_points(Cloud(points[order], scalars={"intensity": intensity[order]}))
        assert np.array_equal(again.points, points) and np.array_equal(again.scalars["intensity"], intensity)
    once = Cloud(points)
    assert distinct_points(once) is once
    scan = prepare_scan("v", again.points)
    assert scan.noise == pytest.approx(0.03, rel=0.1) and scan.spacing > 0.5


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


def test_points_that_memory_has_no_room_for_go_back_too_and_are_fused(tmp_path, monkeypatch):
    write_session(tmp_path / "s", moving(5, noise=1e-6), "s")
    all_points = [view.cloud.points for view in load_session(tmp_path / "s").views]
    monkeypatch.setattr(session_folder, "points_within", lambda memory, views: 500)
    for view, points in zip(load_session(tmp_path / "s", memory=2e9).views, all_points, strict=True):
        assert len(view.cloud.points) == 500 and view.cloud.count == len(points)
        np.testing.assert_allclose(view.cloud.whole.read().points, points, atol=1e-9)
        assert np.array_equal(view.cloud.points, view.cloud.whole.scan.points)


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
