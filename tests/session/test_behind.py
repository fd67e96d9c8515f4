"""What friction within play leaves behind: known by hand for a joint that goes and comes back."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import labelled_cell
from stitch.session.measurement import views_of

THERE_AND_BACK = np.array([0.0, 0.1, 0.5, 1.0, 0.9, 0.7, 0.5, 0.6, 0.9])
# Within 0.2: dragged from 0.5 on; at rest at 0.8 until the joint is below 0.6; dragged back to 0.7; at rest again.
STAYS_AT = np.array([0.0, 0.0, 0.3, 0.8, 0.8, 0.8, 0.7, 0.7, 0.7])


@pytest.fixture
def views():
    session, *_ = labelled_cell(0, views=len(THERE_AND_BACK))
    known = views_of(session)
    joints = known.joints.copy()
    joints[:, 2] = THERE_AND_BACK
    return replace(known, joints=joints, path=joints)


def test_a_joint_that_comes_back_leaves_it_behind_until_the_play_is_over(views):
    np.testing.assert_allclose(views.behind(2, 0.2), STAYS_AT - THERE_AND_BACK, atol=1e-12)


def test_some_of_the_views_remember_those_between(views):
    keep = [3, 6, 8]
    np.testing.assert_allclose(views.only(keep).behind(2, 0.2), (STAYS_AT - THERE_AND_BACK)[keep], atol=1e-12)


def test_a_pose_that_nobody_took_yet_is_approached_from_the_last_one(views):
    there = np.array([[0.8], [0.95], [0.2]])
    joints = np.repeat(views.joints[-1:], 3, axis=0)
    joints[:, 2:3] = there
    asked = replace(views, count=3, joints=joints, number=np.full(3, len(THERE_AND_BACK)))
    np.testing.assert_allclose(asked.behind(2, 0.2), [0.7 - 0.8, 0.75 - 0.95, 0.4 - 0.2], atol=1e-12)
