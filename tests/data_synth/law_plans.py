"""Plans in which laws of arms are drawn for tests, and how large these are."""

import numpy as np

from data_synth import kinematics
from data_synth.arms import ARMS, with_payload
from data_synth.moment import Plan

VIEWS, SEEDS = 40, range(8)
SIZE, SHIFT = 1.5e-4, 0.05  # usual rms: rad, mm


def plan_of(name: str, *, masses: bool = True, useful: tuple[int, ...] = (), views: int = VIEWS) -> Plan:
    """Views all over the middle half of what the joints can do."""
    arm = with_payload(ARMS[name], 3.0, (10.0, 0.0, 80.0))
    span = 0.25 * (arm.upper - arm.lower)
    q = (arm.lower + arm.upper) / 2 + span * np.random.default_rng(5).uniform(-1, 1, (views, arm.joints))
    torque = kinematics.gravity_torques(arm, q) if masses else 0 * q
    return Plan(q, torque, 0 * q, arm, useful or tuple(range(arm.joints)))


def relative(error: np.ndarray, of_flange: bool) -> float:
    """rms over the usual one; of a flange the larger of turn and shift."""
    if not of_flange:
        return float(np.sqrt((error**2).sum(axis=1).mean())) / SIZE
    return float((np.sqrt((error.reshape(-1, 2, 3) ** 2).sum(axis=2).mean(axis=0)) / [SIZE, SHIFT]).max())
