"""Arms with errors against arms built with those rows, and their slopes against finite differences."""

from dataclasses import replace

import numpy as np
import pytest

from stitch.numerics import frames
from stitch.session.reading.robot_description import robot_from_dh
from stitch.session.robot import Links, exact_links, flange_slopes, forward, forward_with_errors, jacobian

GRAVITY = np.array([0, 0, -9.81])


def arm_of(convention, rows):
    return robot_from_dh("x", convention, rows, None, GRAVITY, "mm")


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
    found = forward_with_errors(arm_of(convention, rows), q, Links(np.full(7, 1.001), da, dd, dalpha))
    assert np.allclose(found, forward(arm_of(convention, other), q), atol=1e-9)


@pytest.mark.parametrize("convention", ["standard", "modified", "urdf"])
def test_slopes_of_the_flange_are_finite_differences(convention):
    """About an arm whose every row and length is off, in each of its errors."""
    rng, step = np.random.default_rng(1), 1e-5
    arm = replace(arm_of("modified" if convention == "modified" else "standard", rows_from(rng)), convention=convention)
    q = rng.uniform(-2, 2, (5, 6))
    at = Links(1 + rng.normal(0, 1e-2, 5), *rng.normal(0, [[3.0], [3.0], [1e-2]], (3, 6)))
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
    both = [forward_with_errors(arm, q, replace(at, scale=at.scale + s * step)) for s in (1, -1)]
    assert np.allclose(slopes.scale, difference(*both), atol=2e-6)


def test_slopes_of_a_right_arm_are_its_jacobian():
    rng = np.random.default_rng(2)
    arm, q = arm_of("standard", rows_from(rng)), rng.uniform(-2, 2, (4, 6))
    assert np.allclose(flange_slopes(arm, q, exact_links(4, 6)).joints, jacobian(arm, q), atol=1e-9)
