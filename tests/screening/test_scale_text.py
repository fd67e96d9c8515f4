"""A factor between clouds and robot is printed only where lengths can differ by it."""

import pytest

from stitch.run_data import doubt_headline
from stitch.screening.hypotheses import scale_text


@pytest.mark.parametrize("scale", [1.0254, 0.97, 25.4, 1000.0, 0.001])
def test_a_possible_factor_is_printed(scale):
    assert f"the clouds are {scale:.5g} times as large" in scale_text(scale)


@pytest.mark.parametrize("scale", [-0.0003, 0.0, -1.0, 1e-5, 4e4, 0.1318, 3.0])
def test_an_impossible_factor_is_not_printed(scale):
    said = scale_text(scale)
    assert f"{scale:.5g} times" not in said
    assert said == (
        "The robot's positions do not explain how the scanner moved; its rotations do; to fix: is an axis missing "
        "(column E1), or a column mixed up?"
    )


def test_a_factor_near_that_of_a_unit_is_that():
    assert "the clouds are 10 times as large" in scale_text(9.9525)


def test_the_headline_of_a_doubt_ends_before_what_to_do():
    assert doubt_headline("ball3 creeps; to fix: leave it out, and measure again.") == "ball3 creeps."
