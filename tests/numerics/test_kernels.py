"""How alike two views err: limits that anybody can check, and no negative variance."""

import numpy as np
import pytest

from stitch.numerics.kernels import direction_kernel, load_kernel, ornstein_uhlenbeck, process_covariance, rbf_joints

JOINTS = np.random.default_rng(0).uniform(-np.pi, np.pi, (25, 6))


def test_covariances_have_no_negative_direction():
    in_time, in_way = (
        ornstein_uhlenbeck(np.cumsum(JOINTS[:, 0] ** 2), 2.0),
        direction_kernel(JOINTS[:, 0], JOINTS[:, 1]),
    )
    for alike in (rbf_joints(JOINTS), in_time, in_way, load_kernel(40 * JOINTS[:, :2])):
        assert np.linalg.eigvalsh(alike).min() > -1e-12
        assert np.diag(alike) == pytest.approx(1.0)


def test_a_whole_turn_of_a_joint_changes_nothing():
    turned = JOINTS.copy()
    turned[:, 2] += 2 * np.pi * np.arange(25)
    assert np.allclose(rbf_joints(turned), rbf_joints(JOINTS))


def test_what_one_joint_moves_far_stays_half_alike_and_near_views_are_alike():
    """One joint of one: (1 + k)/2 with k from 1 at no distance to exp(−2) half a turn away."""
    assert rbf_joints(np.array([[0.0], [np.pi]]))[0, 1] == pytest.approx((1 + np.exp(-2)) / 2)


def test_time_forgets():
    alike = ornstein_uhlenbeck(np.array([0.0, 1.0, 500.0]), 20.0)
    assert alike[0, 1] == pytest.approx(np.exp(-1 / 20))
    assert alike[0, 2] < 1e-10


def test_the_way_counts_in_ranges_of_the_joint():
    """At one angle, views that came a whole range apart are alike by 1/e; a joint that never moves is as alike as can be."""
    alike = direction_kernel(np.array([0.2, 0.2, 0.8]), np.array([-0.3, 0.3, 0.3]))
    assert alike[0, 1] == pytest.approx(np.exp(-1))
    assert np.all(direction_kernel(np.zeros(3), np.zeros(3)) == 1)


def test_load_counts_in_its_own_range():
    """Half of the range of each of two torques apart, in any unit, however many hang on one joint: alike by exp(−½)."""
    torques = np.array([[0.0, 30.0], [5.0, 10.0], [10.0, -10.0]])
    assert load_kernel(torques)[0, 1] == pytest.approx(np.exp(-0.5))
    assert np.allclose(load_kernel(1e3 * torques), load_kernel(torques[:, :1]))


def test_spread_is_the_covariance_of_drawn_processes():
    """10,000 draws of two processes through their columns; each number within five of its standard errors."""
    rng = np.random.default_rng(1)
    alike, columns, draws = ornstein_uhlenbeck(np.arange(4.0), 5.0), rng.normal(size=(24, 2)), 10_000
    half = np.linalg.cholesky(alike)
    drawn = np.zeros((draws, 24))
    for p in range(2):
        drawn += np.repeat(rng.normal(size=(draws, 4)) @ half.T, 6, axis=1) * columns[:, p]
    wanted = process_covariance(columns, alike)
    variance = np.outer(np.diag(wanted), np.diag(wanted)) + wanted**2
    assert np.all(np.abs(drawn.T @ drawn / draws - wanted) < 5 * np.sqrt(variance / draws))
