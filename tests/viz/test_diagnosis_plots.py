"""What a diagnosis draws below the screen: where the error comes from, how the scanner errs, what may stand in for what."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import labelled_cell
from stitch.api.pipeline import diagnose, run
from stitch.diagnosis.diagnosis import Diagnosis
from stitch.diagnosis.residual_structure import BudgetLine
from stitch.diagnosis.unmodelled_joint_effects import JointCurve
from stitch.observations.surfaces.field_error import FieldError, FieldMap
from viz.diagnosis_plots import budget_rows, diagnosis_plots

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
    rows = budget_rows(replace(found, budget=LINES, named=(SimpleNamespace(name="backlash"),)), "mm")
    assert [row.source for row in rows] == ["backlash", "sensor noise", "smooth, unnamed", "others"]
    assert [row.share for row in rows] == pytest.approx([60, 30, 9.5, 0.5])
    assert [row.told for row in rows] == ["60 %, 12 µm", "30 %, 6 µm", "10 %, 4 µm", "< 1 %, 1 µm"]
    assert [row.kind.split()[0] for row in rows] == ["named", "noise,", "repeats,", "noise,"]


def test_without_a_budget_the_mean_square_is_shared(found: Diagnosis):
    rows = budget_rows(replace(found, budget=()), "mm")
    assert sum(row.share for row in rows) == pytest.approx(100)
    noise = next(row for row in rows if row.source == "sensor noise")
    assert noise.share == pytest.approx(100 * min(1.0, (found.noise_floor / found.residual_rms) ** 2))


def test_the_scanners_map_is_centred_on_zero_and_empty_without_points(found: Diagnosis, field: FieldMap):
    shown = replace(found, scanner_error=FieldError(0.02, 0.0, 9.0, over_noise=True, map=field))
    (told,) = [one for one in diagnosis_plots(shown, "mm") if "scanner errs" in one.title]
    error, sigma = told.plots
    assert (error["low"], error["high"]) == pytest.approx((-40, 40)) and sigma["high"] == pytest.approx(3)
    assert error["values"][0][0] is None and sum(v is None for row in error["values"] for v in row) == 1
    # x/z of 0.4 is 21.8°.
    assert error["x"][-1] == pytest.approx(np.degrees(np.arctan(0.4)), abs=0.01)
    assert "23 µm rms" in told.caption and "3 µm" in told.caption


def test_a_joints_course_is_drawn_with_two_sigmas_where_views_stood(found: Diagnosis):
    angle, error = np.array([-60.0, 0.0, 40.0]), np.array([-1e-4, 0.0, 2.5e-4])
    course = JointCurve(2, "j3_deg", 0.8, angle, error, np.full(3, 1e-5), view_values=angle)
    told = diagnosis_plots(replace(found, curves=(course,)), "mm")[0].plots[0]
    band, line, ticks = told["series"]
    assert line["y"] == [-0.1, 0.0, 0.25] and band["sigma"] == [0.01] * 3 and ticks["x"] == [-60.0, 0.0, 40.0]
    assert told["x"]["label"].startswith("j3 (°): 80 %") and told["y"]["label"] == "joint 2 off by (mrad)"
