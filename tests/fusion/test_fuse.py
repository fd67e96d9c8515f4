"""What is fused lies on the part, and is every point, as if all had been in memory."""

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
from stitch.fusion.fuse import RegisteredSession, fuse, fuse_every_point, part_axes
from stitch.model.forward import corrected_capture
from stitch.model.model import Model, term_of
from stitch.numerics import frames
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of
from stitch.session.reading.session_folder import load_session
from stitch.session.session import WholeCloud
from stitch.session.thinning import points_within, thin_session


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
def test_every_point_is_fused_as_if_all_were_in_memory(blade_capture, effect):
    """The cells and how many views see each do not depend on normals: they are the same to the last one."""
    measured, _ = blade_capture
    session = session_of(measured)
    whole = registered(session, measured, effect)
    # Standardised over the points in memory, and the model speaks of these: the same numbers on both sides.
    light = registered(thin_session(session, 1500)[0], measured, effect)
    assert all(len(scan.points) == 1500 for scan in light.own.scans)
    cell = float(np.median([scan.scanned_spacing for scan in light.own.scans]))
    expected = fuse(whole.own, whole.poses, cell, part_axes(light.own.scans, light.poses))
    found, _ = fuse_every_point(light, slab=4000)
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
    one, many = (fuse_every_point(light, slab=slab)[0] for slab in (10**9, 1500))
    assert len(reads) < 3 * len(light.own.scans)
    monkeypatch.setattr("stitch.fusion.fuse._AHEAD", 2)
    often, _ = fuse_every_point(light, slab=1500)
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
