"""Tails of distributions against scipy.stats, far out too."""

import pytest
from scipy import stats

from stitch.numerics import distributions


@pytest.mark.parametrize("p", [0.5, 1e-3, 1e-12, 1e-60])
@pytest.mark.parametrize("degrees", [1, 3.5, 40])
def test_tails_and_limits_are_those_of_scipy_stats(p, degrees):
    assert distributions.chi2_limit(p, degrees) == pytest.approx(stats.chi2.isf(p, degrees), rel=1e-8)
    assert distributions.chi2_tail(7.0 * degrees, degrees) == pytest.approx(
        stats.chi2.sf(7.0 * degrees, degrees), rel=1e-10
    )
    assert distributions.normal_tail(3 * degrees) == pytest.approx(stats.norm.sf(3 * degrees), rel=1e-10)
    # scipy.stats' own limit of F is off by 2e-5 at 1e-12 and infinite at 1e-60: its tail is not.
    assert stats.f.sf(distributions.f_limit(p, degrees, 17), degrees, 17) == pytest.approx(p, rel=1e-9)
    assert distributions.f_tail(9.0, degrees, 17) == pytest.approx(stats.f.sf(9.0, degrees, 17), rel=1e-10)


@pytest.mark.parametrize("shift", [0.5, 20.0])
def test_noncentral_tails_are_those_of_scipy_stats(shift):
    assert distributions.noncentral_f_tail(4.0, 2, 60, shift) == pytest.approx(
        stats.ncf.sf(4.0, 2, 60, shift), rel=1e-8
    )
