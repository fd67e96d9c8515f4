"""Which scans changed places, from the rows to whose poses they belong."""

import numpy as np

from stitch.screening.pairing import exchange_cycles, exchanged_pairs
from stitch.screening.snooping import MisplacedView


def off(*views):
    return [MisplacedView(v, "displaced", 0.1, 5.0, 0.0, np.eye(4)) for v in views]


def test_scans_in_each_others_rows_are_closed_rounds():
    assert exchange_cycles({2: 6, 6: 2, 4: None}) == [(2, 6)]
    assert exchange_cycles({1: 5, 5: 8, 8: 1}) == [(1, 5, 8)]


def test_one_of_two_may_show_too_little():
    assert exchanged_pairs({8: 1, 1: None}, off(1, 8)) == [(8, 1)]


def test_a_row_that_two_scans_claim_is_nobodys():
    assert exchanged_pairs({8: 1, 7: 1, 1: None}, off(1, 7, 8)) == []


def test_a_row_whose_own_scan_belongs_is_not_changed():
    assert exchanged_pairs({8: 1}, off(8)) == []
