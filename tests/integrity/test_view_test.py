"""Tests of single views against closed forms, published numbers and a generator of chance."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from stitch.integrity.blunders import find_blunders
from stitch.integrity.reliability import blunder_sizes, noncentrality, normal_blocks, reliability
from stitch.integrity.view_model import ViewModel, projector
from stitch.integrity.view_test import test
from stitch.statistics.variance_components import at_variances

test.__test__ = False  # a function of the library, not a case
VIEWS, SIGMA = 20, 0.02


def direct(seed=0, views=VIEWS):
    """Every pose is observed directly; the mean of all is the unknown hand-eye: everything has a closed form."""
    rng = np.random.default_rng(seed)
    blocks = np.zeros((views, 6 * views, 6))
    for v in range(views):
        blocks[v, 6 * v : 6 * v + 6] = np.eye(6)
    eye = np.tile(np.eye(6), (views, 1, 1))
    noise = 1e-8 * np.eye(6 * views)
    z = SIGMA * rng.standard_normal(6 * views)
    return ViewModel(z, blocks.sum(axis=0), blocks, eye, blocks, eye, noise, np.zeros(3), 1.0)


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
    assert test(under, model.views[3]).statistic == pytest.approx(null @ null - free @ free, rel=1e-4)


def test_redundancy_of_directly_observed_poses_is_one_less_their_share_of_the_mean():
    model = direct()
    found = find_blunders(model)
    fit, under = known(model)
    for view in reliability(model, replace(found, fit=fit, under=under, further=None)):
        assert np.allclose(view.redundancy, 1 - 1 / VIEWS, atol=1e-4)
        assert view.weak == ()


def test_noncentrality_is_baardas():
    """λ₀ = 17.07 for one degree of freedom, α = 0.1 % and a power of 80 % (Baarda 1968)."""
    assert noncentrality(1, 10) == pytest.approx(17.07, abs=0.01)


def test_blunder_of_the_detectable_size_is_found_and_named_as_often_as_stated():
    model = direct()
    _fit, under = known(model)
    normal = normal_blocks(model, replace(find_blunders(model), under=under))
    rng, found, named, trials = np.random.default_rng(1), 0, 0, 300
    limit = stats.chi2.isf(0.01 / VIEWS, 6)
    for _ in range(trials):
        v, direction = int(rng.integers(VIEWS)), rng.standard_normal(6)
        detectable, identifiable = (size[0] for size in blunder_sizes(normal, v, direction[None]))
        for size in (detectable, 2 * identifiable):
            z = SIGMA * rng.standard_normal(6 * VIEWS) + model.views[v] @ (size * direction)
            own = replace(under, pushed=under.P @ z)
            values = [test(own, columns).statistic for columns in model.views]
            if size == detectable:
                found += values[v] > limit
            else:
                named += int(np.argmax(values)) == v
    # Binomial: 80 % ± 3 sigma of 300 trials; at twice the identifiable size at least the promised 95 %.
    assert abs(found / trials - 0.8) < 3 * np.sqrt(0.16 / trials)
    assert named / trials >= 0.95


@pytest.mark.slow
def test_good_views_stay_and_several_blunders_do_not_hide_each_other():
    false = sum(bool(find_blunders(direct(seed)).blunders) for seed in range(20))
    assert false <= 2  # at 1 % each, three of twenty happen once in a thousand
    model = direct(3)
    z = np.array(model.z)
    for v in (2, 7, 11):
        z[6 * v + 3] += 40 * SIGMA
    found = find_blunders(replace(model, z=z))
    assert {b.view for b in found.blunders} == {2, 7, 11}
    assert np.sqrt(found.fit.variances[1]) < 1.5 * SIGMA


def test_one_of_six_views_does_not_hide_in_a_scatter_that_it_inflates():
    """Rotations scatter little, and one view is off by ten times that of the translations."""
    quiet = np.tile([1e-3, 1e-3, 1e-3, 1, 1, 1], 6)
    for seed in range(10):
        model = direct(seed, views=6)
        z = model.z * quiet + model.views[2] @ np.array([0, 0, 0, 10 * SIGMA, 0, 0])
        assert [b.view for b in find_blunders(replace(model, z=z)).blunders] == [2]


@pytest.mark.slow
def test_few_views_without_blunders_are_left_alone():
    """1 % is stated: what 999 of 1,000 repetitions stay below."""
    quiet, alarms = np.tile([1e-3, 1e-3, 1e-3, 1, 1, 1], 6), 0
    for seed in range(200):
        model = direct(1000 + seed, views=6)
        alarms += bool(find_blunders(replace(model, z=model.z * (quiet if seed % 2 else 1))).blunders)
    assert alarms <= stats.binom.isf(1e-3, 200, 0.01)
