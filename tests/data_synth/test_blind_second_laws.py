"""What marks the kinds of the second laws by another hand."""

import numpy as np

from data_synth import kinematics
from data_synth.laws.blind_second import FURTHER
from data_synth.moment import Plan
from tests.data_synth.law_plans import SEEDS, SHIFT, SIZE, VIEWS, plan_of


def drawn(law: str, plan: Plan, seed: int, **time: np.ndarray) -> np.ndarray:
    """Errors of one arm."""
    return FURTHER[law](plan, np.random.default_rng(seed), **time)


def test_an_eccentric_wheel_errs_two_neighbours_alike():
    error = drawn("differential_wheel", plan_of("KUKA KR30-3"), 3)
    i, k = np.flatnonzero(np.ptp(error, axis=0))
    assert k == i + 1 and np.array_equal(np.abs(error[:, i]), np.abs(error[:, k]))


def test_a_bush_turns_its_wave_once():
    """Before and after it slips one sine of the joint is left, over the whole session none."""
    plan = plan_of("KUKA KR30-3")
    error = drawn("slipping_bush", plan, 4)
    (i,) = np.flatnonzero(np.ptp(error, axis=0))
    basis = np.column_stack([np.ones(VIEWS), np.sin(plan.joints[:, i]), np.cos(plan.joints[:, i])])

    def left(views: slice) -> float:
        fit = np.linalg.lstsq(basis[views], error[views, i], rcond=None)[0]
        return float(np.abs(error[views, i] - basis[views] @ fit).max())

    at = [max(left(slice(v)), left(slice(v, None))) for v in range(5, VIEWS - 5)]
    assert min(at) < 1e-12 and left(slice(None)) > 0.2 * SIZE


def test_tubes_sag_towards_the_floor_and_tip_about_a_level_axis():
    plan = plan_of("KUKA KR30-3")
    error = drawn("bending_tubes", plan, 3)
    frames = kinematics.links(plan.arm, plan.joints)
    turn, shift = (np.einsum("vij,vj->vi", frames[:, -1, :3, :3], x) for x in (error[:, :3], error[:, 3:]))
    assert np.abs(turn[:, 2]).max() < 1e-12 and np.abs(shift[:, :2]).max() < 1e-12
    reach = np.linalg.norm(frames[:, -1, :2, 3] - frames[:, 1, :2, 3], axis=1)
    assert (np.diff(shift[np.argsort(reach), 2]) < 1e-12).all() and np.ptp(shift[:, 2]) > 0


def test_every_knock_has_a_way_of_its_own_and_is_not_made_good():
    for seed in SEEDS:
        error = drawn("knocks_on_rubber", plan_of("UR10"), seed) / np.repeat([SIZE, SHIFT], 3)
        moved = np.linalg.norm(error - error[0], axis=1)
        before = int(np.argmax(moved > 1e-9))
        assert 2 <= before < VIEWS / 2 and moved[before] > 0.3 and moved[-1] > 0.1
        assert 2 <= np.linalg.matrix_rank(error - error[0], tol=1e-9) <= 4
