"""Numbers as they are printed."""

from stitch.units import rounded


def test_numbers_end_where_their_sigma_begins():
    assert rounded(4.38e-7, 3.3e-8) == "4.4e-07"
    assert rounded(-2e-10, 0.03) == "0"
    assert rounded(0.1342, 0.0312) == "0.13"
    assert rounded(1.23456, float("nan")) == "1.235"
