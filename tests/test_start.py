"""Where a fit begins, and what the next view is chosen for."""

from dataclasses import replace

import numpy as np
import pytest
from in_memory import session_of

from data_synth.scene import load_scene
from data_synth.simulate import simulate
from stitch.diagnosis.design import next_view
from stitch.pipeline import run


def test_a_slip_that_the_run_is_told_of_is_found_where_it_was():
    scene = load_scene("drill-plate")
    scene = replace(scene, scanner=replace(scene.scanner, columns=50, rows=50))
    measured = simulate(scene, {"part_slip": 4.0}, 5, views=12)
    true = measured.hidden["part_slip"]["v"]
    assert true != 6  # the middle, where a fit that does not look would begin
    found = run(session_of(measured), effects=["part_slip"])
    (term,) = found.terms
    names = [p.name for p in found.measurement.parameters(term.effect)]
    assert term.values[names.index("v")] == true


def test_the_next_view_serves_the_two_that_stay_most_alike(monkeypatch):
    """Of three suspects no two may stay together, however well others come apart."""
    gains = {"ab": [9, 2, 0], "ac": [0, 2, 9], "bc": [0, 3, 9]}

    class CandidateEffect:
        def __init__(self, name):
            self.name = name

    def of_two(evidence, a, b):
        return next_view._Gains(0.4, np.radians([[10.0], [20.0], [30.0]]), np.array(gains[a.name + b.name], float))

    monkeypatch.setattr(next_view, "_gains", of_two)
    joints, count, separated = next_view._best_pose(None, [CandidateEffect(name) for name in "abc"])
    assert joints == pytest.approx([20.0])
    assert count == 3 and separated == ("a", "b", "c")  # (5.4 − 0.4)/2
