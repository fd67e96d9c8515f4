"""U of few views says on how little it rests; of more views it does not."""

from dataclasses import replace

import numpy as np
import pytest

from stitch.fit.coarse import CoarseHandEye
from stitch.fit.sentences import warnings
from stitch.observations.surfaces.hand_eye_fit import HandEyeFit

FIT = HandEyeFit(np.eye(4), np.eye(6), 1.0, (), 1.0)
START = CoarseHandEye(np.eye(4), 1.0, "stated", ())


@pytest.mark.parametrize(("views", "said"), [(4, True), (6, True), (7, False), (18, False)])
def test_few_degrees_of_freedom_are_said(views, said):
    """Views show six numbers each, less what all have in common and the hand-eye."""
    notes = warnings(START, replace(FIT, degrees=6 * views - 12))
    assert any(f"rests on {6 * views - 12} degrees" in note for note in notes) == said


def test_the_covariance_of_another_run_rests_on_its_views():
    assert not warnings(START, FIT)
