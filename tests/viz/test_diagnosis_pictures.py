"""Pictures of a diagnosis: where the error comes from, and how the scanner errs over its field."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from data_synth import kinematics
from data_synth.fixtures.labelled_arm import labelled_cell
from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.diagnosis import Diagnosis
from stitch.diagnosis.residual_structure import BudgetLine
from stitch.diagnosis.score import score
from stitch.effects.contract import EFFECTS
from stitch.observations.surfaces.scanner_errors import FieldError, FieldMap
from stitch.pipeline import diagnose, run
from stitch.writing.json_file import is_run_file
from tests.diagnosis.freed_blade import freed_blade
from viz import captions
from viz.colours import BLUE, DARK, ORANGE
from viz.diagnosis_figures import added_variable, budget, scanner_field
from viz.sections import _pictures

LINES = (
    BudgetLine("sensor noise", 0.3, 0.006, "mm"),
    BudgetLine("backlash", 0.6, 0.012, "mm"),
    BudgetLine("smooth, unnamed", 0.095, 0.004, "mm"),
    BudgetLine("wandering in time", 0.005, 0.001, "mm"),
)


@pytest.fixture(scope="module")
def found() -> Diagnosis:
    return diagnose(run(labelled_cell(3, views=30)[0]))


@pytest.fixture
def field() -> FieldMap:
    """Too near on the left, too far on the right by more; a corner without points."""
    x, y = np.linspace(-0.4, 0.4, 5), np.linspace(-0.2, 0.2, 3)
    error = np.tile([-0.02, -0.01, 0.0, 0.02, 0.04], (3, 1))
    error[0, 0] = np.nan
    return FieldMap(x, y, error, np.where(np.isfinite(error), 0.003, np.nan))


def test_the_budget_has_a_bar_for_each_source(found: Diagnosis):
    (axes,) = budget(replace(found, budget=LINES, named=(SimpleNamespace(name="backlash"),)), "mm").axes
    names = [label.get_text() for label in axes.get_yticklabels()]
    assert names == ["backlash", "sensor noise", "smooth, unnamed", "others"]
    assert [bar.get_width() for bar in axes.patches] == pytest.approx([60, 30, 9.5, 0.5])
    assert [_hex(bar) for bar in axes.patches] == [c.lower() for c in (ORANGE, DARK, BLUE, DARK)]
    assert [text.get_text() for text in axes.texts] == ["60 %, 12 µm", "30 %, 6 µm", "10 %, 4 µm", "< 1 %, 1 µm"]


def _hex(bar) -> str:
    return "#" + "".join(f"{round(255 * part):02x}" for part in bar.get_facecolor()[:3])


def test_without_a_budget_the_mean_square_is_shared(found: Diagnosis):
    assert "mean square" in budget(replace(found, budget=()), "mm").axes[0].get_xlabel()
    assert _pictures(replace(found, budget=()), "mm")["budget"].caption == captions.MEAN_SQUARES
    assert _pictures(replace(found, budget=LINES), "mm")["budget"].caption == captions.BUDGET


def test_zero_is_white_and_places_without_points_are_empty(field: FieldMap):
    figure = scanner_field(field, "mm")
    error, sigma = (axes.collections[0] for axes in figure.axes[:2])
    assert error.get_clim() == pytest.approx((-40, 40)) and sigma.get_clim() == pytest.approx((0, 3))
    assert error.get_array().mask.sum() == sigma.get_array().mask.sum() == 1
    # x/z of 0.4 and half a step more is 26.6°.
    assert figure.axes[0].get_xlim()[1] == pytest.approx(np.degrees(np.arctan(0.5)))


def test_a_map_is_drawn_where_it_is_found_alone(found: Diagnosis, field: FieldMap):
    shown = FieldError(0.02, 0.0, 9.0, over_noise=True, map=field)
    picture = _pictures(replace(found, scanner_error=shown), "mm")["field_map"]
    assert picture.figure is not None and "23 µm rms" in picture.caption and "3 µm" in picture.caption
    for nothing in (None, replace(shown, map=None)):
        assert _pictures(replace(found, scanner_error=nothing), "mm")["field_map"].figure is None


def test_every_picture_is_the_runs_own(found: Diagnosis, tmp_path):
    """Or a later run would not replace it."""
    is_own = is_run_file(tmp_path)
    assert all(is_own((tmp_path / "pictures" / f"{name}.png").relative_to(tmp_path)) for name in _pictures(found, "mm"))


def test_what_is_there_lies_along_the_line():
    """Of an offset of one joint, which the prior of what arms do wrong could take for scatter."""
    cell = freed_blade(4, 14)
    joints = cell.measured.plan.joints.copy()
    joints[:, 4] += 1e-3
    linear = cell.seen(kinematics.flange(cell.measured.plan.arm, joints))
    scored = score(linear, candidate_of(linear, EFFECTS["joint_offset"]))
    shown = SimpleNamespace(name="joint_offset", ranked=SimpleNamespace(score=scored, adjusted=scored.p_value))
    axes = added_variable(SimpleNamespace(linear=linear, candidates=[shown])).axes[0]
    predicted, seen = axes.collections[0].get_offsets().T
    assert np.corrcoef(predicted, seen)[0, 1] > 0.8 and np.polyfit(predicted, seen, 1)[0] == pytest.approx(1.0, abs=0.2)
