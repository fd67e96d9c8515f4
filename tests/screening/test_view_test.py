"""Tests of single views against closed forms, published numbers and a generator of chance."""

import numpy as np
import pytest
from scipy import stats

from stitch.numerics.reml import at_variances
from stitch.screening.pose_tests import find_blunders
from stitch.screening.view_model import projector, test_alternative
from tests.screening.direct_views import direct_views, with_z

test_alternative.__test__ = False  # a function of the library, not a case
VIEWS, SIGMA = 20, 0.02


def direct(seed=0, views=VIEWS):
    return direct_views(SIGMA * np.random.default_rng(seed).standard_normal(6 * views))


def known(model):
    """The null hypothesis with the scatter that was put in."""
    fit = at_variances(model.mixed(), np.array([SIGMA**2, SIGMA**2, 1.0]))
    return fit, projector(model, fit)


def test_statistic_is_the_drop_of_least_squares():
    model = direct()
    _, under = known(model)
    whitened = model.z / SIGMA
    null = whitened - model.hand_eye @ np.linalg.lstsq(model.hand_eye, whitened, rcond=None)[0]
    both = np.column_stack([model.hand_eye, model.views[3]])
    free = whitened - both @ np.linalg.lstsq(both, whitened, rcond=None)[0]
    assert test_alternative(under, model.views[3]).statistic == pytest.approx(null @ null - free @ free, rel=1e-4)


@pytest.mark.slow
def test_good_views_stay_and_several_blunders_do_not_hide_each_other():
    false = sum(bool(find_blunders(direct(seed)).blunders) for seed in range(20))
    assert false <= 2  # at 1 % each, three of twenty happen once in a thousand
    model = direct(3)
    z = np.array(model.z)
    for v in (2, 7, 11):
        z[6 * v + 3] += 40 * SIGMA
    found = find_blunders(with_z(model, z))
    assert {b.view for b in found.blunders} == {2, 7, 11}
    assert np.sqrt(found.fit.variances[1]) < 1.5 * SIGMA


def test_one_of_six_views_does_not_hide_in_a_scatter_that_it_inflates():
    """Rotations scatter little, and one view is off by ten times that of the translations."""
    quiet = np.tile([1e-3, 1e-3, 1e-3, 1, 1, 1], 6)
    for seed in range(10):
        model = direct(seed, views=6)
        z = model.z * quiet + model.views[2] @ np.array([0, 0, 0, 10 * SIGMA, 0, 0])
        assert [b.view for b in find_blunders(with_z(model, z)).blunders] == [2]


@pytest.mark.slow
def test_few_views_without_blunders_are_left_alone():
    """1 % is stated: what 999 of 1,000 repetitions stay below."""
    quiet, alarms = np.tile([1e-3, 1e-3, 1e-3, 1, 1, 1], 6), 0
    for seed in range(200):
        model = direct(1000 + seed, views=6)
        alarms += bool(find_blunders(with_z(model, model.z * (quiet if seed % 2 else 1))).blunders)
    assert alarms <= stats.binom.isf(1e-3, 200, 0.01)
