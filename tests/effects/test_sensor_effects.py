"""Effects of the sensor do not depend on which way its frame looks."""

import numpy as np
import pytest

from data_synth.fixtures.in_memory import session_of
from stitch.effects import EFFECTS
from stitch.model.model import term_of
from stitch.session.measurement import measurement_of


@pytest.mark.parametrize(
    "name", [n for n, e in EFFECTS.items() if e.place == "sensor" and e.needs in ((), ("intensity",))]
)
def test_a_scanner_that_looks_along_minus_z_has_the_same_errors(blade_capture, name):
    """Turning the scanner's frame by 180° about x turns every effect of the scanner with it."""
    measured, capture = blade_capture
    measurement, effect, turn = measurement_of(session_of(measured), capture), EFFECTS[name], np.diag([1.0, -1.0, -1.0])
    term = term_of(measurement, effect)
    arguments = term.at(term.typical).arguments
    points = capture.scans[0].points
    moved = effect.function(points, measurement.scan_views[0], **arguments)
    assert np.abs(moved - points).max() > 1e-3
    assert np.allclose(effect.function(points @ turn, measurement.scan_views[0], **arguments) @ turn, moved, atol=1e-12)
