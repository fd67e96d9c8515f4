"""What a flange does in a course of time is what it was made to do, and reads so."""

import numpy as np
import pytest

from stitch.diagnosis.sentences import time_curve_sentence
from stitch.diagnosis.unmodelled_time_effects import TimeCurve, significant_time_effect, time_curve
from stitch.numerics import frames
from tests.diagnosis.freed_blade import freed_blade

VIEWS = 18
# Of the flange in its own frame, rad and mm.
DIRECTION = np.array([2.2e-4, -1.5e-4, 2.8e-4, 0.08, 0.05, -0.07])


@pytest.fixture(scope="module", params=["eye_to_hand", pytest.param("eye_in_hand", marks=pytest.mark.slow)])
def cell(request):
    return freed_blade(5, VIEWS, request.param)


def shown(cell, course, direction):
    """The curve found where the flange errs along a direction (6,), and by how many sigmas it is off at the views that
    err, (·, 6)."""
    errors = course[:, None] * direction
    linear = cell.seen(cell.measured.T_base_flange @ frames.exp(errors))
    fitted = significant_time_effect(linear)
    assert fitted is not None
    curve = time_curve(fitted)
    at_views = slice(None, None, (len(curve.steps) - 1) // (VIEWS - 1))
    off = (curve.error[at_views] - errors) / np.maximum(curve.sigma[at_views], 1e-300)
    return curve, off[np.abs(course) > 0.2]


def in_steps(cell):
    """Times of the views in median steps, by numpy alone."""
    time = cell.measurement.views.time
    return (time - time[0]) / np.median(np.diff(time))


@pytest.mark.parametrize("period", [4.3, 7.1])
def test_a_swing_is_drawn_as_it_was(cell, period):
    curve, off = shown(cell, np.sin(2 * np.pi * in_steps(cell) / period + 1.0), DIRECTION)
    assert np.sqrt(np.mean(off**2)) < 2.0
    for of in (slice(3), slice(3, 6)):
        _, most, sigma = curve.largest(of)
        assert abs(most - np.linalg.norm(DIRECTION[of])) < 4 * sigma


def test_a_stretch_is_drawn_where_it_was(cell):
    time = in_steps(cell)
    curve, off = shown(cell, np.exp(-0.5 * ((time - time[9]) / 1.5) ** 2), 2 * DIRECTION)
    assert np.sqrt(np.mean(off**2)) < 2.0
    assert curve.steps[curve.largest(slice(3, 6))[0]] == pytest.approx(time[9], abs=1.0)


def test_it_reads_with_its_sizes_and_places():
    error, sigma = np.zeros((3, 6)), np.full((3, 6), 1e-5)
    error[1, :3], error[2, 3:], sigma[:, 3:] = (0, 3e-4, 4e-4), (0.06, -0.08, 0), 0.01
    curve = TimeCurve(np.array([2.0, 4.0, 6.0]), 90.0, error, sigma)
    assert "0.1 ± 0.01 mm 6 min into the session, and turned by up to 0.5 ± 0.01 mrad 3 min" in time_curve_sentence(
        curve, "mm"
    )
    by_number = TimeCurve(curve.steps, 0.0, error, sigma)
    assert "mm at view 4, and turned by up to 0.5 ± 0.01 mrad at view 2" in time_curve_sentence(by_number, "mm")
