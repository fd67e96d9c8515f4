"""Teeth of a belt and springs that stiffen: found as what they are, of as few numbers as they have."""

import re

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import TARGETS, labelled_cell
from stitch.api.pipeline import run
from stitch.diagnosis.diagnose import linear_model_of
from stitch.plugins.explain.dictionary import build_dictionary
from stitch.plugins.explain.explain import explain
from stitch.plugins.explain.quantities import Quantity, nonlinear_torque, saw_of_joint, view_quantities
from stitch.session.measurement import views_of

TOOTH, HEIGHT = 0.33, 8e-4  # rad


def belt(q):
    """Joint 3 creeps by `HEIGHT` along each tooth and jumps back."""
    teeth = q[2] / TOOTH + 0.3
    return HEIGHT * np.array([0, 0, teeth - np.floor(teeth) - 0.5, 0, 0, 0])


@pytest.mark.slow
@pytest.mark.parametrize("views", [40, 80])
def test_a_belt_that_jumps_is_found_with_its_tooth(views):
    session, *_ = labelled_cell(1, views=views, targets=TARGETS[:2], gears=belt)
    found = explain(linear_model_of(run(session)))
    assert found.found and found.formula.startswith("q*3 = q3")
    (saw,) = re.findall(r"([-+0-9.e]+) rad · saw of q\d, a tooth ([0-9.]+)°", found.formula)
    size, tooth = map(float, saw)
    assert size == pytest.approx(HEIGHT, rel=0.1) and np.radians(tooth) == pytest.approx(TOOTH, rel=0.02)


def test_a_saw_jumps_where_it_says_and_belongs_to_its_own_joint():
    views = views_of(labelled_cell(3, views=12)[0])
    saw = saw_of_joint(views, 1, 0.2, 0.05)
    at_jump = saw_of_joint(views, 1, 0.2, float(views.joints[4, 1]))
    assert abs(at_jump.values[4]) == pytest.approx(0.5)
    assert saw_of_joint(views, 1, 0.2, 0.05 + 3 * 0.2).text == saw.text
    slope = np.diff(saw.values) - np.diff(views.joints[:, 1]) / 0.2
    np.testing.assert_allclose(slope, np.round(slope), atol=1e-9)  # whole teeth are jumped over
    assert {q.joint for q in view_quantities(views) if q.kind == "teeth"} <= set(range(6))
    linear = linear_model_of(run(labelled_cell(3, views=12)[0]))
    of_teeth = [i for i in build_dictionary(linear, view_quantities(views)).ingredients if i.quantity.kind == "teeth"]
    assert of_teeth and all(i.index == i.quantity.joint for i in of_teeth)


@pytest.mark.parametrize("torque", [np.linspace(570, 612, 18), np.linspace(-5, 7, 18)], ids=["far from 0", "about 0"])
def test_what_no_line_does_is_left_of_a_power(torque):
    """Far from zero a cube is nearly a line: as it stands nothing of it would count as its own."""
    cube = cube_of(torque)
    beside = np.vander(torque - torque.mean(), 2)
    shares = beside.T @ cube.values / np.linalg.norm(beside, axis=0) / np.linalg.norm(cube.values)
    np.testing.assert_allclose(shares, 0, atol=1e-6)
    np.testing.assert_allclose(eval(cube.code, {"torque": torque}), cube.values, atol=1e-6 * np.abs(cube.values).max())
    step = (torque[1] - torque[0]) / float(f"{np.abs(torque).max():.3g}")
    np.testing.assert_allclose(np.diff(cube.values, 3), 6 * step**3, rtol=1e-3)


@pytest.mark.parametrize("torque", [np.repeat([570.0, 612.0], 6), 600 + np.linspace(0, 1e-6, 12)])
def test_of_few_torques_or_hardly_different_ones_nothing_is_left_but_rounding(torque):
    assert cube_of(torque) is None


def cube_of(torque):
    return nonlinear_torque(Quantity("τ", "torque", "N m", "torque", 2, torque), lambda x: x**3, "x³", "x**3")
