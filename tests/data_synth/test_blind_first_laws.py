"""What marks the kinds of the first laws by another hand."""

import numpy as np

from data_synth import kinematics
from data_synth.laws.blind_first import FOREIGN
from data_synth.moment import Plan
from tests.data_synth.law_plans import VIEWS, plan_of


def drawn(law: str, plan: Plan, seed: int, **time: np.ndarray) -> np.ndarray:
    """Errors of one arm."""
    return FOREIGN[law](plan, np.random.default_rng(seed), **time)


def test_a_loose_anchor_leaves_the_base_where_the_arm_leans_away():
    """Views among the first fifth are never tipped, and all tip about one axis of the base."""
    plan = plan_of("KUKA KR30-3")
    turns = drawn("loose_anchor", plan, 3)[:, :3]
    assert VIEWS / 5 <= (np.abs(turns).max(axis=1) == 0).sum() <= VIEWS / 2
    axes = np.einsum("vij,vj->vi", kinematics.flange(plan.arm, plan.joints)[:, :3, :3], turns)
    values = np.linalg.svd(axes, compute_uv=False)
    assert values[1] < 1e-9 * values[0] and np.abs(axes[:, 2]).max() < 1e-12
