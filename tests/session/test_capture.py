"""Labelled points of many views, of which each lends some."""

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import labelled_cell
from stitch.session.capture import sightings_of


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_each_view_lends_some_of_its_points_and_all_targets_stay_in(count):
    session, *_ = labelled_cell(views=12)
    whole = sightings_of(session)
    some = whole.at_most(count)
    targets = len(whole.targets)
    assert some.target.shape[1] == min(count, targets)
    assert (some.used.sum(axis=1) == min(count, targets)).all()
    assert set(some.target[some.used]) == set(range(targets))
    for view, slot in zip(*np.nonzero(some.used), strict=True):
        seen = whole.target[view] == some.target[view, slot]
        assert np.array_equal(some.points[view, slot], whole.points[view][seen][0])
