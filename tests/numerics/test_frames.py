"""Small parts of numerics: tails of distributions, accelerated steps, folds of cross-validation, kernels between views.

Inverse covariances of blocks of every size.

SE(3) against scipy's matrix exponential and its rotations.

Numbers as they are printed.
"""

import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from scipy.linalg import expm

from stitch.numerics import distributions, frames
from stitch.numerics.folds import grouped_folds, halves_of, joint_ends
from stitch.numerics.kernels import direction_kernel, exponential_kernel, load_kernel, process_covariance, rbf_joints
from stitch.numerics.least_squares import anderson_step, invert_covariance
from stitch.numerics.units import angle_text, format_amount, length_text, rounded, value_uncertainty_text

twists = st.lists(st.floats(-1.7, 1.7), min_size=6, max_size=6).map(np.array)


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


def hat(xi):
    matrix = np.zeros((4, 4))
    matrix[:3, :3], matrix[:3, 3] = frames.skew(xi[:3]), xi[3:]
    return matrix


@given(twists)
def test_exp_is_the_matrix_exponential(xi):
    assert np.allclose(frames.exp(xi), expm(hat(xi)), atol=1e-12)


@given(twists, st.sampled_from([1.0, 1e-3, 1e-6, 1e-9, 0.0]))
def test_log_inverts_exp(xi, scale):
    xi = xi * scale
    if np.linalg.norm(xi[:3]) < np.pi - 1e-3:
        assert np.allclose(frames.log(frames.exp(xi)), xi, atol=1e-9)


def test_the_logarithm_is_exact_near_half_a_turn():
    for rest in (1e-3, 1e-6, 1e-8):
        xi = np.array([0.0, 0.6, 0.8, 1.0, 2.0, 3.0])
        xi[:3] *= np.pi - rest
        assert np.allclose(frames.exp(frames.log(frames.exp(xi))), frames.exp(xi), atol=1e-7)


@given(twists, twists)
def test_adjoint_carries_twists(xi, eta):
    T = frames.exp(xi)
    assert np.allclose(T @ frames.exp(eta) @ frames.inverse(T), frames.exp(frames.adjoint(T) @ eta), atol=1e-9)


@given(twists, twists)
def test_left_jacobian_is_a_finite_difference(xi, eta):
    step = 1e-6 * eta / 1e2
    moved = frames.log(frames.exp(xi + step) @ frames.inverse(frames.exp(xi - step))) / 2
    assert np.allclose(frames.left_jacobian(xi) @ step, moved, atol=1e-13)


@given(twists)
def test_inverse_and_quaternion_lead_back_to_the_transform(xi):
    T = frames.exp(xi)
    assert np.allclose(frames.inverse(T) @ T, np.eye(4), atol=1e-12)
    assert np.allclose(frames.from_quaternion(T[:3, 3], frames.to_quaternion(T)), T, atol=1e-12)


def test_quaternion_order_is_x_y_z_w():
    quarter = frames.from_quaternion(np.zeros(3), np.array([0, 0, np.sqrt(0.5), np.sqrt(0.5)]))
    assert np.allclose(quarter[:3, :3] @ [1, 0, 0], [0, 1, 0])


@settings(max_examples=30)
@given(twists)
def test_stacks_equal_single_transforms(xi):
    stack = np.stack([xi, -xi, np.zeros(6)])
    assert np.allclose(frames.exp(stack), [frames.exp(x) for x in stack], atol=1e-14)
    points = np.arange(12.0).reshape(4, 3)
    homogeneous = np.column_stack([points, np.ones(4)]) @ frames.exp(xi).T
    assert np.allclose(frames.transform(frames.exp(xi), points), homogeneous[:, :3])
    assert frames.is_rigid(frames.exp(xi))
    assert not frames.is_rigid(frames.exp(xi) * 1.01)


def test_plane_rows_are_the_derivative_of_distances_by_a_twist():
    rng = np.random.default_rng(3)
    points, normals, xi = rng.normal(size=(5, 3)), rng.normal(size=(5, 3)), rng.normal(size=6)
    ahead, back = (frames.transform(frames.exp(step * xi), points) for step in (1e-6, -1e-6))
    slopes = np.einsum("ij,ij->i", ahead - back, normals) / 2e-6
    np.testing.assert_allclose(frames.plane_rows(points, normals) @ xi, slopes, atol=1e-8)


def test_numbers_end_where_their_sigma_begins():
    assert rounded(4.38e-7, 3.3e-8) == "4.4e-07"
    assert rounded(-2e-10, 0.03) == "0"
    assert rounded(0.1342, 0.0312) == "0.13"
    assert rounded(1.23456, float("nan")) == "1.235"


@pytest.mark.parametrize(
    ("value", "sigma", "unit", "told"),
    [
        (9.7e-4, 2.1e-5, "rad", "0.97 ± 0.02 mrad"),
        (6.3e-7, 4e-8, "rad/(N m)", "0.63 ± 0.04 µrad/(N m)"),
        (1.1e-3, 2e-4, "kg rad/(N m)", "1.1 ± 0.2 kg mrad/(N m)"),
        (1e-3, 0.03, "rad", "0 ± 30 mrad"),
        (0.231, 0.02, "mm", "0.23 ± 0.02 mm"),
        (1.2e-5, 3e-6, "1", "1.2e-05 ± 3e-06"),
        (1.15e-5, 3e-7, "1/°C", "11.5 ± 0.3 ppm/°C"),
        (1.2e-3, 4e-4, "m/h", "1.2 ± 0.4 mm/h"),
        (-3e-3, 1e-3, "m", "-3 ± 1 mm"),
        (600.0, None, "s", "600 s"),
        (12.0, float("nan"), "view", "view 12, counted from 0"),
    ],
)
def test_parameters_of_effects_are_in_mrad(value, sigma, unit, told):
    assert str(format_amount(value, sigma, unit)) == told


@pytest.mark.parametrize(
    ("value", "unit", "told"),
    [
        (0.0381, "mm", "38.1 µm"),
        (1.4889, "mm", "1.49 mm"),
        (0.99996, "mm", "1 mm"),
        (1234.56, "mm", "1235 mm"),
        (4.2e-5, "m", "42 µm"),
        (0.02, "m", "20 mm"),
        (0.0, "mm", "0 µm"),
        (float("nan"), "mm", "–"),
    ],
)
def test_lengths_are_in_mm_from_one_millimetre_on(value, unit, told):
    assert length_text(value, unit) == told


def test_columns_keep_their_zeros():
    assert [length_text(x, "mm", 4, zeros=True) for x in (0.022, 0.1011, 1.5, 0.0)] == [
        "22.00 µm",
        "101.1 µm",
        "1.500 mm",
        "0 µm",
    ]


@pytest.mark.parametrize(
    ("value", "U", "told"),
    [
        (1451.8213, 0.1432, "1451.82 ± 0.14"),
        (-0.21, 5.61, "-0.2 ± 5.6"),
        (12.3456, 23.4, "12 ± 23"),
        (650.54321, 0.2, "650.54 ± 0.20"),
        (2.5, 0.998, "2.5 ± 1.0"),
        (2.5, 104.0, "2 ± 104"),
        (3.14, 0.0, "3.14 ± –"),
        (3.14, float("nan"), "3.14 ± –"),
    ],
)
def test_values_have_two_digits_of_their_uncertainty(value, U, told):
    assert value_uncertainty_text(value, U) == told


def test_angles_are_in_mrad():
    assert angle_text(2e-5) == "0.02 mrad" and angle_text(float("nan")) == "–"
