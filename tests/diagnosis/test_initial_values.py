"""Where a fit of an effect begins."""

from dataclasses import replace

import pytest

from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import simulated
from data_synth.scene import load_scene
from stitch.api.pipeline import run


@pytest.mark.slow
def test_a_slip_that_the_run_is_told_of_is_found_where_it_was():
    scene = load_scene("drill-plate")
    scene = replace(scene, scanner=replace(scene.scanner, columns=50, rows=50))
    measured = simulated(scene, {"part_slip": 4.0}, 5, views=12)
    true = measured.hidden["part_slip"]["v"]
    assert true != 6  # the middle, where a fit that does not look would begin
    found = run(session_of(measured), effects=["part_slip"])
    (term,) = found.terms
    (place,) = (p for p in term.parameters if p.name == "v")
    assert place.value == true and str(place.formatted) == session_of(measured).names[int(true)]
