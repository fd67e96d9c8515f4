"""Inverse covariances of blocks of every size."""

import numpy as np
import pytest

from stitch.numerics.least_squares import invert_covariance


@pytest.mark.parametrize("blocks", [1, 3])
@pytest.mark.parametrize("m", [2, 60, 130])
def test_the_inverse_of_blocks_is_that_of_each(blocks, m):
    half = np.random.default_rng(m).normal(size=(blocks, m, m + 9))
    V = half @ half.transpose(0, 2, 1)
    found = invert_covariance(V)
    assert np.allclose(found.matrix @ V, np.eye(m), atol=1e-7)
    assert np.allclose(found.half.transpose(0, 2, 1) @ found.half, found.matrix, rtol=1e-7)
    assert np.isclose(found.logdet, np.linalg.slogdet(V)[1].sum())


@pytest.mark.parametrize("blocks", [1, 3])
def test_blocks_of_no_size_have_an_inverse_of_no_size_and_lapack_says_nothing(blocks, capfd):
    found = invert_covariance(np.zeros((blocks, 0, 0)))
    assert found.matrix.shape == found.half.shape == (blocks, 0, 0) and found.logdet == 0.0
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("m", [3, 130])
def test_a_covariance_without_an_inverse_has_an_infinite_determinant(m):
    V = np.stack([np.eye(m), np.zeros((m, m))])
    assert invert_covariance(V).logdet == np.inf
