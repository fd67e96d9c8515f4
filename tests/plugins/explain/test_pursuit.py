"""Sums of addends found greedily: what was put in comes out, alone or in groups, and noise adds nothing."""

import numpy as np
import pytest
from scipy.stats import binom

from stitch.plugins.explain.search import pursue_sums

NUMBERS = 60


@pytest.fixture
def columns():
    return np.random.default_rng(3).standard_normal((NUMBERS, 120))


def singles(count):
    return [(k,) for k in range(count)]


def test_two_columns_come_out_of_noise(columns):
    z = 3 * columns[:, 7] - 2 * columns[:, 40] + 0.5 * np.random.default_rng(4).standard_normal(NUMBERS)
    sums = pursue_sums(columns, z, NUMBERS, singles(120), 3)
    assert (7, 40) in sums and (7,) in sums
    # A third column of 118 beyond chance once in twenty: not for this draw.
    assert max(len(found) for found in sums if found[0] == 7) == 2


def test_of_a_wave_both_columns_come_together(columns):
    addends = [(0, 1), *((k,) for k in range(2, 120))]
    z = columns[:, 0] + columns[:, 1] + 0.3 * np.random.default_rng(5).standard_normal(NUMBERS)
    assert (0, 1) in pursue_sums(columns, z, NUMBERS, addends, 1)


def test_a_single_column_is_not_found_in_a_group_that_holds_it():
    """Where it stands alone too: five numbers more for the same gain, but once in forty (0.05, of two addends)."""
    addends, widened = [(0,), (0, 1, 2, 3, 4, 5)], 0
    for seed in range(200):
        rng = np.random.default_rng([6, seed])
        columns = rng.standard_normal((NUMBERS, 6))
        z = columns[:, 0] + 0.3 * rng.standard_normal(NUMBERS)
        sums = pursue_sums(columns, z, NUMBERS, addends, 1)
        assert (0,) in sums
        widened += addends[1] in sums
    # The 1e-4 tail of a binomial of 200.
    assert widened <= binom.isf(1e-4, 200, 0.05 / 2)


def test_columns_of_nothing_are_not_chosen(columns):
    columns[:, 0] = 0.0
    columns[:, 1] = 1e-9 * columns[:, 2]
    assert not any(
        k in found for found in pursue_sums(columns, columns[:, 5], NUMBERS, singles(120), 5) for k in (0, 1)
    )


def test_what_a_sum_holds_is_not_wanted_again_where_it_stood(columns):
    """A column that was moved elsewhere explains as much as before where it was tried: it would be added for ever."""
    z = 3 * columns[:, 7] + 0.5 * np.random.default_rng(4).standard_normal(NUMBERS)
    elsewhere = np.random.default_rng(8).standard_normal((NUMBERS, 1))
    sums = pursue_sums(columns, z, NUMBERS, singles(120), 3, lambda numbers: np.tile(elsewhere, (1, len(numbers))))
    assert (7,) in sums
    # Where nothing else is left to add the sum ends.
    assert pursue_sums(columns[:, :1], 3 * columns[:, 0] + z, NUMBERS, [(0,)], 1, lambda _: elsewhere) == {(0,)}
