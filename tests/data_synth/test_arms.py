"""Arms of the simulator against second sources: a product of matrices, the library, a pendulum."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth import kinematics
from data_synth.arms import ARMS, Arm, with_payload
from data_synth.fixtures.arm_sources import plain_product, second_source
from stitch.session import robot

RNG = np.random.default_rng(5)


def poses(arm: Arm, count: int) -> np.ndarray:
    return np.random.default_rng(1).uniform(arm.lower, arm.upper, (count, arm.joints))


@pytest.mark.parametrize("arm", ARMS.values(), ids=ARMS)
def test_forward_kinematics_from_three_sources(arm):
    q = poses(arm, 20)
    T = kinematics.flange(arm, q)
    # Rounding alone: 1e-16 of a few metres, a dozen products.
    assert np.allclose(T, [plain_product(arm, x) for x in q], atol=1e-9)
    assert np.allclose(T, robot.forward(second_source(arm), q), atol=1e-9)


@pytest.mark.parametrize("arm", ARMS.values(), ids=ARMS)
def test_gravity_torques_agree_with_the_library(arm):
    arm = with_payload(arm, 7.0, (30.0, -20.0, 90.0))
    q = poses(arm, 20)
    # A central difference of step h leaves h²/6 of the third derivative and 1e-16·V/h of rounding: V below 1e4 J.
    assert np.allclose(kinematics.gravity_torques(arm, q), robot.gravity_torques(second_source(arm), q), atol=1e-6)


def pendulum(mass: float, length: float, payload: float = 0.0) -> Arm:
    """One joint about a level axis (base turned by α = 90° first), a mass at the end of its link."""
    zeros = np.zeros(2)
    return Arm(
        "pendulum", np.array([0.0, length]), np.array([np.pi / 2, 0.0]), zeros, zeros, np.array([0.0, mass]),
        np.zeros((2, 3)), np.full(2, -3.0), np.full(2, 3.0), zeros, payload, (50.0, 0.0, 0.0),
    )  # fmt: skip


@pytest.mark.parametrize("angle", [-2.0, -0.4, 0.0, 0.7, 1.5, 3.0])
def test_gravity_torque_of_a_pendulum(angle):
    """Joint angle counts upwards from level: gravity turns it down with m g l cos q."""
    arm = pendulum(mass=3.0, length=400.0, payload=2.0)
    q = np.array([0.3, angle])
    assert kinematics.flange(arm, q)[2, 3] == pytest.approx(400.0 * np.sin(angle), abs=1e-9)
    expected = -9.81 * (3.0 * 0.4 + 2.0 * 0.45) * np.cos(angle)
    # The first axis is upright: gravity has no moment about it.
    assert kinematics.gravity_torques(arm, q) == pytest.approx([0.0, expected], abs=1e-7)


def test_the_sign_of_a_sagging_arm():
    """Stretched out level, the arm's shoulder is pulled down: more compliance, a lower flange."""
    arm = ARMS["UR10"]
    level = np.array([0.0, 0.0, 0.0, -np.pi / 2, -np.pi / 2, 0.0])
    torque = kinematics.gravity_torques(arm, level)
    bent = level.copy()
    bent[1] += 1e-5 * torque[1]
    drop = kinematics.flange(arm, bent)[2, 3] - kinematics.flange(arm, level)[2, 3]
    assert abs(torque[1]) > 50 and drop < -0.3


@pytest.mark.parametrize("arm", ARMS.values(), ids=ARMS)
def test_inverse_kinematics_returns_what_forward_gives(arm):
    """From nearby, as a planned path asks; joint limits are kept with two degrees to spare."""
    margin = np.radians(2.0)
    middle = np.clip(arm.home, arm.lower + 0.5, arm.upper - 0.5)
    for _ in range(12):
        q = middle + RNG.uniform(-0.35, 0.35, arm.joints)
        T = kinematics.flange(arm, q)
        found = kinematics.inverse(arm, T, middle)
        assert found is not None
        assert np.allclose(kinematics.flange(arm, found), T, atol=2e-6)
        assert (found >= arm.lower + margin - 1e-12).all() and (found <= arm.upper - margin + 1e-12).all()


def test_inverse_kinematics_knows_what_is_out_of_reach():
    arm = ARMS["UR10"]
    T = kinematics.flange(arm, arm.home)
    T[:3, 3] = [2000.0, 0.0, 300.0]  # the arm is 1.3 m long
    assert kinematics.inverse(arm, T, arm.home) is None


def test_inverse_kinematics_respects_limits():
    """A joint locked near home cannot take part: either the pose is reached without it or not at all."""
    free = ARMS["ABB IRB 120"]
    locked = replace(free, lower=np.where(np.arange(6) == 0, free.home - 0.05, free.lower),
                     upper=np.where(np.arange(6) == 0, free.home + 0.05, free.upper))  # fmt: skip
    T = kinematics.flange(free, free.home + 0.8 * (np.arange(6) == 0))
    found = kinematics.inverse(locked, T, free.home)
    assert found is None or abs(found[0] - free.home[0]) < 0.05


@pytest.mark.parametrize("name", ["KUKA LBR iiwa 14", "UR10"])
def test_joint_velocities_move_the_flange_as_asked(name):
    arm = ARMS[name]
    q, v = arm.home + 0.05, np.array([20.0, -80.0, 5.0])
    rate = kinematics.velocity(arm, q, v)
    step = 1e-4
    before, after = kinematics.flange(arm, q - step * rate), kinematics.flange(arm, q + step * rate)
    moved = kinematics.flange(arm, q)[:3, :3].T @ (after - before)[:3, 3] / (2 * step)
    # Central differences over h = 1e-4 s: h²/6 of the third derivative, rates below 1 rad/s on a metre.
    assert np.allclose(moved, v, atol=1e-4)
    assert np.abs(before[:3, :3] - after[:3, :3]).max() / (2 * step) < 1e-4


def test_masses_add_up_to_what_catalogues_say():
    """Within the base that does not move: 5 to 40 % of the whole."""
    for name, weight in {"KUKA KR30-3": 665, "ABB IRB 120": 25, "UR10": 33.5, "KUKA LBR iiwa 14": 30}.items():
        assert 0.45 * weight < ARMS[name].mass.sum() < weight
