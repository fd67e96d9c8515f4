"""SE(3) against scipy's matrix exponential and its rotations."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from stitch.numerics import frames

twists = st.lists(st.floats(-1.7, 1.7), min_size=6, max_size=6).map(np.array)


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
