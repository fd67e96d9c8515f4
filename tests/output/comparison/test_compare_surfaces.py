"""Residuals by covariate: everything is counted, and a view that is off shows."""

import numpy as np
import pytest

from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.in_memory import session_of
from stitch.api.pipeline import run
from stitch.output.comparison.residual_tables import compare_surfaces


def blade_run(seed, hidden, mount="eye_to_hand", views=9):
    measured = measured_blade(seed, views=views, mount=mount, hidden=hidden, pixels=60)
    return measured, run(session_of(measured))


def test_compare_counts_everything_and_shows_the_view_that_is_off():
    measured, result = blade_run(5, {})
    found = compare_surfaces(result)
    assert found.rms == pytest.approx(result.residual_rms, rel=0.05)
    table = found.table("view")
    assert table.views.sum() == len(measured.clouds)
    assert {"range", "incidence", "j5", "time", "humidity_percent"} <= {t.name for t in found.tables}
    total = found.table("range").count.sum()
    assert all(t.count.sum() == total for t in found.tables if t.name != "pair")
    # Each correspondence is seen from both sides with opposite signs.
    assert np.average(table.mean, weights=table.count) == pytest.approx(0, abs=1e-12)
