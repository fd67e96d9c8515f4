"""Aliases: what one pattern has of another."""

import numpy as np
import pytest

from stitch.diagnosis.sensitivity import imitated_share


def test_a_pattern_in_the_plane_of_two_columns_is_imitated_by_the_cosine_of_its_angle_to_it():
    X = 1e3 * np.eye(5)[:, :2]
    assert imitated_share(np.array([3.0, 4.0, 0, 0, 0]), X) == pytest.approx(1.0, abs=1e-6)
    assert imitated_share(np.array([3.0, 0, 4.0, 0, 0]), X) == pytest.approx(0.6, abs=1e-6)


@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-310])
def test_what_these_views_cannot_show_is_like_nothing(size):
    """Patterns so small that products of their lengths vanish."""
    assert imitated_share(size * np.ones(4), np.zeros((4, 2))) == 0.0
    assert imitated_share(size * np.ones(4), 1e-200 * np.ones((4, 1))) == 0.0
