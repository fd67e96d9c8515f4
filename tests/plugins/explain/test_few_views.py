"""So few views that none of them can test what others suggest: that is said, and nothing else."""

import pytest

from stitch.plugins.explain.explain import explain
from tests.diagnosis.freed_blade import freed_blade
from tests.plugins.explain.test_explain import coupling, evidence

SAID = "Nothing can be said from {} views"


@pytest.mark.parametrize("views", [2, 3, 4])
def test_of_few_scans_nothing_is_said(views):
    cell = freed_blade(6, views)
    found = explain(cell.seen(cell.measured.T_base_flange))
    assert not found.found and found.why.startswith(SAID.format(views))


@pytest.mark.parametrize("views", [3, 5])
def test_of_few_sightings_nothing_is_said(views):
    assert explain(evidence(1, coupling, views=views)).why.startswith(SAID.format(views))


def test_three_views_of_either_half_may_say_something():
    assert explain(evidence(1, coupling, views=6)).why.startswith("No formula holds")
