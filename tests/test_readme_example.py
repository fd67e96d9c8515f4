"""The example of README.md prints what the page shows."""

import math
import re

import pytest

from bench.readme_output import commands, printed, shown


@pytest.mark.usefixtures("no_drawing")
def test_the_example_of_the_readme_prints_what_it_shows(tmp_path):
    page = shown()
    anew = printed(commands(page), tmp_path)
    number = re.compile(r"(?<![\w.])-?\d[\d,]*(?:\.\d+)?(?:e-?\d+)?")
    assert number.sub("#", re.sub(" +", " ", anew)) == number.sub("#", re.sub(" +", " ", page)), (
        "to fix: python bench/readme_output.py"
    )
    for a, b in zip(number.findall(anew), number.findall(page), strict=True):
        # Another processor may round otherwise: one in the last digit that is shown.
        assert math.isclose(value(a), value(b), rel_tol=0, abs_tol=1.01 * max(last_digit(a), last_digit(b))), (a, b)


def value(number: str) -> float:
    return float(number.replace(",", ""))


def last_digit(number: str) -> float:
    """What one more in the last digit that is shown is worth."""
    mantissa, _, power = number.partition("e")
    return 10.0 ** (int(power or 0) - len(mantissa.partition(".")[2]))
