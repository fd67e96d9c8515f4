"""Laws that were written apart from what judges them: sizes, shapes, and that each is drawn anew for every arm."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.arms import ARMS
from data_synth.laws.blind_first import FOREIGN, FOREIGN_IN_TIME, FOREIGN_OF_FLANGE
from data_synth.laws.blind_second import FURTHER, FURTHER_IN_TIME, FURTHER_OF_FLANGE
from data_synth.laws.blind_third import LATER, LATER_IN_TIME, LATER_OF_FLANGE
from data_synth.laws.unnamed import UNNAMED
from data_synth.moment import Plan
from tests.data_synth.law_plans import SEEDS, SIZE, VIEWS, plan_of, relative

LAWS, OF_FLANGE = FOREIGN | FURTHER | LATER, (*FOREIGN_OF_FLANGE, *FURTHER_OF_FLANGE, *LATER_OF_FLANGE)
IN_TIME = (*FOREIGN_IN_TIME, *FURTHER_IN_TIME, *LATER_IN_TIME)
# They follow a joint, and time as well.
IN_TIME_TOO = ("softening_belt", "slipping_bush", "creeping_belt")
# Their load says which joint errs, where no useful one bears any.
ELSEWHERE_TOO = ("flank_change", "softening_belt", "ring_bolts", "creeping_belt")


def drawn(law: str, plan: Plan, seed: int, **time: np.ndarray) -> np.ndarray:
    """Errors of one arm."""
    return LAWS[law](plan, np.random.default_rng(seed), **time)


def test_they_are_eight_each_and_none_has_the_name_of_another():
    assert len(FOREIGN) == len(FURTHER) == len(LATER) == 8
    assert len({*UNNAMED, *LAWS}) == len(UNNAMED) + 24
    assert set(FURTHER_IN_TIME) <= set(FURTHER_OF_FLANGE) <= set(FURTHER)
    assert set(LATER_IN_TIME) <= set(LATER_OF_FLANGE) <= set(LATER)


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("law", LAWS)
def test_errors_are_of_a_good_arms_size_and_differ_from_view_to_view(law, arm):
    plan = plan_of(arm)
    for seed in SEEDS:
        error = drawn(law, plan, seed)
        assert error.shape == (VIEWS, 6 if law in OF_FLANGE else plan.arm.joints) and np.isfinite(error).all()
        assert 0.5 < relative(error, law in OF_FLANGE) < 2
        assert error.std(axis=0).max() > 0


@pytest.mark.parametrize("law", LAWS)
def test_a_seed_says_which_arm_it_is(law):
    plan = plan_of("KUKA KR30-3")
    arms = [drawn(law, plan, seed) for seed in SEEDS]
    assert np.array_equal(arms[0], drawn(law, plan, 0))
    assert all(np.abs(arms[0] - other).max() > 0 for other in arms[1:])


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("useful", [(0,), (3,), (5,)])
def test_neither_masses_nor_many_useful_joints_are_needed(law, useful):
    plan = plan_of("UR10", masses=False, useful=useful)
    error = drawn(law, plan, 1)
    assert np.isfinite(error).all() and error.std(axis=0).max() > 0
    if law not in (*OF_FLANGE, *ELSEWHERE_TOO):
        assert set(np.flatnonzero(np.ptp(error, axis=0))) == set(useful)


@pytest.mark.parametrize("law", LAWS)
def test_arms_that_hardly_move_err_by_no_more(law):
    """One pose for all views, one joint that moves, and a single view."""
    plan = plan_of("KUKA LBR iiwa 14")
    still = replace(plan, joints=np.tile(plan.joints[:1], (VIEWS, 1)), torque=np.tile(plan.torque[:1], (VIEWS, 1)))
    turning = replace(still, joints=still.joints + np.outer(np.linspace(-1, 1, VIEWS), np.eye(7)[0]))
    for few in (still, turning, plan_of("KUKA LBR iiwa 14", views=1)):
        for seed in SEEDS:
            error = drawn(law, few, seed)
            assert np.isfinite(error).all() and relative(error, law in OF_FLANGE) < 2
            if few is still and law not in (*IN_TIME, *IN_TIME_TOO[:2]):
                assert np.ptp(error, axis=0).max() < 1e-9 * SIZE


@pytest.mark.parametrize("law", IN_TIME)
def test_what_follows_time_follows_it_and_not_the_joints(law):
    assert np.array_equal(drawn(law, plan_of("UR10"), 2), drawn(law, plan_of("KUKA KR30-3"), 2))


@pytest.mark.parametrize("law", [*IN_TIME, *IN_TIME_TOO])
def test_time_counts_from_the_first_view_and_pauses_matter(law):
    plan = plan_of("UR10")
    uneven = [np.linspace(0.2, 4.0, VIEWS), np.random.default_rng(0).uniform(0.5, 3.0, VIEWS)]
    # An instant may fall between the same two views whatever the pauses are, as with the second.
    for steps in uneven[: 1 if law == "slipping_bush" else 2]:
        late = drawn(law, plan, 2, time=np.cumsum(steps))
        assert np.isfinite(late).all() and not np.array_equal(late, drawn(law, plan, 2))
        assert np.allclose(late, drawn(law, plan, 2, time=np.cumsum(steps) + 100.0))
