"""Which parameters of an effect are fitted, and how large those left out may be."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binomtest, multivariate_normal, norm

from stitch.numerics.least_squares import independent
from stitch.numerics.parameter_selection import (
    ANY_SIZE,
    PLAUSIBLE,
    WhitenedData,
    log_evidence_at_scales,
    log_mixture,
    omitted_rms,
    select_supported,
)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.floats(-6, 6))
def test_units_do_not_decide_what_is_visible(seed, exponent):
    """Counting a parameter in another unit, with its size, changes nothing."""
    rng = np.random.default_rng(seed)
    base, columns = rng.standard_normal((40, 4)), rng.standard_normal((40, 6))
    columns[:, 5] = columns[:, 0] + 1e-9 * rng.standard_normal(40)
    sizes = rng.uniform(0.5, 2.0, 6)
    unit = 10.0**exponent
    chosen = independent(base, columns, sizes, 0.3)
    assert np.array_equal(chosen, independent(base, columns / unit, sizes * unit, 0.3))
    assert chosen.sum() == 5  # of two that say the same, one


def test_evidence_is_the_density_of_what_was_seen():
    """Of unit white noise and amplitudes of a normal prior, over that of the noise alone."""
    rng = np.random.default_rng(0)
    G, z = rng.standard_normal((7, 3)), rng.standard_normal(7)
    found = log_evidence_at_scales(G.T @ G, G.T @ z, {0.3: 0.5, 30.0: 0.5})
    alone = multivariate_normal(np.zeros(7)).logpdf(z)
    expected = [multivariate_normal(np.zeros(7), np.eye(7) + s**2 * G @ G.T).logpdf(z) - alone for s in (0.3, 30.0)]
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_of_an_effect_only_the_joint_that_is_off_is_fitted():
    """White noise, six groups, one of them true at ten sigmas: another one by chance at most 1 in 20."""
    groups, others = [[0, 1], [2, 3], [4, 5], [6], [7], [8]], 0
    for seed in range(200):
        rng = np.random.default_rng(seed)
        own, further = rng.standard_normal((60, 6)), rng.standard_normal((60, 9))
        z = further[:, 2] * 1.5 + own @ rng.standard_normal(6) + rng.standard_normal(60)
        chosen = select_supported(WhitenedData(own, further, z), np.full(9, 0.5), groups, [0] * 6)
        assert chosen[2] and chosen[3]
        others += chosen.sum() > 2
    # 5 groups whose log evidence exceeds 2.5 by chance in some 0.4 % each.
    assert binomtest(others, 200, 0.05, alternative="greater").pvalue > 0.01


def test_two_that_only_together_explain_are_found():
    """What both do cancels nearly: alone either gains nothing, as two joints of an arm that err against each other."""
    missed = 0
    for seed in range(50):
        rng = np.random.default_rng(seed)
        own, shared, further = rng.standard_normal((60, 6)), rng.standard_normal(60), rng.standard_normal((60, 6))
        further[:, 1:3] = 5 * shared[:, None] + 0.4 * rng.standard_normal((60, 2))
        z = further[:, 1] - further[:, 2] + 0.3 * rng.standard_normal(60)
        chosen = select_supported(
            WhitenedData(own / 0.3, further / 0.3, z / 0.3), np.ones(6), [[i] for i in range(6)], [0] * 6
        )
        missed += not (chosen[1] and chosen[2])
    assert not missed


def test_an_effect_keeps_a_group_that_is_seen():
    rng = np.random.default_rng(1)
    noise = WhitenedData(rng.standard_normal((60, 6)), rng.standard_normal((60, 3)), np.zeros(60))
    noise.further[:, 0] = 0.0
    assert not select_supported(noise, np.ones(3), [[0], [1], [2]], [0] * 3)[0]


def test_an_effect_in_the_model_keeps_its_best_group_however_weak():
    rng = np.random.default_rng(0)
    noise = WhitenedData(rng.standard_normal((60, 6)), rng.standard_normal((60, 3)), rng.standard_normal(60))
    chosen = select_supported(noise, np.full(3, 0.1), [[0], [1], [2]], [0, 0, 1])
    assert chosen[2] and chosen[:2].sum() == 1


def test_a_parameter_that_nobody_sees_is_believed_of_the_size_of_its_like():
    """Six parameters of an effect, in a share and of a size that are drawn for the effect; nothing tells the last.

    Mean squares told and true agree, whether the five others are small or large.
    """
    rng, told, true = np.random.default_rng(4), [], []
    for _ in range(3000):
        size = 1 / np.sqrt(rng.chisquare(3))  # of a mean square of one
        amplitudes = size * rng.standard_normal(6) * (rng.uniform(size=6) < rng.beta(0.5, 0.5))
        further = 20 * np.linalg.qr(rng.standard_normal((30, 6)))[0]
        further[:, 5] = 0.0
        z = further @ amplitudes + rng.standard_normal(30)
        fitted = np.abs(amplitudes) * (np.arange(6) < 5) > 0.2
        told.append(omitted_rms(WhitenedData(np.zeros((30, 0)), further, z), np.ones(6), fitted, np.zeros(6))[5] ** 2)
        true.append(amplitudes[5] ** 2)
    told, true = np.array(told), np.array(true)
    for some in (told < 0.2, (told > 0.2) & (told < 0.6), told > 0.6):
        ratio = (true / told)[some]
        known = ratio.std() / np.sqrt(len(ratio))
        assert abs(ratio.mean() - 1) < 4 * known and known < 0.15


def test_what_stays_at_zero_may_be_as_large_as_it_is_on_the_average():
    """Amplitudes that are there in half the cases, drawn from their prior: mean squares told and true agree."""
    rng, told, true = np.random.default_rng(3), [], []
    for _ in range(4000):
        own, further, size = rng.standard_normal((12, 2)), 0.4 * rng.standard_normal((12, 1)), rng.uniform(0.2, 3)
        amplitude = size * rng.standard_normal() * rng.integers(0, 2)
        z = own @ rng.standard_normal(2) + further[:, 0] * amplitude + rng.standard_normal(12)
        told.append(
            omitted_rms(WhitenedData(own, further, z), np.array([size]), np.zeros(1, bool), np.zeros(1))[0] ** 2
            / size**2
        )
        true.append(amplitude**2 / size**2)
    apart = np.array(told) - true
    assert abs(apart.mean()) < 4 * apart.std() / np.sqrt(len(apart))
    # Beside a column that is fitted and says the same nothing is known of it but its size.
    same = omitted_rms(
        WhitenedData(own, np.tile(further, 2), z), np.full(2, 0.3), np.array([True, False]), np.arange(2)
    )
    np.testing.assert_allclose(same, [0.0, 0.3 * np.sqrt(0.5)], rtol=1e-6)


@pytest.mark.parametrize("scales", [PLAUSIBLE, ANY_SIZE])
def test_shares_of_a_mixture_add_up_to_one(scales):
    assert sum(scales.values()) == pytest.approx(1.0)


@pytest.mark.parametrize("scales", [PLAUSIBLE, ANY_SIZE])
@pytest.mark.parametrize("seen", [0.0, 2.0, 66.0])
def test_the_evidence_is_that_of_the_mixture(scales, seen):
    """One number with sigma 1 of an amplitude that is usually of size 1; one of 66 is seen as well as it is."""
    logs = np.array([norm.logpdf(seen, scale=np.hypot(1.0, scale)) for scale in scales])
    mixture = sum(share * norm.pdf(seen, scale=np.hypot(1.0, scale)) for scale, share in scales.items())
    assert log_mixture(logs, scales) == pytest.approx(np.log(mixture))
    if seen > 60:
        # Under a normal prior of plausible size what is 66 sizes large explains a thousand nats less than it is.
        lost = norm.logpdf(seen, scale=seen) - log_mixture(logs, scales)
        assert lost < 10 < norm.logpdf(seen, scale=seen) - norm.logpdf(seen, scale=np.hypot(1.0, 1.0)) - 500
