"""The calibrated arm as DH rows and URDF against a chain written out by hand."""

import tomllib

import numpy as np
import pytest

from data_synth.arms import ARMS
from data_synth.fixtures.true_arm import drawn, true_flanges
from data_synth.write import robot_table
from stitch.effects import EFFECTS
from stitch.model.model import Term
from stitch.plugins.metrology.calibrate.arm_model import ARM_FORMATS, ArmModel
from stitch.session.reading.robot_description import robot_from_dh

ARM = ARMS["ABB IRB 120"]
TABLE = robot_table(ARM)
ROBOT = robot_from_dh("IRB 120", "standard", TABLE["joints"], None, np.array(TABLE["gravity"]), "mm")
JOINTS = np.random.default_rng(2).uniform(-1, 1, (4, 6))


def arm_with(*names):
    terms, told = [], {}
    for i, name in enumerate(names):
        told[name] = drawn(name, ARM, JOINTS, seed=i)
        own = EFFECTS[name].parameters(6, tuple("123456"), "mm")
        terms.append(Term(EFFECTS[name], own).at(np.array([told[name].get(p.name, 0.0) for p in own])))
    return ArmModel("cell", ROBOT, tuple(terms), "mm", JOINTS), told


def product(rows, joints):
    """Standard DH, multiplied out."""
    T = np.eye(4)
    for row, q in zip(rows, joints, strict=True):
        angle, alpha = q + np.radians(row["theta_deg"]), np.radians(row["alpha_deg"])
        c, s, ca, sa = np.cos(angle), np.sin(angle), np.cos(alpha), np.sin(alpha)
        a, d = row["a"], row["d"]
        T = T @ np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]])
    return T


@pytest.mark.parametrize("name", ["joint_offset", "link_geometry"])
def test_rows_put_the_flange_where_nature_does(name):
    arm, told = arm_with(name)
    rows = tomllib.loads(ARM_FORMATS["arm-dh"](arm))["robot"]["joints"]
    nature = true_flanges(name, told[name], ARM, JOINTS)
    assert np.array([product(rows, q) for q in JOINTS]) == pytest.approx(nature, abs=1e-9)


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
