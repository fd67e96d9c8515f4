"""Motions of the scanner from targets that two views share."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stitch.numerics import frames
from stitch.plugins.intake.scan_targets import target_motions
from stitch.session.session import Sighting

FLAT = np.array([[0.0, 0, 0], [100, 0, 0], [100, 70, 0], [0, 70, 0], [50, 30, 0]])


def sighting(T_scanner_part, points, names=None):
    names = tuple(f"t{i}" for i in range(len(points))) if names is None else names
    return Sighting(names, frames.transform(T_scanner_part, points), np.full(len(points), 0.01))


@pytest.fixture
def poses():
    rng = np.random.default_rng(0)
    return frames.make(Rotation.from_rotvec(rng.normal(0, 0.5, (3, 3))).as_matrix(), rng.normal(0, 100, (3, 3)))


def test_points_of_a_plane_give_the_motions(poses):
    found = target_motions([sighting(T, FLAT) for T in poses])
    assert found.pairs == ((0, 1), (0, 2), (1, 2))
    for (v, w), T in zip(found.pairs, found.T, strict=True):
        assert np.allclose(T, poses[v] @ frames.inverse(poses[w]), atol=1e-9)


def test_names_pair_them_whatever_their_order(poses):
    order = [4, 2, 0, 1]
    second = sighting(poses[1], FLAT[order], tuple(f"t{i}" for i in order))
    found = target_motions([sighting(poses[0], FLAT), second])
    assert np.allclose(found.T[0], poses[0] @ frames.inverse(poses[1]), atol=1e-9)


def test_points_in_one_line_or_too_few_say_nothing(poses):
    line = np.outer(np.arange(5.0), [10, 20, 5])
    assert not target_motions([sighting(T, line) for T in poses]).pairs
    assert not target_motions([sighting(T, FLAT[:2]) for T in poses]).pairs
    others = sighting(poses[1], FLAT, tuple("abcde"))
    assert not target_motions([sighting(poses[0], FLAT), others]).pairs
