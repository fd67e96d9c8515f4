"""views.csv: joints, poses, times, loads and covariates."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_synth.fixtures.edits import edit
from stitch.errors import InputError
from stitch.session.reading.csv_files import TableRow
from stitch.session.reading.robot_description import robot_from_dh
from stitch.session.reading.session_folder import load_session
from stitch.session.reading.views_table import require_loads
from stitch.session.robot import forward

JOINTS = [
    {"a": 100, "alpha_deg": 90, "d": 400},
    {"a": 500, "d": 0, "alpha_deg": 0},
    {"a": 300, "d": 50, "alpha_deg": 20},
]


def joints_session(folder, rows, header="view,cloud,j1_deg,j2_deg,j3_deg,humidity,note"):
    rows_text = ", ".join(f"{{ a = {j['a']}, alpha_deg = {j['alpha_deg']}, d = {j['d']} }}" for j in JOINTS)
    edit(folder / "session.toml", r"\[scanner\]", f'[robot]\ndh = "standard"\njoints = [{rows_text}]\n[scanner]')
    (folder / "views.csv").write_text("\n".join([header, *rows]) + "\n")


def test_joints_give_the_pose_the_approach_and_covariates(session):
    joints_session(
        session,
        ["a,clouds/v000.ply,10,20,30,41,first", "b,clouds/v001.ply,5,20,40,42,", "c,clouds/v002.ply,5,30,20,,x"],
    )
    views = load_session(session).views
    robot = robot_from_dh("r", "standard", JOINTS, None, np.zeros(3), "mm")
    assert np.allclose(views[1].T_base_flange, forward(robot, np.radians([5, 20, 40])))
    assert views[0].approach.tolist() == [0, 0, 0]
    assert views[1].approach.tolist() == [-1, 0, 1]
    assert [view.covariates for view in views] == [{"humidity": 41.0}, {"humidity": 42.0}, {}]


def test_joints_and_pose_that_contradict_are_refused(session):
    rows = (session / "views.csv").read_text().splitlines()
    header = rows[0] + ",j1_deg,j2_deg,j3_deg"
    joints_session(session, [row + ",10,20,30" for row in rows[1:]], header)
    with pytest.raises(InputError, match="line 2.* mm and .*check robot.dh"):
        load_session(session)


def test_rows_out_of_the_order_of_time_are_refused(session):
    rows = (session / "views.csv").read_text().splitlines()
    more = ("time_s", "100", "", "50")
    (session / "views.csv").write_text("\n".join(f"{a},{b}" for a, b in zip(rows, more, strict=True)) + "\n")
    with pytest.raises(InputError, match="line 4: time_s 50 stands below 100; sort the rows"):
        load_session(session)


def test_joint_columns_are_called_as_the_format_calls_them(session):
    joints_session(session, ["a,clouds/v000.ply,10,20,30"], "view,cloud,j01_deg,j02_deg,j03_deg")
    with pytest.raises(InputError, match="neither joints \\(j1_deg"):
        load_session(session)


@pytest.mark.parametrize(
    ("columns", "told"),
    [
        ("j1_deg,j3_deg", "line 1: no column j2_deg; .* without a gap; to fix: add it"),
        ("j1_deg,j2_deg", "2 joint columns, but the robot has 3; to fix: add j3_deg"),
        ("j1_deg,j2_deg,j3_deg,j4_deg", "4 joint columns, but the robot has 3; to fix: leave out those beyond"),
    ],
)
def test_a_joint_column_that_is_missing_is_named(session, columns, told):
    numbers = ",".join("10" for _ in columns.split(","))
    joints_session(session, [f"a,clouds/v000.ply,{numbers}"], f"view,cloud,{columns}")
    with pytest.raises(InputError, match=told):
        load_session(session)


def with_pose_of(angles, unit):
    """A row with a pose that the arm has at these angles (deg), and the angles in a unit."""
    T = forward(robot_from_dh("r", "standard", JOINTS, None, np.zeros(3), "mm"), np.radians(angles))
    pose = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
    return ",".join(f"{x:.9f}" for x in [*pose, *(angles if unit == "deg" else np.radians(angles))])


@pytest.mark.parametrize(
    ("names", "unit", "told"),
    [
        ("J1,J2,J3", "deg", "columns J1, J2, J3 hold the joint angles .* call them j1_deg … j3_deg$"),
        ("axis_1_rad,axis_2_rad,axis_3_rad", "rad", "call them j1_deg … j3_deg, in degrees$"),
    ],
)
def test_joint_angles_under_other_names_are_no_covariates(session, names, unit, told):
    rows = [f"{view},clouds/{view}.ply,{with_pose_of(angles, unit)}"
            for view, angles in (("v000", [10, 20, 30]), ("v001", [5, -20, 40]))]  # fmt: skip
    joints_session(session, rows, f"view,cloud,x,y,z,qx,qy,qz,qw,{names}")
    with pytest.raises(InputError, match=told):
        load_session(session)


def test_columns_that_are_only_called_like_joints_are_covariates(session):
    """Temperatures of the axes, say: they do not lead to the poses."""
    rows = [f"{view},clouds/{view}.ply,{with_pose_of([10, 20, 30], 'deg').rsplit(',', 3)[0]},41,42,43"
            for view in ("v000", "v001")]  # fmt: skip
    joints_session(session, rows, "view,cloud,x,y,z,qx,qy,qz,qw,A1,A2,A3")
    assert load_session(session).views[0].covariates == {"A1": 41.0, "A2": 42.0, "A3": 43.0}


def test_robot_with_another_number_of_joints(session):
    joints_session(session, ["a,clouds/v000.ply,10,20"], "view,cloud,j1_deg,j2_deg")
    with pytest.raises(InputError, match="2 joint columns, but the robot has 3"):
        load_session(session)


BOTH = ["j1_torque_nm", "j2_torque_nm"]


@pytest.mark.parametrize(
    ("header", "rows", "told"),
    [
        (BOTH, [["5", "-6"], ["7", "8"]], None),
        (BOTH, [["", ""], ["", ""]], None),
        (BOTH[:1], [["5"], ["6"]], "line 1: torques of j1_torque_nm, but the table has 2 joints"),
        ([*BOTH, "j3_torque_nm"], [["5", "6", "7"]], "line 1: torques of .*j3_torque_nm, but the table has 2 joints"),
        (BOTH, [["5", "6"], ["7", ""]], "line 3: j2_torque_nm is ''; write a number in every row"),
        (BOTH, [["5", "6e9"]], "line 2: j2_torque_nm is 6e.09, as on no arm; to fix: correct its unit"),
    ],
)
def test_torques_are_whole_or_refused(header, rows, told):
    file = Path("views.csv")
    table = [TableRow(file, line, dict(zip(header, row, strict=True))) for line, row in enumerate(rows, 2)]
    if told is None:
        return require_loads(file, header, table, joints=2)
    with pytest.raises(InputError, match=told):
        require_loads(file, header, table, joints=2)
