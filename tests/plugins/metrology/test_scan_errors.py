"""Smooth errors that are new in each scan, against those that a simulator of its own put into the scans."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import clean, simulated
from data_synth.scanner import Scanner, scan_waves
from data_synth.shapes.spheres import SpherePlate
from stitch.api.pipeline import run
from stitch.plugins.metrology.error_sources import place_errors


def _measured_errors(size: float, length: float, seed: int):
    scene = clean("spheres", rays=90, noise=0.02, scan_error=size, scan_error_length=length)
    part = replace(scene.part, labelled=False, parameters={"radius": SpherePlate(radius=28.0).radius})
    scene = replace(scene, part=part, repeatability=(15e-6, 0.01))
    return place_errors(run(session_of(simulated(scene, {}, seed, views=6)))).scan_errors


@pytest.mark.parametrize(("size", "length", "seed"), [(0.01, 0.1, 3), (0.02, 0.2, 4)])
def test_the_overlaps_show_how_large_errors_of_single_scans_are(size, length, seed):
    errors = _measured_errors(size, length, seed)
    # Some thirty patches of a length in each of six scans, of which poses take up a part: a sigma known to a tenth.
    assert 0.6 < errors.size / size < 1.4


def test_the_modes_hold_the_variance_and_the_correlation_of_what_the_simulator_draws():
    errors = _measured_errors(0.02, 0.15, 5)
    scanner = Scanner(field_of_view=48.0, field_of_view_y=40.0, scan_error=errors.size, scan_error_length=0.15)
    rays = np.column_stack([np.linspace(-0.3, 0.3, 7), np.full(7, 0.05), np.ones(7)])
    modes = errors.along(rays)
    drawn = np.array([scan_waves(scanner, rays, np.random.default_rng(k)) for k in range(4000)])
    modelled, simulated_covariance = modes @ modes.T, np.cov(drawn.T)
    # The field is cut into modes, and the length is one of few: variances within a third, far places independent.
    assert np.abs(np.diag(modelled) / np.diag(simulated_covariance) - 1).max() < 0.35
    assert np.abs(modelled[0, 4:]).max() < 0.15 * errors.size**2


def test_the_order_of_the_views_changes_nothing(monkeypatch):
    scene = clean("spheres", rays=60, noise=0.02, scan_error=0.02, scan_error_length=0.2)
    session = session_of(simulated(replace(scene, repeatability=(15e-6, 0.01)), {}, 6, views=5))
    views = [replace(view, time_s=None) for view in session.views]
    # Half of the pairs, so that it counts which they are.
    monkeypatch.setattr("stitch.plugins.metrology.scan_errors._MOST_PAIRS", 5)
    sizes = [place_errors(run(replace(session, views=tuple(order)))).scan_errors.size for order in (views, views[::-1])]
    assert sizes[0] == pytest.approx(sizes[1], rel=1e-6)
