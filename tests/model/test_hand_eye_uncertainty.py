"""The uncertainty of the hand-eye in the frame in which it is printed, against drawn hand-eyes."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stitch.model.model import expanded_uncertainty, printed_covariance
from stitch.numerics import frames


@pytest.mark.parametrize("angle", [1e-5, 0.8, 3.1])
def test_what_is_printed_scatters_as_printed(angle):
    """Hand-eyes drawn from the scanner-frame covariance, printed each, have the covariance that is predicted."""
    rng = np.random.default_rng(2)
    axis = np.array([2.0, -1.0, 2.0]) / 3
    T = frames.make(Rotation.from_rotvec(angle * axis).as_matrix(), np.array([650.0, -150.0, 900.0]))
    half = rng.normal(size=(6, 6)) * np.array([1e-5] * 3 + [1e-2] * 3)[:, None]
    drawn = T @ frames.exp(rng.standard_normal((200_000, 6)) @ half.T)
    turns = (Rotation.from_matrix(drawn[:, :3, :3]).as_rotvec() - angle * axis).T
    printed = np.cov(np.vstack([turns, drawn[:, :3, 3].T]))
    expected = printed_covariance(T, half @ half.T)
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(printed / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.015)
    np.testing.assert_allclose(expanded_uncertainty(T, half @ half.T), 2 * scale)


def test_axes_of_the_scanner_are_not_those_of_the_mount():
    """Sure along the scanner's z alone; the scanner looks along the base's x: there the sigma must stand."""
    T = frames.make(np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), np.zeros(3))
    covariance = np.diag([0.0, 0, 0, 0.123**2, 0.05**2, 0.0126**2])
    np.testing.assert_allclose(expanded_uncertainty(T, covariance)[3:], 2 * np.array([0.0126, 0.05, 0.123]))
