"""URDF: what is read, and what cannot serve."""

import numpy as np
import pytest

from stitch.errors import InputError
from stitch.measurement.robot import forward
from stitch.reading.urdf import robot_from_urdf

GRAVITY = np.array([0.5, -0.2, -9.81])


def test_urdf_axis_origin_and_fixed_joints(tmp_path):
    """By hand: 1 m up, turn about y by 90°, 0.5 m along the turned x, which now points down."""
    (tmp_path / "a.urdf").write_text(
        '<robot name="a"><link name="b"/><link name="l"/><link name="f"/>'
        '<joint name="j" type="revolute"><origin xyz="0 0 1"/><parent link="b"/><child link="l"/><axis xyz="0 1 0"/></joint>'
        '<joint name="k" type="fixed"><origin xyz="0.5 0 0"/><parent link="l"/><child link="f"/></joint></robot>'
    )
    arm = robot_from_urdf(tmp_path / "a.urdf", "b", "f", "mm", GRAVITY)
    assert np.allclose(forward(arm, np.array([np.pi / 2]))[:3, 3], [0, 0, 500])


@pytest.mark.parametrize(("joint", "message"), [("prismatic", "revolute"), ("revolute", "no chain")])
def test_urdf_that_cannot_serve(tmp_path, joint, message):
    (tmp_path / "a.urdf").write_text(
        f'<robot name="a"><link name="b"/><link name="l"/><joint name="j" type="{joint}"><parent link="b"/><child link="l"/></joint></robot>'
    )
    flange = "l" if joint == "prismatic" else "nowhere"
    with pytest.raises(InputError, match=message):
        robot_from_urdf(tmp_path / "a.urdf", "b", flange, "mm", GRAVITY)
