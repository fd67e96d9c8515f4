"""How well means of bins are known: views are the samples, and Student's t knows how few they are."""

import numpy as np
import pytest
from scipy import stats

from stitch.output.comparison.residual_tables import view_statistics

ROWS = 1000.0  # of a view


def sums_by_view(errors, bins, size):
    """(B, V) counts, sums and sums of squares of views that lie in one bin each, without noise of their rows."""
    within = (bins == np.arange(size)[:, None]) * ROWS
    return within, within * errors, within * errors**2


def test_the_p_value_is_that_of_students_t_of_the_views_in_a_bin_against_the_others():
    errors = np.random.default_rng(1).normal(size=12)
    errors -= errors.mean()
    bins = np.arange(12) % 5
    found = view_statistics(*sums_by_view(errors, bins, 5))
    for b in range(5):
        expected = stats.ttest_ind(errors[bins == b], errors[bins != b])
        assert found.p_value[b] == pytest.approx(expected.pvalue)
        assert found.mean[b] / found.mean_sigma[b] == pytest.approx(expected.statistic)


def test_seven_views_in_six_bins_are_no_clearer_than_chance_says():
    rng, bins = np.random.default_rng(2), np.array([0, 1, 2, 3, 4, 5, 5])
    p, sigmas = [], []
    for _ in range(600):
        errors = rng.normal(scale=12.0, size=7)
        found = view_statistics(*sums_by_view(errors - errors.mean(), bins, 6))
        p.append(found.p_value)
        sigmas.append(found.mean_sigma[0])
    # Of 3600 means, five in a hundred.
    assert np.mean(np.array(p) < 0.05) == pytest.approx(0.05, abs=0.012)
    # One view of seven, off by its scatter of 12 less what all have in common.
    assert np.sqrt(np.mean(np.square(sigmas))) == pytest.approx(12 * np.sqrt(6 / 7), rel=0.1)


def test_points_of_a_view_are_no_samples_where_all_views_lie_in_all_bins():
    rng, small = np.random.default_rng(3), []
    for _ in range(400):
        means = rng.normal(scale=12.0, size=(6, 8)) + rng.normal(scale=3.0, size=8)
        means -= means.mean()
        n = np.full(means.shape, ROWS)
        small.append(view_statistics(n, n * means, n * (means**2 + 900)).p_value < 0.05)
    assert np.mean(small) == pytest.approx(0.05, abs=0.015)


def test_a_bin_without_samples_says_nothing_and_two_views_cannot_be_told_apart():
    n = np.array([[5.0, 0.0], [100.0, 200.0]])
    found = view_statistics(n, n * 2, n * 4, enough=30)
    assert np.isnan(found.p_value[0]) and found.views.tolist() == [0, 2]
    alone = view_statistics(*sums_by_view(np.array([1.0, -1.0]), np.array([0, 1]), 2))
    assert np.isnan(alone.mean_sigma).all() and np.isnan(alone.p_value).all()


def test_a_direction_chosen_for_being_clear_is_less_clear():
    rng, bins, small = np.random.default_rng(4), np.repeat([0, 1], 5), []
    for _ in range(400):
        offsets = rng.normal(size=(10, 3))
        offsets -= offsets.mean(axis=0)
        apart = offsets[bins == 0].mean(axis=0)
        sums = sums_by_view(offsets @ apart / np.linalg.norm(apart), bins, 2)
        small.append([view_statistics(*sums, directions=k).p_value[0] < 0.05 for k in (1, 3)])
    as_if_given, chosen = np.mean(small, axis=0)
    assert chosen <= 0.06 < 0.15 < as_if_given
