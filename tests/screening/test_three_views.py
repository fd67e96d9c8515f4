"""Three views, or four, cannot tell which of them is off, but that something is."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.in_memory import session_of
from stitch.api.pipeline import run
from stitch.screening.plausibility import check_few_views
from stitch.session.session import Cloud


@pytest.fixture(scope="module")
def good():
    return session_of(measured_blade(22, views=3, pixels=80))


def test_three_views_that_agree_raise_no_doubt(good):
    assert run(good).doubts == ()


def test_one_of_three_views_that_is_off_is_doubted_and_none_accused(good):
    first, off, last = good.views
    found = run(
        replace(good, views=(first, replace(off, cloud=Cloud(off.cloud.points + np.array([0.0, 2.0, 1.0]))), last))
    )
    assert found.left_out == () and len(found.doubts) == 1
    assert found.doubts[0].startswith("Three poses contradict their scans by")
    assert "three do not show which" in found.doubts[0]


def test_four_views_of_which_one_is_off_by_less_than_a_millimetre_are_doubted():
    good = session_of(measured_blade(22, views=4, pixels=60))
    first, off, *rest = good.views
    moved = replace(off, cloud=Cloud(off.cloud.points + np.array([0.0, 0.36, 0.2])))
    found = run(replace(good, views=(first, moved, *rest)))
    assert found.left_out or found.doubts[0].startswith("Four poses contradict their scans by")


def test_views_that_nothing_can_be_tested_by_say_so():
    """As many numbers as one hand-eye takes up: flat parts of which every overlap shows three."""
    search = SimpleNamespace(null_projector=SimpleNamespace(degrees=0))
    found = SimpleNamespace(left_out=(), suspected=(), blunder_search=search)
    session = SimpleNamespace(views=range(3), length_unit="mm")
    assert check_few_views(session, found).startswith("No test says whether these three views belong together")
