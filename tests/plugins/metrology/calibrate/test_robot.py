"""An arm's own errors as DH rows, URDF and files.

The calibrated arm as DH rows and URDF against a chain written out by hand.

An arm's model on another day: what holds there stays, what makes it worse is taken out or refused.
"""

import json
import tomllib
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_synth.arms import ARMS
from data_synth.fixtures.labelled_arm import DH_ROWS, flange, labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from data_synth.fixtures.true_arm import drawn, true_flanges
from data_synth.write import robot_table
from stitch.api.pipeline import change, run
from stitch.effects.contract import EFFECTS
from stitch.errors import InputError
from stitch.model.forward import corrected_capture
from stitch.model.model import Term, term_of
from stitch.model.model_toml import arm_model
from stitch.output.result_document import model_of
from stitch.output.session_files import dh_rows
from stitch.output.urdf_file import to_urdf
from stitch.plugins.metrology.calibrate.arm_model import ARM_FORMATS, ArmModel
from stitch.plugins.metrology.calibrate.command import show_robot
from stitch.plugins.metrology.calibrate.other_sessions import UNASKED, keep_what_holds, prove, require_held
from stitch.plugins.metrology.calibrate.robot import (
    LinkTable,
    calibrated_robot_of_run,
    link_table,
    robot_document,
    write_robot,
)
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of
from stitch.session.reading.robot_description import robot_from_dh, robot_from_urdf
from stitch.session.reading.session_folder import load_session
from stitch.session.robot import forward
from stitch.session.session import StatedRepeatability
from tests.command_line import ended

OFFSET = np.array([0, 1.2e-3, -1.5e-3, 0, 1e-3, 0])
SAG = 1.5e-6  # rad/mm: gravity, which no table holds
ARM = ARMS["ABB IRB 120"]
TABLE = robot_table(ARM)
ROBOT = robot_from_dh("IRB 120", "standard", TABLE["joints"], None, np.array(TABLE["gravity"]), "mm")
JOINTS = np.random.default_rng(2).uniform(-1, 1, (4, 6))
GEARS = np.array([0, 8e-4, 8e-4, 0, 0, 0])


def rms_with(robot, seed, **arm):
    """In a session of its own of the same arm, of which a table reports the poses."""
    session, *_ = labelled_cell(seed, views=60, **arm)
    views = tuple(replace(view, T_base_flange=forward(robot, view.joints)) for view in session.views)
    return run(replace(session, robot=robot, views=views)).residual_rms


def test_a_table_beside_which_gravity_stays_is_better_than_the_nominal_arm():
    """In poses and with a sensor that took no part, and as much better as it says."""
    session, *_ = labelled_cell(11, views=80, offset=OFFSET, sag=SAG)
    found = link_table(session)
    assert found.effects and found.heldout_rms < found.nominal_rms
    elsewhere = [rms_with(robot, 12, offset=OFFSET, sag=SAG) for robot in (found.robot, session.robot)]
    assert elsewhere[0] < elsewhere[1]
    assert elsewhere == pytest.approx([found.heldout_rms, found.nominal_rms], rel=0.35)
    assert "Fitted for the table alone and read back" in found.sentence("mm")


def test_half_of_a_range_serves_the_other_half():
    """Calibrated where joint 2 is below zero, judged where it is above."""
    session, *_ = labelled_cell(21, views=160, offset=OFFSET, sag=SAG)
    below = session.without([view.name for view in session.views if view.joints[1] > 0])
    above = session.without([view.name for view in session.views if view.joints[1] <= 0])
    found = link_table(below)
    views = tuple(replace(view, T_base_flange=forward(found.robot, view.joints)) for view in above.views)
    assert run(replace(above, robot=found.robot, views=views)).residual_rms < 0.7 * run(above).residual_rms
    assert found.ranges[1, 1] <= 0


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_of_a_right_arm_the_nominal_table_stays(seed):
    session, *_ = labelled_cell(60 + seed, views=40)
    found = link_table(session)
    assert not found.effects and found.robot is session.robot
    assert found.sentence("mm").startswith("No table of links is better than the nominal one")


def test_too_few_views_prove_nothing():
    session, *_ = labelled_cell(3, views=6, offset=OFFSET)
    found = link_table(session)
    assert not found.effects and "too few" in found.sentence("mm")


@pytest.mark.slow
def test_rows_without_a_sighting_prove_nothing():
    """They say from where the arm came, and are no perfect views: the rms is that of the views that show something."""
    session, *_ = labelled_cell(13, views=32, offset=OFFSET)
    rows = [(view, replace(view, name=f"{view.name}-moved", sighting=None)) for view in session.views]
    found = link_table(replace(session, views=tuple(view for both in rows for view in both)))
    alone = link_table(session)
    assert found.effects == alone.effects
    assert (found.heldout_rms, found.nominal_rms) == pytest.approx((alone.heldout_rms, alone.nominal_rms), rel=1e-3)


def test_the_command_says_what_the_table_is_worth_and_writes_it(tmp_path, few_effects):
    session, *_ = labelled_cell(11, views=60, offset=OFFSET, sag=SAG)
    folder = write_labelled(tmp_path / "s", session)
    told = ended("calibrate", "robot", folder, "-o", tmp_path / "out", "--json")
    table = json.loads(told.out)["table"]
    assert table["effects"] == ["joint_offset"] and table["heldout_rms"] < table["nominal_heldout_rms"]
    text = (tmp_path / "out" / "robot.toml").read_text()
    assert f"# {table['sentence']}\n" in text and "# Proved for j1 -6" in text
    # As a person would use it: put into the session in place of the nominal table.
    head, _ = (folder / "session.toml").read_text().split("[robot]")
    (folder / "session.toml").write_text(head + text)
    read = load_session(folder)
    assert run(read).residual_rms < 0.8 * run(session).residual_rms
    assert np.abs(forward(read.robot, session.joints) - forward(session.robot, session.joints)).max() > 0.1


def test_calibrate_robot_writes_rows_and_urdf_of_the_same_arm(tmp_path, few_effects):
    session, *_ = labelled_cell(2, views=24, offset=np.array([0, 1e-3, -1.5e-3, 0, 2e-3, 0]))
    folder = write_labelled(tmp_path / "s", session)
    told = ended("calibrate", "robot", folder, "-o", tmp_path / "out", "--json")
    document = json.loads(told.out)
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
    arm = calibrated_robot_of_run(replace(found, model=model))
    (tmp_path / "a.urdf").write_text(to_urdf(arm))
    urdf = robot_from_urdf(tmp_path / "a.urdf", "base_link", "flange", "mm", np.array([0, 0, -9.81]), None)
    rows = robot_from_dh("arm", convention, dh_rows(arm), None, np.array([0, 0, -9.81]), "mm")
    own = corrected_capture(found.measurement, model)
    T_base_flange = np.linalg.inv(own.T_reference_mount)
    for robot in (urdf, rows):
        np.testing.assert_allclose(
            forward(robot, found.measurement.views.joints), T_base_flange, atol=1e-6
        )  # mm: 1e-9 m


POSE = "x,y,z,qx,qy,qz,qw"


def cell(folder, reported):
    """A session folder, with the poses of the nominal arm where they are reported, and a stated repeatability."""
    session, *_ = labelled_cell(5, views=16, offset=OFFSET)
    write_labelled(folder, session)
    if reported:
        header, *rows = (folder / "views.csv").read_text().split()
        poses = [
            [*v.T_base_flange[:3, 3], *Rotation.from_matrix(v.T_base_flange[:3, :3]).as_quat()] for v in session.views
        ]
        lines = [row + "".join(f",{x:.9f}" for x in pose) for row, pose in zip(rows, poses, strict=True)]
        (folder / "views.csv").write_text("\n".join([f"{header},{POSE}", *lines]) + "\n")
    text = (folder / "session.toml").read_text()
    stated = "payload = { com = [0, 0, 80] }\nrepeatability = { position = 0.05, rotation_mrad = 0.04 }\n"
    (folder / "session.toml").write_text(text + stated)
    return load_session(folder)


def written(session, folder, effects=("joint_offset",)):
    """robot.toml of a table that is said to be proved, and what the terminal shows of it."""
    found = run(session, effects=["joint_offset"])
    robot = calibrated_robot_of_run(found) if effects else session.robot
    table = LinkTable(robot, effects, 0.1, 0.2)
    folder.mkdir()
    write_robot(table, found, folder)
    show_robot(found, robot_document(found, table, [], ""), [], folder)
    return found, (folder / "robot.toml").read_text()


@pytest.mark.parametrize("reported", [True, False])
def test_a_session_that_follows_the_advice_has_the_new_arm(tmp_path, capsys, reported):
    """Reported poses stand before any table: as long as they are there nothing changes."""
    session = cell(tmp_path / "s", reported)
    found, text = written(session, tmp_path / "out")
    lines = [line for line in text.splitlines() if line.startswith("# Take x … qw out of views.csv")]
    assert len(lines) == reported and capsys.readouterr().err.count("Take x … qw out of views.csv") == reported
    file, views = tmp_path / "s" / "session.toml", tmp_path / "s" / "views.csv"
    file.write_text(file.read_text().split("[robot]")[0] + text)
    poses = [view.T_base_flange for view in load_session(tmp_path / "s").views]
    before = [view.T_base_flange for view in session.views]
    assert np.allclose(poses, before, atol=1e-6) == reported
    if reported:
        views.write_text("\n".join(",".join(row.split(",")[:7]) for row in views.read_text().split()) + "\n")
    again = load_session(tmp_path / "s")
    arm = calibrated_robot_of_run(found)
    np.testing.assert_allclose([v.T_base_flange for v in again.views], forward(arm, session.joints), atol=1e-6)


def test_what_the_nominal_table_states_beside_its_rows_stays(tmp_path):
    session = cell(tmp_path / "s", reported=False)
    _, text = written(session, tmp_path / "out")
    file = tmp_path / "s" / "session.toml"
    file.write_text(file.read_text().split("[robot]")[0] + text)
    again = load_session(tmp_path / "s")
    assert (again.repeatability.position, again.repeatability.rotation) == pytest.approx((0.05, 4e-5))
    np.testing.assert_array_equal(again.robot.payload_com, [0, 0, 80])
    none = replace(session, repeatability=StatedRepeatability())
    assert "repeatability" not in written(none, tmp_path / "none")[1]


def test_what_was_found_and_not_proved_is_named(tmp_path, capsys):
    """Offsets are in the model and not in the table: another error of the arm was found."""
    session = cell(tmp_path / "s", reported=True)
    found, text = written(session, tmp_path / "out", effects=())
    said = "Found, but not in it for want of proof: joint_offset; model.toml has it."
    assert f"# {said}\n" in text and said in capsys.readouterr().err
    assert "no other effect" not in text and "Take x" not in text
    assert "The model has no other effect of the arm." in written(session, tmp_path / "proved")[1]
    assert robot_document(found, LinkTable(session.robot, ()), [], "")["unproved"] == ["joint_offset"]


def arm_with(*names):
    terms, told = [], {}
    for i, name in enumerate(names):
        told[name] = drawn(name, ARM, JOINTS, seed=i)
        own = EFFECTS[name].parameters(6, tuple("123456"), "mm")
        terms.append(Term(EFFECTS[name], own).at(np.array([told[name].get(p.name, 0.0) for p in own])))
    return ArmModel("cell", ROBOT, tuple(terms), "mm", JOINTS), told


@pytest.mark.parametrize("name", ["joint_offset", "link_geometry"])
def test_rows_put_the_flange_where_nature_does(name):
    arm, told = arm_with(name)
    rows = tomllib.loads(ARM_FORMATS["arm-dh"](arm))["robot"]["joints"]
    nature = true_flanges(name, told[name], ARM, JOINTS)
    assert np.array([flange(q, rows=rows) for q in JOINTS]) == pytest.approx(nature, abs=1e-9)


def test_urdf_puts_the_flange_where_nature_does(tmp_path):
    yourdfpy = pytest.importorskip("yourdfpy")
    arm, told = arm_with("link_geometry")
    (tmp_path / "arm.urdf").write_text(ARM_FORMATS["arm-urdf"](arm), encoding="utf-8")
    robot = yourdfpy.URDF.load(str(tmp_path / "arm.urdf"))
    for q, T in zip(JOINTS, true_flanges("link_geometry", told["link_geometry"], ARM, JOINTS), strict=True):
        robot.update_cfg(q)
        T[:3, 3] /= 1000
        assert robot.get_transform("flange", "base_link") == pytest.approx(T, abs=1e-9)


@pytest.mark.parametrize("kind", ARM_FORMATS)
def test_what_no_table_of_links_can_hold_is_said(kind):
    arm, _ = arm_with("joint_offset", "gear_eccentricity")
    assert "Not in it, because no table of links can hold it: gear_eccentricity" in ARM_FORMATS[kind](arm)


def of_one_day(q):
    """An error of gears of joints 2 and 3 that the other day has not."""
    return GEARS * np.sin(q)


@pytest.fixture(scope="module")
def days():
    """The arm that is off in its zeros on both days, and in its gears on the first alone."""
    return labelled_cell(31, views=60, offset=OFFSET, gears=of_one_day)[0], labelled_cell(32, views=60, offset=OFFSET)[
        0
    ]


@pytest.fixture(scope="module")
def calibrated(days):
    return change(run(days[0]), ["joint_offset", "gear_eccentricity"])


def test_what_holds_on_both_days_stays_and_the_rest_is_fitted_without_the_other(days, calibrated):
    kept, (taken_out, proved) = keep_what_holds(calibrated, [days[1]])
    assert kept.effects == ["joint_offset"]
    assert taken_out.startswith("Taken out: gear_eccentricity, which holds on cell alone")
    (proof,) = prove(arm_model(model_of(kept)), [days[1]])
    assert proved == proof.sentence and not proof.worse and proof.rms < 0.7 * proof.nominal_rms
    # By itself: the other day run with that arm, and without one.
    assert run(days[1], arm=arm_model(model_of(kept))).residual_rms == pytest.approx(proof.rms, rel=0.1)
    assert run(days[1]).residual_rms == pytest.approx(proof.nominal_rms, rel=0.1)


def test_a_right_arm_keeps_its_effects(days):
    here, there = labelled_cell(33, views=60, offset=OFFSET)[0], days[1]
    kept, proved = keep_what_holds(change(run(here), ["joint_offset"]), [there])
    assert kept.effects == ["joint_offset"] and len(proved) == 1 and "took no part" in proved[0]


def test_an_arm_that_makes_another_day_worse_is_refused(days):
    wrong = arm_model(model_of(change(run(labelled_cell(34, 60, gears=of_one_day)[0]), ["gear_eccentricity"])))
    right = labelled_cell(35, views=60)[0]
    assert prove(wrong, [right])[0].worse
    with pytest.raises(InputError, match="makes another session worse.*calibrate robot SESSION --on cell"):
        require_held(wrong, [right])


def test_nothing_is_claimed_of_other_days_where_none_was_asked(calibrated):
    kept, proved = keep_what_holds(calibrated, [])
    assert kept is calibrated and proved == [UNASKED]


def test_a_table_that_is_worse_on_another_day_is_not_written():
    """Calibrated with zeros that were set anew before the other day."""
    here, there = labelled_cell(36, views=80, offset=OFFSET)[0], labelled_cell(37, views=60)[0]
    assert link_table(here).effects
    table = link_table(here, [there])
    assert not table.effects and table.robot is here.robot
    assert table.sentence("mm").startswith("The best table leaves")


def test_the_command_says_what_was_proved_where(tmp_path, few_effects):
    for name, seed in (("monday", 41), ("tuesday", 42)):
        write_labelled(tmp_path / name, labelled_cell(seed, views=40, offset=OFFSET)[0])
    arguments = ["calibrate", "robot", str(tmp_path / "monday"), "--on", str(tmp_path / "tuesday"), "-o"]
    told = ended(*arguments, tmp_path / "arm")
    said = " ".join("".join(told).split())
    assert "On session tuesday, which took no part, it leaves" in said
    assert "The model: On session tuesday" in (tmp_path / "arm" / "robot.toml").read_text()
    told = ended("export", tmp_path / "arm", "--to", "arm-dh", "--on", tmp_path / "tuesday")
    assert "On session tuesday" in " ".join("".join(told).split())
