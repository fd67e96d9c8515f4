"""Every order of Euler angles against products of turns about one axis, written out here.

Joint angles become poses by a URDF that lies beside them; judged by what the simulated arm reported.

Units of positions and clouds by their sizes, and positions of a site.

Poses that are no matrices are read as a table of them is, or refused in the same words.
"""

import csv

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_synth.write import write_session
from stitch.errors import InputError
from stitch.output.urdf_file import to_urdf
from stitch.plugins.intake.first_session import first_session
from stitch.plugins.intake.layouts import ColumnLayout, possible_layouts, unit_pairs
from stitch.plugins.intake.raw_poses import RawPoses, read_raw_poses
from stitch.plugins.intake.readings import (
    StatedTable,
    all_readings,
    mixed_readings,
    readings,
    rotation_conventions,
    with_uncoupled_joints,
)
from stitch.plugins.intake.session_draft import write_draft
from stitch.plugins.intake.stated_folder import StatedFolder
from stitch.plugins.intake.stated_poses import matrices_of_table
from stitch.session.reading.session_folder import load_session

CLOUD = np.random.default_rng(0).uniform(-0.07, 0.07, (500, 3)) + np.array([0, 0, 0.42])  # m
REACH = np.array([[0.54, 0.21, 0.71], [0.9, -0.1, 0.7]])  # m


def turn(axis, angle):
    """Rotation about a coordinate axis, from its definition."""
    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    R = np.eye(3)
    R[j, j] = R[k, k] = np.cos(angle)
    R[k, j], R[j, k] = np.sin(angle), -np.sin(angle)
    return R


ANGLES = np.array([[0.3, -0.8, 1.9], [-2.0, 0.4, 0.7]])


EULER = [word for word in rotation_conventions() if word.endswith(("intrinsic", "extrinsic"))]


@pytest.mark.parametrize("unit", ["rad", "deg"])
@pytest.mark.parametrize("word", EULER)
def test_orders_of_euler_angles(word, unit):
    written = np.degrees(ANGLES) if unit == "deg" else ANGLES
    (reading,) = readings(ColumnLayout(np.zeros((2, 3)), written, None, ""), word, unit)
    order, how = word.split("-")
    for T, angles in zip(reading.T, ANGLES, strict=True):
        first, second, third = (turn(axis, angle) for axis, angle in zip(order, angles, strict=True))
        expected = first @ second @ third if how == "intrinsic" else third @ second @ first
        assert np.allclose(T[:3, :3], expected, atol=1e-12)


def test_there_are_twelve_orders_on_either_side():
    assert len(EULER) == len(set(EULER)) == 24


def test_turns_in_another_order_than_the_columns_stand():
    (reading,) = readings(ColumnLayout(np.zeros((2, 3)), ANGLES, None, ""), "yxz-by-axis", "rad")
    x, y, z = ANGLES[0]
    assert np.allclose(reading.T[0, :3, :3], turn("y", y) @ turn("x", x) @ turn("z", z))


def test_degrees_where_numbers_exceed_a_turn_in_radians():
    assert {r.angle_unit for r in readings(ColumnLayout(np.zeros((2, 3)), ANGLES * 30, None, ""))} == {"deg"}


def test_a_convention_that_the_columns_cannot_have_is_refused():
    with pytest.raises(InputError, match="--rotation quaternion-xyzw"):
        readings(ColumnLayout(np.zeros((2, 3)), ANGLES, None, ""), "quaternion-xyzw")


def test_one_column_of_radians_among_degrees_is_read_so():
    angles = np.degrees(ANGLES)
    angles[:, 1] = ANGLES[:, 1]
    raw = RawPoses("t", None, np.hstack([np.full((2, 3), 700.0), angles]), ((), ()), "")
    found = [r for r in mixed_readings(raw, StatedTable()) if r.rotation == "zyx-intrinsic"]
    expected = [turn("z", a) @ turn("y", b) @ turn("x", c) for a, b, c in ANGLES]
    assert [r.words for r in found] == ["zyx-intrinsic, degrees, but its second angle in radians"]
    assert np.allclose(found[0].T[:, :3, :3], expected)
    in_degrees = RawPoses("t", None, np.hstack([np.full((2, 3), 700.0), np.full((2, 3), 50.0)]), ((), ()), "")
    assert not list(mixed_readings(in_degrees, StatedTable()))


JOINTS = [f"j{i}_deg" for i in range(1, 7)]


@pytest.fixture(scope="module")
def cell(still_cells, tmp_path_factory):
    """A session with joints and robot, and a folder with its clouds, a table of its joints in radians and its URDF."""
    folder = tmp_path_factory.mktemp("joints")
    write_session(folder / "cell", still_cells["eye_in_hand"], "cell")
    session = load_session(folder / "cell")
    raw = folder / "raw"
    (folder / "cell" / "clouds").rename(folder / "clouds")
    raw.mkdir()
    (folder / "clouds").rename(raw / "clouds")
    (raw / "arm.urdf").write_text(to_urdf(session.robot), encoding="utf-8")
    with (raw / "joint_states.csv").open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["time", *(f"joint_{i}" for i in range(1, 7))])
        writer.writerows([10.0 + i, *view.joints] for i, view in enumerate(session.views))
    return session, raw


def test_joint_angles_give_the_poses_that_the_arm_reported(cell):
    session, raw = cell
    table = read_raw_poses([raw / "joint_states.csv"])
    (reading,) = all_readings(table, raw / "arm.urdf", StatedTable(angle_unit="rad"))
    assert np.abs(reading.T - [v.T_base_flange for v in session.views]).max() < 1e-3
    with pytest.raises(InputError, match="URDF"):
        all_readings(table, None, StatedTable())


def test_the_scans_tell_the_unit_of_joint_angles_and_the_mount(cell, tmp_path):
    session, raw = cell
    first = first_session(raw, StatedFolder())
    write_draft(tmp_path / "made", first)
    made = load_session(tmp_path / "made")
    assert made.mount == "eye_in_hand" and first.choice.determined
    for a, b in zip(made.views, session.views, strict=True):
        assert np.allclose(a.joints, b.joints, atol=1e-8) and np.abs(a.T_base_flange - b.T_base_flange).max() < 1e-3
    assert [view.time_s for view in made.views] == [0, 1, 2, 3]


@pytest.mark.parametrize(("sign", "words"), [(-1.0, "j3 is j3 + j2"), (1.0, "j3 is j3 - j2"), (0.0, "")])
def test_joints_beside_poses_are_counted_as_the_poses_turn(cell, sign, words):
    session, raw = cell
    T = np.array([view.T_base_flange for view in session.views])
    shown = np.array([view.joints for view in session.views])
    shown[:, 2] += sign * shown[:, 1]
    header = (*(f"{axis} [mm]" for axis in "xyz"), "qx", "qy", "qz", "qw", *(f"j{i} [rad]" for i in range(1, 7)))
    numbers = np.hstack([T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_quat(), shown])
    (reading,) = all_readings(RawPoses("t", header, numbers, ((),) * len(T), ""), None, StatedTable())
    found = with_uncoupled_joints(reading, raw / "arm.urdf").layout
    assert np.allclose(found.joints, [view.joints for view in session.views]) and words in found.words
    assert bool(words) == ("turns as the poses" in found.words)


@pytest.mark.parametrize(
    ("poses", "clouds", "first"),
    [
        (1e3, 1e3, ("mm", "mm")),
        (1.0, 1.0, ("m", "m")),
        (1e3, 1.0, ("mm", "m")),
        (1e3, 1e2, ("mm", "cm")),
        (1 / 0.0254, 1 / 0.0254, ("inch", "inch")),
    ],
)
def test_units_are_those_of_a_usual_cell_under_which_the_motions_agree(poses, clouds, first):
    pairs = unit_pairs(REACH * poses, [CLOUD * clouds], poses / clouds)
    assert pairs[0] == first
    # A scale that is common to both is told by the usual size alone: cm compete with inches.
    assert (("cm", "cm") in pairs) == (first == ("inch", "inch"))


def test_what_all_positions_of_a_site_have_in_common_is_taken_off():
    site = np.array([403512.0, 5715430.0, 118.0])
    table = np.hstack([REACH + site, np.tile([0, 0, 0, 1.0], (2, 1))])
    header = ("x", "y", "z", "qx", "qy", "qz", "qw")
    (layout,) = possible_layouts(RawPoses("poses.csv", header, table, ((),) * 2, ""))
    assert np.abs(layout.position + layout.offset - table[:, :3]).max() < 1e-9
    assert np.abs(layout.position).max() < 2.0
    (near,) = possible_layouts(RawPoses("poses.csv", header, table - np.r_[site, np.zeros(4)], ((),) * 2, ""))
    assert near.offset == () and np.array_equal(near.position, table[:, :3] - site)


@pytest.fixture
def views(session):
    """Poses (V, 4, 4) mm and scans of a simulated cell, and its mount."""
    loaded = load_session(session)
    scale = {"mm": 1.0, "m": 1e3}[loaded.length_unit]
    T = np.array([view.T_base_flange for view in loaded.views])
    T[:, :3, 3] *= scale
    return T, [view.cloud.points * scale for view in loaded.views], loaded.mount


def test_quaternions_are_read_as_a_table_of_them(views):
    T, scans, mount = views
    rows = np.hstack([T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_quat()])
    read = matrices_of_table(rows, scans, "mm", "mm", mount)
    assert np.abs(read - T).max() < 1e-9


@pytest.mark.parametrize("height", [3, 4])
def test_matrices_in_one_row_are_read(views, height):
    T, scans, mount = views
    assert np.abs(matrices_of_table(T[:, :height].reshape(len(T), -1), scans, "mm", "mm", mount) - T).max() < 1e-9
    assert np.abs(matrices_of_table(T[:, :3], scans, "mm", "mm", mount) - T).max() < 1e-9


def test_what_is_no_table_stays_as_it_is(views):
    T, scans, mount = views
    for poses in (T, None, (Rotation.from_matrix(T[:, :3, :3]), T[:, :3, 3]), list(T)):
        assert matrices_of_table(poses, scans, "mm", "mm", mount) is poses


def test_angles_without_scans_that_tell_their_order_are_refused(views):
    T, _, mount = views
    rows = np.hstack([T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_euler("xyz", degrees=True)])
    with pytest.raises(InputError, match=r"can be read in \d+ ways; to fix: pass matrices"):
        matrices_of_table(rows, [None] * len(T), "mm", "mm", mount)
    with pytest.raises(InputError, match="hold no pose that is known"):
        matrices_of_table(np.hstack([rows, rows[:, :2]]), [None] * len(T), "mm", "mm", mount)
