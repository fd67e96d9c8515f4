"""What stitch compare says: whether anything is clear, every table once, and what to type next."""

from types import SimpleNamespace

import numpy as np

from stitch.cli.compare import show_comparison
from tests.output.comparison.compared_views import compared

STATE = SimpleNamespace(
    session=SimpleNamespace(length_unit="mm", mount="eye_in_hand"),
    measurement=SimpleNamespace(capture=SimpleNamespace(scans=[1])),
)


def said(errors, properties, run, capsys):
    """What is printed of views that are off by `errors` (V,) in mm, as one line without the frames of tables."""
    show_comparison(compared(errors, properties, 0.03), STATE, run)
    return " ".join(capsys.readouterr().err.split())


def test_seven_clean_views_show_nothing_clear_and_every_table_once(tmp_path, capsys):
    errors = np.array([-11.7, 1.5, 13.8, 16.0, -12.4, -7.2, 0.0]) * 1e-3
    j3 = np.array([-51.5, -38.8, -24.0, 6.7, 23.1, 49.8, 56.9])
    told = said(errors, {"j3": j3, "torque 3_3": 2 * j3}, tmp_path, capsys)
    assert "Single points follow nothing clear: chance makes one of" in told
    assert "By j3 (deg); torque 3_3 has the same bins: p = " in told and " over all means, not clear" in told
    assert told.count("By ") == 1
    assert told.endswith(f"Next: stitch diagnose {tmp_path}")


def test_what_is_off_with_the_approach_is_called_clear(tmp_path, capsys):
    (tmp_path / "diagnosis.json").write_text("{}")
    approach = np.resize([-1.0, 1.0], 12)
    errors = 0.03 * approach + np.resize([0.004, 0.004, -0.004, -0.004], 12)
    told = said(errors, {"approach of j3": approach, "j1": np.arange(12.0) % 7}, tmp_path, capsys)
    assert "Single points, clear among" in told and "means of bins: approach of j3 (p < 0.0001)." in told
    assert "nothing clear" not in told
    assert told.endswith(f"Next: stitch review {tmp_path}")


def test_two_views_say_that_they_are_too_few(tmp_path, capsys):
    told = said(np.array([0.02, -0.02]), {"j1": np.array([0.0, 9.0])}, tmp_path, capsys)
    assert "Nothing clear: the views are too few" in told and "p = 1 over all means, not clear" in told
