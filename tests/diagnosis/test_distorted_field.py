"""A scanner that errs as no effect of the library does, by its axes or with a seam in its field: none is named."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.blade_cells import captured, measured_blade
from data_synth.fixtures.in_memory import session_of
from stitch.api.pipeline import run
from stitch.diagnosis.diagnose import diagnose_state
from stitch.effects.empirical import FIELD, empirical_effects
from stitch.session.measurement import measurement_of


def said_of(measured, seen=lambda points: points):
    """The diagnosis of a run in which the scanner reports true points (N, 3) so."""
    clouds = [replace(c, points=seen(c.points)) for c in measured.clouds]
    return diagnose_state(run(session_of(replace(measured, clouds=clouds))))


@pytest.fixture(scope="module")
def measured():
    return measured_blade(4, views=9, pixels=50)


def tilted(points):
    """A focus that is bent to two corners: 0.3 mm along the ray at them."""
    ray = points / np.linalg.norm(points, axis=1, keepdims=True)
    field = points[:, :2] / points[:, 2:]
    return points + 0.3 * np.prod(field / np.abs(field).max(axis=0), axis=1, keepdims=True) * ray


@pytest.mark.parametrize(
    "seen",
    [
        pytest.param(lambda points: points * [1, 1, 1.01], id="longer", marks=pytest.mark.slow),
        pytest.param(lambda points: points + 0.01 * points[:, [1]] * [1, 0, 0], id="askew", marks=pytest.mark.slow),
        pytest.param(tilted, id="tilted"),
    ],
)
def test_a_scanner_of_bad_axes_or_focus_gets_no_name(measured, seen):
    found = said_of(measured, seen)
    assert found.verdict == "unknown_effect" and not found.effects
    assert "where in the scanner's field a point is seen" in found.sentence
    assert "pose errors dominate" not in found.sentence


def test_a_good_scanner_is_not_accused(measured):
    found = said_of(measured)
    assert not found.follows_field and not found.overlap_misfit


@pytest.mark.slow
def test_a_seam_in_the_field_is_not_adequate(measured):
    """One half of the field is off by ±0.3 mm along the ray, which no effect of the library and no pose can do."""

    def seen(points):
        ray = points / np.linalg.norm(points, axis=1, keepdims=True)
        return points + 0.3 * np.sign(points[:, :1]) * ray

    found = said_of(measured, seen)
    assert found.verdict == "unknown_effect" and 0.06 < found.overlap_misfit < 0.6
    assert "However each view is moved" in found.sentence


def test_points_move_by_the_polynomial_that_is_stated(measured):
    """z off by c·(x/z)·(y/z) and x by c·(r/r₀ − 1)², worked out for single points."""
    view = measurement_of(session_of(measured), captured(measured)).scan_views[0]
    field = next(e for e in empirical_effects(view.views) if e.name == FIELD)
    points, r0 = np.array([[30.0, -40.0, 400.0], [0.0, 0.0, 500.0]]), view.views.standoff
    zero = dict.fromkeys(field.specs, 0.0)
    moved = field.function(points, view, **zero | {"c2_ab": 2.0, "c0_dd": 3.0}) - points
    r = np.linalg.norm(points, axis=1)
    assert moved[:, 2] == pytest.approx(2.0 * points[:, 0] * points[:, 1] / points[:, 2] ** 2)
    assert moved[:, 0] == pytest.approx(3.0 * (r / r0 - 1) ** 2)
    assert np.all(moved[:, 1] == 0)
