"""Run lengths of charts against published ones, and against charts that run."""

import numpy as np
import pytest

from stitch.plugins.watch.control_charts import (
    CUSUM_REFERENCES,
    EWMA_WEIGHT,
    chart_limits,
    cusum_limit,
    cusum_run_length,
    empty_charts,
    ewma_limit,
    ewma_run_length,
    limit_shares,
    updated_charts,
)


# Montgomery, Introduction to Statistical Quality Control, table 9.3 and 9.4: both sides together, from Brook & Evans.
@pytest.mark.parametrize(
    ("limit", "shift", "published"), [(4, 0, 168), (5, 0, 465), (5, 0.5, 38.0), (5, 1, 10.4), (4, 2, 3.34)]
)
def test_cusum_run_lengths_are_the_published_ones(limit, shift, published):
    up, down = (cusum_run_length(0.5, limit, side * shift) for side in (1, -1))
    assert 1 / (1 / up + 1 / down) == pytest.approx(published, rel=0.01)


# Lucas & Saccucci 1990, table 3: weight, factor of the asymptotic sigma.
@pytest.mark.parametrize(
    ("weight", "factor", "shift", "published"),
    [(0.1, 2.814, 0, 500), (0.1, 2.814, 1, 10.3), (0.05, 2.615, 0, 500), (0.05, 2.615, 0.5, 28.7)],
)
def test_ewma_run_lengths_are_the_published_ones(weight, factor, shift, published):
    assert ewma_run_length(weight, factor * np.sqrt(weight / (2 - weight)), shift) == pytest.approx(published, rel=0.02)


def test_limits_give_the_run_length_asked_for():
    for k in CUSUM_REFERENCES:
        assert cusum_run_length(k, cusum_limit(k, 1e6)) / 2 == pytest.approx(1e6, rel=1e-3)
    assert ewma_run_length(EWMA_WEIGHT, ewma_limit(EWMA_WEIGHT, 1e6)) == pytest.approx(1e6, rel=1e-3)


def test_a_silent_cell_alarms_no_more_often_than_stated():
    """1,000 parameters as 250 cells of four: until an alarm they run 300 sessions at least."""
    rng = np.random.default_rng(0)
    limit, charts = chart_limits(300.0, 4), empty_charts(1000)
    first = np.full(250, np.inf)
    for k in range(1, 900):
        charts = updated_charts(charts, rng.normal(size=1000))
        hit = (limit_shares(charts, limit).max(axis=1) >= 1).reshape(250, 4).any(axis=1)
        first = np.where(np.isinf(first) & hit, k, first)
    # The time until an alarm is about exponential: its mean by the share of all sessions that were run.
    mean = np.minimum(first, 899).sum() / np.isfinite(first).sum()
    assert 300 < mean < 600
