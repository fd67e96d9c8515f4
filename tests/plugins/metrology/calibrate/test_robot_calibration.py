"""A calibrated arm as DH rows and URDF: both place the flange as the model does."""

import json
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import (
    DH_ROWS,
    labelled_cell,
)
from data_synth.fixtures.labelled_files import write_labelled
from stitch.api.pipeline import run
from stitch.cli.main import main
from stitch.effects.contract import EFFECTS
from stitch.model.forward import corrected_capture
from stitch.model.model import term_of
from stitch.output.session_files import dh_rows
from stitch.output.urdf_file import to_urdf
from stitch.plugins.metrology.calibrate.robot import calibrated_robot_of_run
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of
from stitch.session.reading.robot_description import robot_from_dh, robot_from_urdf
from stitch.session.robot import forward


def test_calibrate_robot_writes_rows_and_urdf_of_the_same_arm(tmp_path, capsys, few_effects):
    session, *_ = labelled_cell(2, views=24, offset=np.array([0, 1e-3, -1.5e-3, 0, 2e-3, 0]))
    folder = write_labelled(tmp_path / "s", session)
    with pytest.raises(SystemExit) as stop:
        main(["calibrate", "robot", str(folder), "-o", str(tmp_path / "out"), "--json"])
    assert not stop.value.code
    document = json.loads(capsys.readouterr().out)
    assert document["kind"] == "robot" and len(document["robot"]) == 6 and document["next"]
    assert ElementTree.parse(tmp_path / "out" / "robot.urdf").getroot().tag == "robot"
    robot = robot_from_dh("arm", "standard", document["robot"], None, np.array([0, 0, -9.81]), "mm")
    urdf = robot_from_urdf(tmp_path / "out" / "robot.urdf", "base_link", "flange", "mm", np.array([0, 0, -9.81]), None)
    joints = np.random.default_rng(0).uniform(-3, 3, (50, 6))
    np.testing.assert_allclose(forward(urdf, joints), forward(robot, joints), atol=1e-6)  # mm: 1e-9 m


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_rows_and_urdf_place_the_flange_as_the_chain_does(convention, tmp_path):
    session, *_ = labelled_cell(7, views=30)
    rng = np.random.default_rng(3)
    nominal = robot_from_dh("arm", convention, DH_ROWS, None, np.array([0, 0, -9.81]), "mm")
    views = tuple(replace(v, T_base_flange=forward(nominal, v.joints)) for v in session.views)
    # What was seen does not matter here, and would contradict the other robot.
    found, session = run(session), replace(session, robot=nominal, views=views)
    found = replace(found, session=session, measurement=measurement_of(session, prepare_capture(session)))
    zero = [term_of(found.measurement, EFFECTS[name]) for name in ("joint_offset", "link_geometry")]
    model = found.model.with_terms([term.at(1e-3 * rng.normal(size=len(term.parameters))) for term in zero])
    arm = calibrated_robot_of_run(replace(found, model=model)).robot
    (tmp_path / "a.urdf").write_text(to_urdf(arm))
    urdf = robot_from_urdf(tmp_path / "a.urdf", "base_link", "flange", "mm", np.array([0, 0, -9.81]), None)
    rows = robot_from_dh("arm", convention, dh_rows(arm), None, np.array([0, 0, -9.81]), "mm")
    own = corrected_capture(found.measurement, model)
    T_base_flange = np.linalg.inv(own.T_reference_mount)
    for robot in (urdf, rows):
        np.testing.assert_allclose(
            forward(robot, found.measurement.views.joints), T_base_flange, atol=1e-6
        )  # mm: 1e-9 m
