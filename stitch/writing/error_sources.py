"""The variance budget as people are told it: the largest sources by name, what is small together."""

from collections.abc import Sequence

import numpy as np

from stitch.diagnosis.variance_budget import BudgetLine

# Sources of less are told together.
_MIN_SHARE = 0.01
OTHER_SOURCES = "others"


def largest_error_sources(budget: Sequence[BudgetLine]) -> list[BudgetLine]:
    """Sources of at least 1 % of the variance, largest first, then all others as one line; shares add up to 1.

    Empty where there is no budget, or nothing in it.
    """
    there = sorted((line for line in budget if line.variance_share > 0), key=lambda line: -line.variance_share)
    small = [line for line in there if line.variance_share < _MIN_SHARE]
    told = there[: len(there) - len(small)]
    if small:
        share = sum(line.variance_share for line in small)
        sigma = float(np.sqrt(sum(line.sigma**2 for line in small)))
        told.append(BudgetLine(OTHER_SOURCES, share, sigma, small[0].unit))
    return told


def share_text(line: BudgetLine) -> str:
    """A share of the variance in per cent."""
    return "< 1 %" if line.variance_share < _MIN_SHARE else f"{line.variance_share:.0%}".replace("%", " %")
