"""Places, widths and plays of a formula: moved to where the truth is, within what the views know, readable at the end."""

import re

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import TARGETS, labelled_cell
from stitch.api.pipeline import run
from stitch.diagnosis.diagnose import linear_model_of
from stitch.plugins.explain.dictionary import Ingredient, Nonlinear, build_dictionary, bump_of_joint, view_quantities
from stitch.plugins.explain.explain import explain
from stitch.plugins.explain.search import HalfModel, refine_parameters, round_parameters
from tests.diagnosis.freed_blade import freed_blade

MIDDLE, WIDTH, HEIGHT = 0.31, 0.13, 6e-4  # rad: between the places and beside the widths that are tried


def tooth(q):
    """A damaged tooth in the gear of joint 3."""
    return HEIGHT * np.array([0, 0, np.exp(-0.5 * ((q[2] - MIDDLE) / WIDTH) ** 2), 0, 0, 0])


@pytest.fixture(scope="module")
def labelled():
    session, *_ = labelled_cell(2, views=80, targets=TARGETS[:2], gears=tooth)
    return linear_model_of(run(session))


def halves(linear):
    numbers = np.arange(linear.measurement.views.count)
    return numbers[::2], numbers[1::2]


@pytest.mark.parametrize("of", ["scans", "labelled points"])
def test_columns_view_by_view_are_the_columns_of_the_whole(of, labelled):
    """Formed from one view's displacement at a time, and from the response of all views."""
    if of == "scans":
        blade = freed_blade(6, 14)
        linear = blade.seen(blade.measured.T_base_flange)
    else:
        linear = labelled
    terms = build_dictionary(linear, view_quantities(linear.measurement.views))
    some = terms.ingredients[:: len(terms.ingredients) // 40]
    half = HalfModel(linear.restricted(()), terms, halves(linear)[0])
    expected = half.residual_columns(terms.columns(some))
    np.testing.assert_allclose(half.columns(some), expected, atol=1e-9 * np.abs(expected).max())


def test_a_bump_is_moved_to_its_place_and_width(labelled):
    """Begun as far off as the places and widths that are tried can be."""
    views = labelled.measurement.views
    terms = build_dictionary(labelled, view_quantities(views))
    begun = Ingredient("robot", 2, bump_of_joint(views, 2, MIDDLE + 0.07, 0.2))
    (found,) = refine_parameters([begun], HalfModel(labelled.restricted(()), terms, halves(labelled)[0]))
    middle, width = (p.value for p in found.quantity.nonlinear)
    assert middle == pytest.approx(MIDDLE, abs=0.02) and width == pytest.approx(WIDTH, rel=0.15)
    (told,) = round_parameters([found])
    assert [p.value for p in told.quantity.nonlinear] == [float(f"{x:.4g}") for x in (middle, width)]


def test_the_formula_is_the_law(labelled):
    """Over the measured range it differs from the truth by a tenth of the bump at the most."""
    found = explain(labelled)
    assert found.found and found.formula.startswith("q*3")
    q = labelled.measurement.views.joints
    code = re.search(r"true\[:, 2\] \+= a \* (.*)", found.source)[1]
    size = float(re.search(r"q3 ([-+0-9.e]+) rad", found.formula)[1])
    off = size * eval(code, {"np": np, "views": labelled.measurement.views})
    true = HEIGHT * np.exp(-0.5 * ((q[:, 2] - MIDDLE) / WIDTH) ** 2)
    assert np.abs(off - true).max() < 0.1 * HEIGHT


def test_a_parameter_stays_within_what_the_views_know():
    place, width = Nonlinear(0.1, 0.5, within=(-0.2, 0.3)), Nonlinear(0.2, 0.4, positive=True)
    assert (place.at(-3.0), place.at(0.1), place.at(2.0)) == (-0.2, pytest.approx(0.15), 0.3)
    assert width.at(-9.0) > 0 and width.at(1.0) == pytest.approx(0.2 * np.exp(0.4))
