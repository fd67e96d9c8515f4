"""What is fused lies on the part, and is every point, as if all had been in memory.

Junk in scans stays out of the cloud: worlds whose surface is known, with points that are on none.
"""

from dataclasses import replace

import igl
import numpy as np
import pytest
from scipy.spatial import KDTree

from data_synth.fixtures.blade_cells import captured_blade
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import mesh_of
from stitch.effects import EFFECTS
from stitch.errors import InputError
from stitch.fusion.fuse import RegisteredSession, fuse_every_point, fuse_points, part_axes, place_scans
from stitch.fusion.look_through import range_images
from stitch.fusion.support import cell_numbers, find_support
from stitch.model.forward import corrected_capture
from stitch.model.model import Model, term_of
from stitch.numerics import frames
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of
from stitch.session.reading.session_folder import load_session
from stitch.session.scan import prepare_scan
from stitch.session.session import WholeCloud
from stitch.session.thinning import points_within, thin_session

NOISE, SPACING = 0.02, 1.0


def registered(session, measured, effect=None):
    """The session at its true poses; with an effect of 0.3 of its plausible size in use."""
    measurement = measurement_of(session, prepare_capture(session))
    terms = ()
    if effect is not None:
        term = term_of(measurement, EFFECTS[effect])
        terms = (term.at(0.3 * term.typical),)
    model = Model(measured.T_mount, terms)
    own = corrected_capture(measurement, model)
    return RegisteredSession(session, measurement, model, own, own.poses(measured.T_mount))


def fuse(capture, poses, cell=None, T_part=None):
    """All points of all views averaged, none left out."""
    T_part = part_axes(capture.scans, poses) if T_part is None else T_part
    return fuse_points(place_scans(capture.scans, frames.inverse(T_part) @ poses), cell or capture.spacing, T_part)


def test_fused_cloud_lies_on_the_part():
    measured, capture = captured_blade(8, repeatability=(0.0, 0.0))
    fused = fuse(capture, measured.T_reference_scanner)
    in_part = fused.points
    inner = fused.count >= 3
    mesh = mesh_of("blade")
    square, _, _ = igl.point_mesh_squared_distance(in_part[inner], np.array(mesh.vertices), np.array(mesh.faces))
    # Averaging three views or more: the noise of 20 µm falls below 20/√3.
    assert np.median(np.sqrt(square)) < 0.02 / np.sqrt(3)
    assert np.isnan(fused.residual[fused.count == 1]).all()
    assert fused.count.max() <= len(capture.scans)


@pytest.mark.parametrize("effect", [None, "field_curvature", "intensity_bias", "part_growth"])
def test_every_point_is_fused_as_if_all_were_in_memory(blade_capture, effect, monkeypatch):
    """The cells and how many views see each do not depend on normals: they are the same to the last one."""
    measured, _ = blade_capture
    session = session_of(measured)
    whole = registered(session, measured, effect)
    # Standardised over the points in memory, and the model speaks of these: the same numbers on both sides.
    light = registered(thin_session(session, 1500)[0], measured, effect)
    assert all(len(scan.points) == 1500 for scan in light.capture.scans)
    cell = float(np.median([scan.scanned_spacing for scan in light.capture.scans]))
    expected = fuse(whole.capture, whole.poses, cell, part_axes(light.capture.scans, light.poses))
    monkeypatch.setattr("stitch.fusion.fuse._SLAB", 4000)
    found, _ = fuse_every_point(light)
    if effect == "intensity_bias":  # mean and spread of the points in memory are not quite those of all
        assert len(found.points) == pytest.approx(len(expected.points), rel=2e-3)
        return
    assert sorted(found.count) == sorted(expected.count)
    apart, _ = KDTree(expected.points).query(found.points)
    # Weights go by normals, and these are the neighbour's: a mean moves by a part of the cell where they differ.
    assert np.median(apart) < 1e-3 * cell and np.quantile(apart, 0.95) < 0.1 * cell


def test_the_axes_of_the_base_and_the_order_of_views_change_no_point(blade_capture):
    measured, capture = blade_capture
    poses = measured.T_reference_scanner
    turned = frames.exp(np.array([0.4, -1.1, 0.7, 310.0, -120.0, 55.0]))
    backwards = replace(capture, scans=capture.scans[::-1])
    plain, other, reverse = fuse(capture, poses), fuse(capture, turned @ poses), fuse(backwards, poses[::-1])
    assert np.abs(frames.transform(turned, plain.points) - other.points).max() < 1e-9
    assert np.array_equal(plain.count, other.count)
    assert np.abs(plain.points - reverse.points).max() < 1e-9


def test_the_number_of_slabs_does_not_matter(blade_capture, monkeypatch):
    """Nor for how many of them a scan is read at once: no more often than that asks for."""
    measured, _ = blade_capture
    light = registered(thin_session(session_of(measured), 2000)[0], measured)
    reads, read = [], WholeCloud.read
    monkeypatch.setattr(WholeCloud, "read", lambda whole: reads.append(whole.scan.name) or read(whole))
    one, _ = fuse_every_point(light)
    monkeypatch.setattr("stitch.fusion.fuse._SLAB", 1500)
    many, _ = fuse_every_point(light)
    assert len(reads) < 3 * len(light.capture.scans)
    monkeypatch.setattr("stitch.fusion.fuse._AHEAD", 2)
    often, _ = fuse_every_point(light)
    for name in ("points", "normals", "residual", "count"):
        assert np.array_equal(getattr(one, name), getattr(many, name), equal_nan=True)
        assert np.array_equal(getattr(one, name), getattr(often, name), equal_nan=True)
    assert isinstance(many.points, np.memmap) and not isinstance(one.points, np.memmap)


def test_a_scan_that_changes_meanwhile_is_named(session):
    loaded = load_session(session, at_most=300)
    assert loaded.views[2].cloud.count > 300
    file = sorted((session / "clouds").iterdir())[2]
    file.write_bytes(sorted((session / "clouds").iterdir())[1].read_bytes())
    with pytest.raises(InputError, match="view v002 changed on disk during the run; to fix: run again"):
        loaded.views[2].cloud.whole.read()


def test_points_that_stay_in_memory():
    """More views, fewer points each; too little memory is refused with what would do."""
    assert points_within(16e9, 18) == points_within(160e9, 18)
    assert points_within(2e9, 200) < points_within(4e9, 200)
    with pytest.raises(InputError, match=r"1 GB are too little for a run of 200 views; to fix: give \d\.\d GB"):
        points_within(1e9, 200)
    least = 1.2e9 + 200 * 220 * 12_000
    assert points_within(np.ceil(least / 1e8) * 1e8, 200) >= 12_000


def wave(x, y):
    """The surface, 500 before the scanner of the first view."""
    return 500 + 4 * np.sin(x / 15) + 3 * np.cos(y / 20)


def views_of(extra=None, seed=0, half=30.0):
    """Three scans of the wave from either side, with further points (N, 3) of the reference frame in the first one."""
    rng = np.random.default_rng(seed)
    scans, poses = [], []
    for turn in (-0.3, 0.0, 0.3):
        x, y = (g.ravel() for g in np.meshgrid(*[np.arange(-half, half, SPACING)] * 2))
        x, y = x + rng.uniform(-0.2, 0.2, x.shape), y + rng.uniform(-0.2, 0.2, x.shape)
        points = np.column_stack([x, y, wave(x, y) + NOISE * rng.standard_normal(len(x))])
        if extra is not None and not scans:
            points = np.vstack([points, extra])
        around = frames.make(frames.exp(np.array([0, turn, 0, 0, 0, 0]))[:3, :3], np.zeros(3))
        middle = frames.make(np.eye(3), np.array([0.0, 0.0, 500.0]))
        poses.append(middle @ around @ frames.inverse(middle))
        scans.append(prepare_scan(f"v{len(scans)}", frames.transform(frames.inverse(poses[-1]), points)))
    return scans, np.array(poses)


def kept_of(scans, poses):
    """Per point of the first view whether it is kept."""
    support = find_support(scans, poses, place_scans(scans, poses), SPACING)
    return support, support.kept[: len(scans[0].points)]


def test_clean_scans_lose_nothing():
    support, _ = kept_of(*views_of())
    assert support.kept.all()


def test_points_in_the_air_are_alone_and_surface_stays():
    rng = np.random.default_rng(1)
    junk = rng.uniform([-30, -30, 450], [30, 30, 550], (1000, 3))
    scans, poses = views_of(junk)
    support, kept = kept_of(scans, poses)
    surface = len(scans[0].points) - len(junk)
    off = np.abs(junk[:, 2] - wave(*junk[:, :2].T))
    # Slopes reach 0.3, so heights are distances to a twentieth.
    assert kept[surface:][off > 8 * NOISE].mean() < 0.01
    assert kept[:surface].mean() > 0.995
    assert support.alone.sum() > 900


def test_a_body_before_the_part_is_looked_past():
    """Dense and smooth in the view that it stands before; both others see the part behind it."""
    x, y = (g.ravel() for g in np.meshgrid(*[np.arange(-6, 6, SPACING / 2)] * 2))
    body = np.column_stack([x, y, 440 + 0.02 * x**2])
    scans, poses = views_of(body)
    support, kept = kept_of(scans, poses)
    surface = len(scans[0].points) - len(body)
    assert kept[surface:].mean() < 0.01 and support.looked_through.sum() > 0.9 * len(body)
    assert kept[:surface].all()


def test_a_surface_of_one_view_stays_where_no_view_looks_past_it():
    """A ledge beside the part, in the first view alone."""
    x, y = (g.ravel() for g in np.meshgrid(np.arange(60, 80, SPACING), np.arange(-20, 20, SPACING)))
    ledge = np.column_stack([x, y, np.full(len(x), 520.0)])
    _, kept = kept_of(*views_of(ledge))
    assert kept[-len(ledge) :].all()


def test_a_view_from_two_eyes_is_no_witness():
    """Layers behind each other that one eye cannot see: the view says nothing of what it looks past."""
    scans, _ = views_of(half=20.0)
    points = scans[0].points
    twice = prepare_scan("twice", np.vstack([points, points * 1.2]))
    images = range_images([twice, *scans[1:]], [np.ones(len(s.points), bool) for s in (twice, *scans[1:])], SPACING)
    assert images.trusted.tolist() == [False, True, True]


@pytest.fixture(scope="module")
def seen_from_three_sides():
    """Range images of clean scans, and places anywhere about the part."""
    scans, poses = views_of()
    images = range_images(scans, [np.ones(len(s.points), bool) for s in scans], SPACING)
    rng = np.random.default_rng(5)
    places, normals = rng.uniform([-60, -60, 300], [60, 60, 600], (5000, 3)), rng.standard_normal((5000, 3))
    return scans, poses, images, places, normals / np.linalg.norm(normals, axis=1, keepdims=True)


@pytest.mark.parametrize("v", range(3))
def test_a_view_sees_past_what_lies_before_the_surface_within_its_field(seen_from_three_sides, v):
    """Where a ray first meets the surface, which is a formula, within what the scan shows of it."""
    scans, poses, images, places, normals = seen_from_three_sides
    found = images.views_through(scans[v], poses[v], v, places.T.copy(), normals, 3 * SPACING)
    eye = frames.transform(poses[v], scans[v].eye)
    along = np.linspace(1.0, 2.2, 300)[:, None, None] * (places - eye) + eye
    beyond = along[..., 2] > wave(along[..., 0], along[..., 1])
    meets = along[beyond.argmax(axis=0), np.arange(len(places))]
    within = beyond.any(axis=0) & (np.abs(meets[:, :2]) < 26).all(axis=1)
    before = within & (places[:, 2] < wave(*places[:, :2].T) - 20)
    assert before.sum() > 100 and (found[before] == 1).mean() > 0.99
    behind = places[:, 2] > wave(*places[:, :2].T) + 1
    assert not (found[behind] == 1).any()


@pytest.mark.parametrize("v", range(3))
def test_places_that_need_not_be_asked_are_none_that_a_view_speaks_of(seen_from_three_sides, v):
    scans, poses, images, places, normals = seen_from_three_sides
    found = images.views_through(scans[v], poses[v], v, places.T.copy(), normals, 3 * SPACING)
    told = images.may_concern(scans[v], poses[v], places, np.zeros(len(places)))
    assert told[found > 0].all() and 0 < told.sum() < len(places)
    balls = places.reshape(-1, 50, 3)
    centres = balls.mean(axis=1)
    radii = np.linalg.norm(balls - centres[:, None], axis=2).max(axis=1)
    assert images.may_concern(scans[v], poses[v], centres, radii)[(found.reshape(-1, 50) > 0).any(axis=1)].all()


@pytest.mark.parametrize("size", [0.3, 7.0])
def test_numbers_of_cells_tell_cells_apart_and_keep_their_order(size):
    points = np.random.default_rng(2).normal(0, 20, (500, 3))
    cells = cell_numbers(points, size)
    expected = np.unique(np.floor(points / size), axis=0, return_inverse=True)[1]
    different, at = np.unique(cells, return_inverse=True)
    assert np.array_equal(at, np.ravel(expected)) and np.array_equal(different[at], cells)
