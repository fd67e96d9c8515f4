"""What "adequate" is measured against: the repeatability that a session states, or what is usual."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import labelled_cell
from stitch.api.pipeline import diagnose, run
from stitch.diagnosis.score import scatter_limit
from stitch.session.session import StatedRepeatability


def test_repeatability_of_iso_9283_from_drawn_poses():
    """RP = mean + 3 standard deviations of the distances from the barycentre, for 0.02 mm of scatter a coordinate."""
    distances = np.linalg.norm(np.random.default_rng(1).normal(0, 0.02, (400_000, 3)), axis=1)
    stated = StatedRepeatability(position=float(distances.mean() + 3 * distances.std()))
    assert stated.sigma_translation == pytest.approx(0.02, rel=5e-3)
    assert StatedRepeatability(rotation=3e-4).sigma_rotation == pytest.approx(1e-4)


@pytest.mark.parametrize("unit", ["mm", "m"])
def test_a_stated_repeatability_takes_the_place_of_the_usual_one(unit):
    session, *_ = labelled_cell(5, views=10)
    usual = scatter_limit(replace(session, length_unit=unit))
    assert usual.translation == pytest.approx(0.12 if unit == "mm" else 0.12e-3) and not usual.stated
    stated = scatter_limit(replace(session, length_unit=unit, repeatability=StatedRepeatability(position=0.1)))
    assert stated.translation < 0.1 and stated.stated and stated.rotation == usual.rotation


def test_scatter_beyond_what_is_stated_is_not_adequate():
    """The cell's arm scatters by 20 µm a coordinate, RP 72 µm: stated as 80 µm it is adequate, as 20 µm it is not."""
    session, *_ = labelled_cell(5, views=24, scatter=(1e-5, 0.02))
    found = run(session)
    told = {
        stated: diagnose(replace(found, session=replace(session, repeatability=StatedRepeatability(position=stated))))
        for stated in (None, 0.08, 0.02)
    }
    assert told[None].verdict == "adequate" and "No repeatability is stated" in told[None].sentence
    assert told[0.08].verdict == "adequate" and "The stated repeatability allows" in told[0.08].sentence
    assert told[0.02].verdict == "unknown_effect" and "(stated: up to" in told[0.02].sentence
