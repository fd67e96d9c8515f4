"""Laws that were written apart from what judges them: sizes, shapes, and that each is drawn anew for every arm."""

import numpy as np
import pytest

from data_synth.arms import ARMS
from data_synth.foreign_laws import FOREIGN, FOREIGN_OF_FLANGE
from data_synth.further_laws import FURTHER, FURTHER_IN_TIME, FURTHER_OF_FLANGE
from data_synth.later_laws import LATER, LATER_IN_TIME, LATER_OF_FLANGE
from data_synth.moment import Plan
from data_synth.unnamed_laws import UNNAMED
from tests.data_synth.law_plans import SEEDS, VIEWS, plan_of, relative

LAWS, OF_FLANGE = FOREIGN | FURTHER | LATER, (*FOREIGN_OF_FLANGE, *FURTHER_OF_FLANGE, *LATER_OF_FLANGE)
# Their load says which joint errs, where no useful one bears any.
ELSEWHERE_TOO = ("flank_change", "softening_belt", "ring_bolts", "creeping_belt")


def drawn(law: str, plan: Plan, seed: int) -> np.ndarray:
    """Errors of one arm."""
    return LAWS[law](plan, np.random.default_rng(seed))


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
