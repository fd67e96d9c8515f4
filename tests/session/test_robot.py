"""Kinematics, exact and with links a little wrong, against textbook products, finite differences and potential energy."""

from dataclasses import replace

import numpy as np
import pytest

from stitch.numerics import frames
from stitch.output.urdf_file import to_urdf
from stitch.session.reading.robot_description import robot_from_dh, robot_from_urdf
from stitch.session.robot import (
    Links,
    exact_links,
    flange_slopes,
    forward,
    forward_with_errors,
    gravity_torques,
    jacobian,
    joint_axes,
    link_frames,
)

ROWS = [
    {"a": 350, "alpha_deg": -90, "d": 815, "theta_deg": 0, "mass": 120, "com": [-175, 20, 10]},
    {"a": 850, "alpha_deg": 0, "d": 0, "theta_deg": -90, "mass": 80, "com": [-400, 0, 60]},
    {"a": 145, "alpha_deg": -90, "d": 12, "theta_deg": 0, "mass": 60, "com": [-60, 10, 0]},
    {"a": 0, "alpha_deg": 90, "d": 820, "theta_deg": 15, "mass": 30, "com": [0, -200, 0]},
    {"a": 7, "alpha_deg": -90, "d": 0, "theta_deg": 0, "mass": 12, "com": [0, 0, 20]},
    {"a": 0, "alpha_deg": 0, "d": 170, "theta_deg": 180, "mass": 3, "com": [0, 0, -30]},
]


PAYLOAD = {"mass": 20, "com": [10, -5, 80]}


GRAVITY = np.array([0.5, -0.2, -9.81])


def robot(convention="standard"):
    return robot_from_dh("test", convention, ROWS, PAYLOAD, GRAVITY, "mm")


def elementary(kind, value):
    c, s = np.cos(value), np.sin(value)
    return {
        "Rx": [[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1]],
        "Rz": [[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
        "Tx": [[1, 0, 0, value], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
        "Tz": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, value], [0, 0, 0, 1]],
    }[kind]


@pytest.mark.parametrize(("convention", "order"), [("standard", "Rz Tz Tx Rx"), ("modified", "Rx Tx Rz Tz")])
def test_forward_is_the_product_of_elementary_matrices(convention, order):
    q = np.random.default_rng(0).uniform(-3, 3, 6)
    T = np.eye(4)
    for row, angle in zip(ROWS, q, strict=True):
        values = {
            "Rz": angle + np.radians(row["theta_deg"]),
            "Tz": row["d"],
            "Tx": row["a"],
            "Rx": np.radians(row["alpha_deg"]),
        }
        for kind in order.split():
            T = T @ np.array(elementary(kind, values[kind]))
    assert np.allclose(forward(robot(convention), q), T, atol=1e-9)


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_the_jacobian_agrees_with_finite_differences(convention):
    arm, q, step = robot(convention), np.random.default_rng(1).uniform(-3, 3, 6), 1e-6
    J = jacobian(arm, q)
    for i in range(6):
        dq = np.eye(6)[i] * step
        twist = frames.log(frames.inverse(forward(arm, q - dq)) @ forward(arm, q + dq)) / (2 * step)
        assert np.allclose(J[:, i], twist, atol=1e-5)


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_gravity_torque_is_minus_the_slope_of_potential_energy(convention):
    arm = robot(convention)

    def energy(q):
        T = link_frames(arm, q)[1:]
        centres = [t[:3, :3] @ r["com"] + t[:3, 3] for t, r in zip(T, ROWS, strict=True)]
        work = sum(r["mass"] * c @ GRAVITY for r, c in zip(ROWS, centres, strict=True))
        tool = T[-1][:3, :3] @ PAYLOAD["com"] + T[-1][:3, 3]
        return -(work + PAYLOAD["mass"] * tool @ GRAVITY) * 1e-3

    for q in np.random.default_rng(2).uniform(-3, 3, (5, 6)):
        slope = [(energy(q + d) - energy(q - d)) / 2e-5 for d in np.eye(6) * 1e-5]
        assert np.allclose(gravity_torques(arm, q), -np.array(slope), atol=1e-5)


def test_axes_turn_the_flange():
    arm, q = robot(), np.random.default_rng(3).uniform(-3, 3, 6)
    points, axes = joint_axes(arm, q)
    for i in range(6):
        moved = forward(arm, q + np.eye(6)[i] * 0.3) @ frames.inverse(forward(arm, q))
        on_axis = frames.transform(moved, points[i][None])[0]
        assert np.allclose(on_axis, points[i], atol=1e-9)
        assert np.allclose(moved[:3, :3] @ axes[i], axes[i], atol=1e-12)


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_urdf_of_a_dh_robot_gives_the_same_flange(convention, tmp_path):
    arm = robot(convention)
    (tmp_path / "arm.urdf").write_text(to_urdf(arm))
    again = robot_from_urdf(tmp_path / "arm.urdf", "base_link", "flange", "mm", GRAVITY)
    q = np.random.default_rng(4).uniform(-3, 3, (50, 6))
    # 1e-9 m, written as mm.
    assert np.abs(forward(arm, q) - forward(again, q)).max() < 1e-6


DOWNWARDS = np.array([0, 0, -9.81])


def arm_of(convention, rows):
    return robot_from_dh("x", convention, rows, None, DOWNWARDS, "mm")


def rows_from(rng):
    return [
        {
            "a": rng.uniform(0, 400),
            "alpha_deg": rng.uniform(-90, 90),
            "d": rng.uniform(0, 300),
            "theta_deg": rng.uniform(-90, 90),
        }
        for _ in range(6)
    ]


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_wrong_rows_are_another_arm(convention):
    """Errors of DH rows give the same pose as an arm built with those rows."""
    rng = np.random.default_rng(0)
    rows = rows_from(rng)
    da, dd, dalpha = rng.normal(0, 0.3, 6), rng.normal(0, 0.3, 6), rng.normal(0, 1e-3, 6)
    other = [
        r | {"a": 1.001 * (r["a"] + a), "d": 1.001 * (r["d"] + d), "alpha_deg": r["alpha_deg"] + np.degrees(alpha)}
        for r, a, d, alpha in zip(rows, da, dd, dalpha, strict=True)
    ]
    q = rng.uniform(-2, 2, (7, 6))
    found = forward_with_errors(
        arm_of(convention, rows), q, Links(np.full(7, 1.001), np.ones((7, len(da))), da, dd, dalpha)
    )
    assert np.allclose(found, forward(arm_of(convention, other), q), atol=1e-9)


@pytest.mark.parametrize("convention", ["standard", "modified", "urdf"])
def test_slopes_of_the_flange_are_finite_differences(convention):
    """About an arm whose every row and length is off, in each of its errors."""
    rng, step = np.random.default_rng(1), 1e-5
    arm = replace(arm_of("modified" if convention == "modified" else "standard", rows_from(rng)), convention=convention)
    q = rng.uniform(-2, 2, (5, 6))
    at = Links(
        1 + rng.normal(0, 1e-2, 5), 1 + rng.normal(0, 1e-2, (5, 6)), *rng.normal(0, [[3.0], [3.0], [1e-2]], (3, 6))
    )
    slopes = flange_slopes(arm, q, at)

    def difference(up, down):
        return frames.log(frames.inverse(down) @ up) / (2 * step)

    for i, one in enumerate(np.eye(6)):
        turned = [forward_with_errors(arm, q + s * step * one, at) for s in (1, -1)]
        assert np.allclose(slopes.joints[..., i], difference(*turned), atol=2e-6)
        for name in ("da", "dd", "dalpha"):
            both = [
                forward_with_errors(arm, q, replace(at, **{name: getattr(at, name) + s * step * one})) for s in (1, -1)
            ]
            assert np.allclose(getattr(slopes, name)[..., i], difference(*both), atol=2e-6)
        longer = [forward_with_errors(arm, q, replace(at, lengths=at.lengths + s * step * one)) for s in (1, -1)]
        assert np.allclose(slopes.lengths[..., i], difference(*longer), atol=2e-6)
    both = [forward_with_errors(arm, q, replace(at, scale=at.scale + s * step)) for s in (1, -1)]
    assert np.allclose(slopes.scale, difference(*both), atol=2e-6)


def test_slopes_of_a_right_arm_are_its_jacobian():
    rng = np.random.default_rng(2)
    arm, q = arm_of("standard", rows_from(rng)), rng.uniform(-2, 2, (4, 6))
    assert np.allclose(flange_slopes(arm, q, exact_links(4, 6)).joints, jacobian(arm, q), atol=1e-9)
