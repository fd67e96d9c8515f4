"""How well scatter is known: Satterthwaite's formula."""

import numpy as np
import pytest

from stitch.numerics.reml import MixedModel, VarianceFit
from stitch.numerics.variance_posterior import satterthwaite

GROUPS = (30, 20, 500)


def groups() -> tuple[MixedModel, VarianceFit]:
    """Three groups of numbers, each with a variance of its own; the mean of the first is unknown."""
    own = np.repeat(np.arange(3), GROUPS)
    components = np.array([np.diag((own == k).astype(float)) for k in range(3)])[:, None]
    A = (own == 0).astype(float)[None, :, None]
    evidence = MixedModel(np.zeros((1, own.size)), A, components)
    return evidence, VarianceFit(np.array([4.0, 0.25, 1.0]), 0.0, np.zeros(1), np.eye(1), np.eye(2))


@pytest.mark.parametrize(("share", "expected"), [(0.0, 29.0), (1.0, 20.0), (0.5, 1 / (0.25 / 29 + 0.25 / 20))])
def test_a_group_of_numbers_knows_its_own_variance(share, expected):
    """Satterthwaite's formula for a direction within one group, and across two."""
    evidence, null = groups()
    white = np.zeros((1, sum(GROUPS), 1))
    white[0, :2, 0] = np.sqrt((1 - share) / 2) * np.array([1, -1])
    white[0, 30:32, 0] = np.sqrt(share / 2) * np.array([1, -1])
    assert satterthwaite(evidence, null).degrees_of_freedom(white) == pytest.approx(expected, rel=1e-6)
