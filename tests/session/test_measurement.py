"""What effects know of the views: torques against virtual work, what friction within play leaves behind, gaps of columns."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import flange, labelled_cell
from stitch.api.check import session_summary
from stitch.api.pipeline import run
from stitch.errors import InputError
from stitch.session.measurement import require_rising_times, views_of
from stitch.session.notes import gaps_note, payload_note
from stitch.session.torques import torques_of

GRAVITY = 9.81
COMPLIANCE = 4e-6  # rad/(N m)
LOADS = np.repeat([0.0, 4.0, 12.0], 14)


def robot():
    return labelled_cell(0, views=2)[0].robot


def test_torque_of_a_payload_is_minus_the_slope_of_its_height():
    """V = m g z of the flange's origin; the kinematics are the fixture's own."""
    q = np.random.default_rng(3).uniform(-1.2, 1.2, (5, 6))
    found = torques_of(robot(), q, np.full(5, 7.0))
    names = list(found.names)
    for i in range(6):
        step = 1e-6 * np.eye(6)[i]
        slope = np.array([(flange(x + step)[2, 3] - flange(x - step)[2, 3]) / 2e-6 for x in q]) * 1e-3
        own = found.values[:, names.index(str(i + 1))] if str(i + 1) in names else 0.0
        np.testing.assert_allclose(own, -7.0 * GRAVITY * slope, atol=1e-6)


def test_masses_of_links_stay_where_the_column_takes_the_payloads_place():
    heavy = replace(robot(), mass=np.array([0, 9.0, 4.0, 2.0, 1.0, 0.5]), payload_mass=3.0)
    q = np.random.default_rng(4).uniform(-1.2, 1.2, (4, 6))
    np.testing.assert_allclose(torques_of(heavy, q, np.full(4, 3.0)).values, torques_of(heavy, q).values, atol=1e-9)


def test_a_stated_payload_is_not_taken_for_all_that_hangs_on_the_arm():
    """Without masses of links it is known beside what is not, as a column would say it."""
    q = np.random.default_rng(5).uniform(-1.2, 1.2, (4, 6))
    stated = torques_of(replace(robot(), payload_mass=4.0), q)
    column = torques_of(robot(), q, np.full(4, 4.0))
    assert stated.names == column.names and set(torques_of(robot(), q).names) < set(stated.names)
    np.testing.assert_allclose(stated.values, column.values)


def test_what_hangs_at_the_flange_for_want_of_a_centre_of_mass_is_said():
    session, *_ = labelled_cell(6, views=12, payload=LOADS[10:22])
    session = replace(session, scanner=replace(session.scanner, kind="tracker"))
    assert payload_note(session).startswith("The payload, up to 4 kg, counts at the flange's origin")
    assert payload_note(session) in run(session).notes and session_summary(session)["notes"] == [payload_note(session)]
    assert not payload_note(replace(session, robot=replace(session.robot, payload_com=np.array([0, 0, 80.0]))))
    bare = replace(session, views=tuple(replace(view, covariates={}) for view in session.views))
    assert not payload_note(bare) and session_summary(bare)["notes"] == []
    assert payload_note(replace(bare, robot=replace(bare.robot, payload_mass=3.0)))


def test_one_compliance_explains_all_loads():
    """Joint 2 yields to the payload alone: more load, more sag, one number."""
    sag = COMPLIANCE * GRAVITY * 1e-3  # rad/(kg mm)
    session, *_ = labelled_cell(6, views=len(LOADS), sag=sag, payload=LOADS)
    found = run(session, effects=["joint_compliance"])
    own = {p.name: p for p in found.terms[0].parameters}
    assert own["c2"].unit == "rad/(N m)" and abs(own["c2"].value) == pytest.approx(COMPLIANCE, abs=4 * own["c2"].sigma)
    assert own["c2"].sigma < COMPLIANCE / 4  # nobody would take it for zero
    blind = replace(session, views=tuple(replace(view, covariates={}) for view in session.views))
    # Three standard errors of the rms of 42 views with four targets of three coordinates each.
    chance = 3 / np.sqrt(2 * 42 * 12)
    assert found.heldout_rms < (1 - chance) * run(blind, effects=["joint_compliance"]).heldout_rms


def test_torques_that_drives_report_take_the_place_of_those_of_gravity():
    session, *_ = labelled_cell(7, views=3)
    drives = np.arange(18.0).reshape(3, 6)
    rows = tuple(
        replace(view, covariates={f"j{i + 1}_torque_nm": t for i, t in enumerate(row)})
        for view, row in zip(session.views, drives, strict=True)
    )
    views = views_of(replace(session, views=rows))
    assert views.torques.names == tuple("123456") and not views.covariates
    np.testing.assert_array_equal(views.sag(np.eye(6)[1])[:, 1], -drives[:, 1])
    some = tuple(replace(view, covariates={"j1_torque_nm": 1.0}) for view in session.views)
    assert not views_of(replace(session, views=some)).torques.measured


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


def test_a_column_with_a_gap_is_told_and_not_used():
    session = labelled_cell(3, views=5)[0]
    assert gaps_note(session) == ""
    full = replace(session, views=[replace(v, covariates={"hall": 20.0}) for v in session.views])
    assert gaps_note(full) == "" and views_of(full).has("hall")
    gap = replace(full, views=[*full.views[:3], *(replace(v, covariates={}) for v in full.views[3:])])
    first = gap.names[3]
    assert gaps_note(gap) == f"Not used, since some views have none: hall ({first} and 1 more without)."
    assert not views_of(gap).has("hall")


def test_so_is_a_time_or_a_pose_of_joints_that_is_missing_once():
    session = labelled_cell(3, views=5)[0]
    views = [*session.views[:4], replace(session.views[4], time_s=None, joints=None)]
    told = gaps_note(replace(session, views=views))
    assert ("time_s" in told) == any(v.time_s is not None for v in views) and "joint angles (" in told


def test_times_that_fall_are_refused_by_the_view():
    """A folder's are when it is read; those of a session that a program changed, when they are first asked for."""
    session = labelled_cell(0, views=6)[0]
    times = (5.0, 6.0, None, 5.5, 7.0, 8.0)
    views = tuple(replace(view, time_s=t) for view, t in zip(session.views, times, strict=True))
    with pytest.raises(InputError, match=f"time_s of view {views[3].name} falls"):
        require_rising_times(replace(session, views=views))
