"""What the flange carries and what drives report, view by view, against virtual work and an arm that sags by hand."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import flange, labelled_cell
from stitch.api.pipeline import run
from stitch.cli.check import session_summary
from stitch.session.measurement import views_of
from stitch.session.notes import payload_note
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
