"""Numbers as they are printed."""

import pytest

from stitch.numerics.units import angle_text, format_amount, length_text, rounded, value_uncertainty_text


def test_numbers_end_where_their_sigma_begins():
    assert rounded(4.38e-7, 3.3e-8) == "4.4e-07"
    assert rounded(-2e-10, 0.03) == "0"
    assert rounded(0.1342, 0.0312) == "0.13"
    assert rounded(1.23456, float("nan")) == "1.235"


@pytest.mark.parametrize(
    ("value", "sigma", "unit", "told"),
    [
        (9.7e-4, 2.1e-5, "rad", "0.97 ± 0.02 mrad"),
        (6.3e-7, 4e-8, "rad/(N m)", "0.63 ± 0.04 µrad/(N m)"),
        (1.1e-3, 2e-4, "kg rad/(N m)", "1.1 ± 0.2 kg mrad/(N m)"),
        (1e-3, 0.03, "rad", "0 ± 30 mrad"),
        (0.231, 0.02, "mm", "0.23 ± 0.02 mm"),
        (1.2e-5, 3e-6, "1", "1.2e-05 ± 3e-06"),
        (1.15e-5, 3e-7, "1/°C", "11.5 ± 0.3 ppm/°C"),
        (1.2e-3, 4e-4, "m/h", "1.2 ± 0.4 mm/h"),
        (-3e-3, 1e-3, "m", "-3 ± 1 mm"),
        (600.0, None, "s", "600 s"),
        (12.0, float("nan"), "view", "view 12, counted from 0"),
    ],
)
def test_parameters_of_effects_are_in_mrad(value, sigma, unit, told):
    assert str(format_amount(value, sigma, unit)) == told


@pytest.mark.parametrize(
    ("value", "unit", "told"),
    [
        (0.0381, "mm", "38.1 µm"),
        (1.4889, "mm", "1.49 mm"),
        (0.99996, "mm", "1 mm"),
        (1234.56, "mm", "1235 mm"),
        (4.2e-5, "m", "42 µm"),
        (0.02, "m", "20 mm"),
        (0.0, "mm", "0 µm"),
        (float("nan"), "mm", "–"),
    ],
)
def test_lengths_are_in_mm_from_one_millimetre_on(value, unit, told):
    assert length_text(value, unit) == told


def test_columns_keep_their_zeros():
    assert [length_text(x, "mm", 4, zeros=True) for x in (0.022, 0.1011, 1.5, 0.0)] == [
        "22.00 µm",
        "101.1 µm",
        "1.500 mm",
        "0 µm",
    ]


@pytest.mark.parametrize(
    ("value", "U", "told"),
    [
        (1451.8213, 0.1432, "1451.82 ± 0.14"),
        (-0.21, 5.61, "-0.2 ± 5.6"),
        (12.3456, 23.4, "12 ± 23"),
        (650.54321, 0.2, "650.54 ± 0.20"),
        (2.5, 0.998, "2.5 ± 1.0"),
        (2.5, 104.0, "2 ± 104"),
        (3.14, 0.0, "3.14 ± –"),
        (3.14, float("nan"), "3.14 ± –"),
    ],
)
def test_values_have_two_digits_of_their_uncertainty(value, U, told):
    assert value_uncertainty_text(value, U) == told


def test_angles_are_in_mrad():
    assert angle_text(2e-5) == "0.02 mrad" and angle_text(float("nan")) == "–"
