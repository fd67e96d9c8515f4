"""Every order of Euler angles against products of turns about one axis, written out here."""

import numpy as np
import pytest

from stitch.errors import InputError
from stitch.plugins.intake.layouts import ColumnLayout
from stitch.plugins.intake.raw_poses import RawPoses
from stitch.plugins.intake.readings import StatedTable, mixed_readings, readings, rotation_conventions


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
