"""What the next view is chosen for, and what is known of views not taken yet."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import Growth, labelled_cell
from stitch.diagnosis import next_view
from stitch.diagnosis.candidate_views import candidate_measurement
from stitch.effects.contract import EFFECTS
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of


def test_views_not_taken_yet_come_after_those_that_were():
    """Temperatures count from the session's first view, an event before them has happened, a scan at rest has no delay."""
    session, *_ = labelled_cell(2, views=9, grown=Growth(0.0, 0.0))
    speeds = {f"j{i + 1}_velocity_deg_s": 5.0 for i in range(6)}
    session = replace(session, views=tuple(replace(v, covariates=v.covariates | speeds) for v in session.views))
    measurement = measurement_of(session, prepare_capture(session))
    later = candidate_measurement(measurement, measurement.views.joints[:3] + 0.1).views
    warmth = [v.covariates["part_temperature_c"] for v in session.views]
    np.testing.assert_allclose(later.since_first("part_temperature_c"), warmth[-1] - warmth[0])
    assert EFFECTS["part_slip"].function(later, xi=np.ones(6), v=8.0).all()
    assert not (EFFECTS["latency"].function(later.joints, later, dt=1.0) - later.joints).any()


def test_the_next_view_serves_the_two_that_stay_most_alike(monkeypatch):
    """Of three suspects no two may stay together, however well others come apart."""
    gains = {"ab": [9, 2, 0], "ac": [0, 2, 9], "bc": [0, 3, 9]}

    class CandidateEffect:
        def __init__(self, name):
            self.name = name

    def of_two(evidence, a, b):
        return np.radians([[10.0], [20.0], [30.0]]), 0.4, np.array(gains[a.name + b.name], float)

    monkeypatch.setattr(next_view, "_gains", of_two)
    joints, count, separated = next_view._best_pose(None, [CandidateEffect(name) for name in "abc"])
    assert joints == pytest.approx([20.0])
    assert count == 3 and separated == ("a", "b", "c")  # (5.4 − 0.4)/2
