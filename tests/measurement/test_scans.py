"""Normals, noise and thinning of scans against a sphere and against all points."""

import numpy as np
import pytest

from data_synth.fixtures.in_memory import session_of
from stitch.effects import EFFECTS
from stitch.effects.in_session import lacking
from stitch.measurement.measurement import measurement_of
from stitch.measurement.scan import prepare_view


def test_normals_and_noise_of_a_sphere():
    """Normals point along the radius and the noise is the one put in."""
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(20000, 3)) * [1, 1, 0.3] - [0, 0, 2]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points = np.array([0, 0, 400.0]) + direction * (40 + 0.03 * rng.standard_normal(len(direction)))[:, None]
    scan = prepare_view("s", points)
    inner = scan.usable
    assert inner.mean() > 0.5
    assert np.median(np.einsum("ij,ij->i", scan.normals, direction)[inner]) > 0.995
    assert scan.noise == pytest.approx(0.03, rel=0.04)


def test_a_thinned_scan_keeps_the_surface_of_all_points(blade_capture):
    """Fewer points, the normals and edges of all of them; what is small enough already stays as it is."""
    measured, capture = blade_capture
    whole = capture.scans[0]
    index = np.arange(0, len(whole.points), 3)
    scan = prepare_view("v", whole.points, index)
    assert np.array_equal(scan.points, whole.points[index])
    assert np.array_equal(scan.normals, whole.normals[index]) and np.array_equal(scan.usable, whole.usable[index])
    assert scan.spacing > whole.spacing and scan.area.sum() == pytest.approx(whole.area.sum(), rel=0.02)
    assert np.array_equal(prepare_view("v", whole.points, np.arange(len(whole.points))).normals, whole.normals)


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_an_intensity_that_is_not_finite_counts_as_none(blade_capture, wrong):
    measured, capture = blade_capture
    session = session_of(measured)
    assert measurement_of(session, capture).has_intensity
    assert session.views[1].cloud is not None
    session.views[1].cloud.scalars["intensity"] = np.full(len(session.views[1].cloud.points), 0.5)
    session.views[1].cloud.scalars["intensity"][3] = wrong
    measurement = measurement_of(session, capture)
    assert not measurement.has_intensity and lacking(measurement, EFFECTS["intensity_bias"]) == ("intensity",)
