"""The variance budget as it is told, on the terminal and elsewhere."""

import numpy as np
import pytest

from stitch.cli.diagnose import show_budget
from stitch.diagnosis.residual_structure import BudgetLine
from stitch.observations.surfaces.scanner_errors import FieldError, FieldMap
from stitch.output.diagnosis_document import _field_map, largest_error_sources

SHARES = {"sensor noise": 0.1, "backlash": 0.885, "smooth, unnamed": 0.009, "scanner field": 0.006, "joint_offset": 0.0}
BUDGET = tuple(BudgetLine(name, share, 0.02 * share**0.5, "mm") for name, share in SHARES.items())


def test_small_sources_are_told_together_and_nothing_is_lost():
    told = largest_error_sources(BUDGET)
    assert [line.source for line in told] == ["backlash", "sensor noise", "others"]
    assert sum(line.variance_share for line in told) == pytest.approx(1.0)
    assert sum(line.sigma**2 for line in told) == pytest.approx(0.02**2)
    assert largest_error_sources(()) == []


def test_the_terminal_tells_source_share_and_size(capsys):
    show_budget(BUDGET, "mm")
    told = "backlash 88 % (19 µm), sensor noise 10 % (6.3 µm), others 2 % (2.4 µm)"
    assert capsys.readouterr().err == f"The error of whole views (rms) comes from: {told}.\n"
    show_budget((), "mm")
    assert not capsys.readouterr().err


def test_a_map_is_written_with_null_where_nothing_was_seen():
    error = np.array([[0.01, np.nan], [-0.01, 0.0], [0.02, 0.03]])
    drawn = FieldMap(
        np.array([-0.2, 0.2]), np.array([-0.1, 0.0, 0.1]), error, np.where(np.isfinite(error), 0.002, np.nan)
    )
    written = _field_map(FieldError(0.02, 0.0, 9.0, over_noise=True, map=drawn))
    assert written["x_over_z"] == [-0.2, 0.2] and written["y_over_z"] == [-0.1, 0.0, 0.1]
    assert written["error"] == [[0.01, None], [-0.01, 0.0], [0.02, 0.03]]
    assert written["sigma"][0] == [0.002, None]
    assert _field_map(FieldError(0.02, 0.0, 9.0, over_noise=True)) is _field_map(None) is None
