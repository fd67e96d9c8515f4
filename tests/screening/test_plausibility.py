"""What is said of a session as a whole: few views that disagree, and rotations written with few decimals."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.in_memory import session_of
from data_synth.ordinary_arm import draw_arm
from data_synth.simulate import on_rail
from stitch.api.pipeline import run
from stitch.numerics import frames
from stitch.screening.plausibility import check_few_views, find_rounding
from stitch.session.session import Cloud

EXACT = Rotation.random(400, rng=np.random.default_rng(3))


@pytest.fixture(scope="module")
def three_views():
    return session_of(measured_blade(22, views=3, pixels=80))


def test_three_views_that_agree_raise_no_doubt(three_views):
    assert run(three_views).doubts == ()


def test_one_of_three_views_that_is_off_is_doubted_and_no_other_accused(three_views):
    first, off, last = three_views.views
    moved = replace(off, cloud=Cloud(off.cloud.points + np.array([0.0, 2.0, 1.0])))
    found = run(replace(three_views, views=(first, moved, last)))
    assert found.left_out == () and len(found.doubts) == 1
    assert found.doubts[0].startswith("Three poses contradict their scans by")
    assert f" to 1 that a view is off, most likely {off.name}" in found.doubts[0]


def test_four_views_of_which_one_is_off_by_a_millimetre_are_doubted():
    four_views = session_of(measured_blade(22, views=4, pixels=60))
    first, off, *rest = four_views.views
    moved = replace(off, cloud=Cloud(off.cloud.points + np.array([0.0, 0.87, 0.49])))
    found = run(replace(four_views, views=(first, moved, *rest)))
    assert found.left_out or found.doubts[0].startswith("Four poses contradict their scans by")


def test_an_ordinary_arm_that_leaves_more_than_it_repeats_is_no_doubt():
    """Joints and links a little wrong displace each of four views by tenths of a millimetre."""
    measured = measured_blade(23, views=4, pixels=60)
    plan = measured.plan
    arm = draw_arm(plan.arm.joints, 0.6, np.random.default_rng(1))
    found = run(session_of(replace(measured, T_base_flange=on_rail(arm.flange(plan.arm, plan.joints), measured.rail))))
    assert found.fit.repeatability.translation > 0.02 and found.doubts == () and found.left_out == ()


def test_views_that_nothing_can_be_tested_by_say_so():
    """As many numbers as one hand-eye takes up: flat parts of which every overlap shows three."""
    search = SimpleNamespace(null_projector=SimpleNamespace(degrees=0))
    found = SimpleNamespace(left_out=(), suspected=(), blunder_search=search)
    session = SimpleNamespace(views=range(3), length_unit="mm")
    assert check_few_views(session, found).startswith("No test says whether these three views belong together")


def poses(R):
    return frames.make(R.as_matrix(), np.zeros(3))


@pytest.mark.parametrize("written", ["quaternion", "ZYX", "xyz", "ZYZ"])
@pytest.mark.parametrize("decimals", [0, 1, 2, 3])
def test_numbers_of_few_decimals_turn_poses_by_what_is_said(written, decimals):
    if decimals == (0 if written == "quaternion" else 3):
        pytest.skip("nobody rounds so far, or so little")
    if written == "quaternion":
        rounded = Rotation.from_quat(np.round(EXACT.as_quat(), decimals))
    else:
        angles = np.round(EXACT.as_euler(written, degrees=True), decimals)
        rounded = Rotation.from_euler(written, angles, degrees=True)
    found = find_rounding(poses(rounded))
    assert (found.kind, found.decimals) == ("quaternion" if written == "quaternion" else "euler", decimals)
    turned = (rounded * EXACT.inv()).as_rotvec()
    assert found.rotation == pytest.approx(np.sqrt(np.mean(turned**2)), rel=0.1)


def test_numbers_of_nine_decimals_and_poses_that_never_turn_are_not_rounded():
    assert find_rounding(poses(Rotation.from_quat(np.round(EXACT.as_quat(), 9)))) is None
    assert find_rounding(np.tile(np.eye(4), (5, 1, 1))) is None
