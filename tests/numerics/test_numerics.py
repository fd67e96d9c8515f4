"""Small parts of numerics: tails of distributions, accelerated steps, folds of cross-validation, kernels between views."""

import warnings

import numpy as np
import pytest
from scipy import stats

from stitch.numerics import distributions
from stitch.numerics.folds import grouped_folds, halves_of, joint_ends
from stitch.numerics.kernels import direction_kernel, exponential_kernel, load_kernel, process_covariance, rbf_joints
from stitch.numerics.least_squares import anderson_step


@pytest.mark.parametrize("p", [0.5, 1e-3, 1e-12, 1e-60])
@pytest.mark.parametrize("degrees", [1, 3.5, 40])
def test_tails_and_limits_are_those_of_scipy_stats(p, degrees):
    assert distributions.chi2_limit(p, degrees) == pytest.approx(stats.chi2.isf(p, degrees), rel=1e-8)
    assert distributions.chi2_tail(7.0 * degrees, degrees) == pytest.approx(
        stats.chi2.sf(7.0 * degrees, degrees), rel=1e-10
    )
    assert distributions.normal_tail(3 * degrees) == pytest.approx(stats.norm.sf(3 * degrees), rel=1e-10)
    # scipy.stats' own limit of F is off by 2e-5 at 1e-12 and infinite at 1e-60: its tail is not.
    assert stats.f.sf(distributions.f_limit(p, degrees, 17), degrees, 17) == pytest.approx(p, rel=1e-9)
    assert distributions.f_tail(9.0, degrees, 17) == pytest.approx(stats.f.sf(9.0, degrees, 17), rel=1e-10)


@pytest.mark.parametrize("sigmas", [0.3, 2.7, 12.0, 60.0])
def test_the_farthest_of_many_is_worth_what_one_of_its_chance_is(sigmas):
    assert distributions.sigmas_among(sigmas, 1) == pytest.approx(sigmas, rel=1e-9)
    chance = 14 * stats.norm.sf(sigmas)
    worth = distributions.sigmas_among(sigmas, 14)
    assert (
        worth == 0.0
        if chance > 0.5
        else stats.norm.logsf(worth) == pytest.approx(np.log(14) + stats.norm.logsf(sigmas), rel=1e-9)
    )


@pytest.mark.parametrize("shift", [0.5, 20.0])
def test_noncentral_tails_are_those_of_scipy_stats(shift):
    assert distributions.noncentral_f_tail(4.0, 2, 60, shift) == pytest.approx(
        stats.ncf.sf(4.0, 2, 60, shift), rel=1e-8
    )


def left_after(steps, undone, accelerate):
    """How far from the answer, of 1, where each step asked for leaves shares (N,) of what is left undone."""
    off, last = np.ones(len(undone)), None
    for _ in range(steps):
        asked = -(1 - undone) * off
        taken = asked if last is None or not accelerate else anderson_step(asked, *last)
        last, off = (asked, taken), off + taken
    return float(np.abs(off).max())


def test_one_share_of_all_components_is_made_up_for_at_once():
    assert left_after(2, np.full(3, 0.4), accelerate=False) == pytest.approx(0.16)
    assert left_after(2, np.full(3, 0.4), accelerate=True) < 1e-12


def test_different_shares_are_left_behind_faster_than_without():
    undone = np.linspace(0.1, 0.45, 20)
    assert left_after(5, undone, accelerate=True) < 0.2 * left_after(5, undone, accelerate=False)


def test_steps_that_turn_back_are_shortened_and_never_run_away():
    assert left_after(8, np.full(3, -0.6), accelerate=True) < left_after(8, np.full(3, -0.6), accelerate=False)
    # Hardly anything is done by a step: going twice as far is all that is dared.
    assert left_after(1, np.full(3, 0.99), accelerate=False) > left_after(9, np.full(3, 0.99), accelerate=True) > 0.5


def test_no_step_at_all_stays_none():
    assert np.array_equal(anderson_step(np.zeros(3), np.zeros(3), np.zeros(3)), np.zeros(3))


def test_ends_of_joints_are_fifths_of_what_was_driven():
    rng = np.random.default_rng(0)
    joints = np.column_stack([rng.permutation(200), np.zeros(200)])
    seen = np.arange(0, 200, 2)
    low, high = joint_ends(joints, seen)  # none of the joint that stands still
    assert (low.joint, low.upper, high.upper) == (0, False, True)
    assert np.isin(low.views, seen).all() and 19 <= len(low.views) <= 21
    assert joints[low.views, 0].max() < np.quantile(joints[seen, 0], 0.21)
    assert joints[high.views, 0].min() > np.quantile(joints[seen, 0], 0.79)
    assert joint_ends(joints, seen[:60]) == []


def test_folds_leave_out_neighbours():
    T = np.tile(np.eye(4), (20, 1, 1))
    T[:, 0, 3] = np.arange(20) % 5 * 100.0
    folds = grouped_folds(T, 100.0)
    assert sorted(np.concatenate(folds[:5])) == list(range(20))
    assert all(np.ptp(f) == 3 for f in folds[:5])  # four in a row by time
    assert all(len(set(T[f, 0, 3])) == 1 for f in folds[5:])  # one place each by pose


def test_poses_that_repeat_stay_together_and_nothing_is_printed():
    """Three stops, each visited seven times: fewer places than groups."""
    T = np.tile(np.eye(4), (21, 1, 1))
    T[:, 0, 3] = np.repeat([0.0, 300.0, 700.0], 7)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        folds = grouped_folds(T, 100.0)
    assert [sorted(f) for f in sorted(folds[5:], key=min)] == [[*range(7)], [*range(7, 14)], [*range(14, 21)]]


def test_halves_share_no_view_and_leave_out_none():
    T = np.tile(np.eye(4), (13, 1, 1))
    T[:, 0, 3] = np.random.default_rng(0).permutation(13) * 100.0
    in_time, by_place, alternately = halves_of(T, 100.0)
    for one, other in (in_time, by_place, alternately):
        assert sorted([*one, *other]) == list(range(13)) and abs(len(one) - len(other)) == 1
    assert in_time[0].max() < in_time[1].min()
    # One half lies beyond the other, whichever way round.
    x = [T[half, 0, 3] for half in by_place]
    assert x[0].max() < x[1].min() or x[1].max() < x[0].min()
    assert set(alternately[0] % 2) == {0} and set(alternately[1] % 2) == {1}


JOINTS = np.random.default_rng(0).uniform(-np.pi, np.pi, (25, 6))


def test_covariances_have_no_negative_direction():
    in_time, in_way = (
        exponential_kernel(np.cumsum(JOINTS[:, 0] ** 2), np.cumsum(JOINTS[:, 0] ** 2), 2.0),
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


def test_errors_far_apart_in_time_are_independent():
    alike = exponential_kernel(*[np.array([0.0, 1.0, 500.0])] * 2, 20.0)
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
    alike, columns, draws = exponential_kernel(np.arange(4.0), np.arange(4.0), 5.0), rng.normal(size=(24, 2)), 10_000
    half = np.linalg.cholesky(alike)
    drawn = np.zeros((draws, 24))
    for p in range(2):
        drawn += np.repeat(rng.normal(size=(draws, 4)) @ half.T, 6, axis=1) * columns[:, p]
    wanted = process_covariance(columns, alike)
    variance = np.outer(np.diag(wanted), np.diag(wanted)) + wanted**2
    assert np.all(np.abs(drawn.T @ drawn / draws - wanted) < 5 * np.sqrt(variance / draws))
