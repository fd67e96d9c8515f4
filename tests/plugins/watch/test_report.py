"""A simulated month: what happened is named, with its session; nothing else is."""

import numpy as np
import pytest

from data_synth.cell_history import CellPlan, cell_history
from data_synth.fixtures.cell_records import records_of
from stitch.plugins.watch.history import open_history
from stitch.plugins.watch.report import cell_report, cell_trend, headline
from stitch.plugins.watch.update import append_runs
from viz.watch.cell_page import light


@pytest.fixture(scope="module")
def month(tmp_path_factory):
    """Nine days of a cell: a knock on the sixth, compliance of joint 2 that grows by 3 % a day."""
    cell = cell_history(4, CellPlan(days=9, knock_day=6.0, growth=0.03))
    folder = tmp_path_factory.mktemp("plant") / "cell-7"
    with open_history(folder, new=True) as history:
        append_runs(history, list(records_of(cell)))
        yield cell, history


def test_knock_and_growth_are_named_with_their_beginning(month):
    cell, history = month
    report = cell_report(history)
    knocked = int(np.argmax(cell.time >= 1.79e9 + 6 * 86400))
    for name in ("hand_eye.ry", "hand_eye.x"):
        alarm = next(p.alarm for p in report.parameters if p.name == name)
        assert alarm.kind == "step"
        assert abs(int(report.run_names[alarm.since][1:]) - knocked) <= 2
        assert int(report.run_names[alarm.raised][1:]) - knocked <= 2
    wear = next(p for p in report.parameters if p.name == "joint_compliance.c2")
    assert wear.alarm.kind == "drift"
    assert wear.drift_per_day == pytest.approx(0.03 * 1.2e-6, abs=4 * wear.drift_sigma + 0.006e-6)
    assert {p.name for p, _ in report.alarms} <= {
        *(f"hand_eye.{a}" for a in ("rx", "ry", "rz", "x", "y", "z")),
        wear.name,
    }
    assert "the mount jumped before session" in headline(report)


def test_smoothed_values_lie_about_the_truth(month):
    cell, history = month
    course = cell_trend(history, cell_report(history))
    truth = cell.truth.copy()
    truth[:, :6] -= cell.found[0, :6]
    off = np.abs(course.smoothed - truth) / course.smoothed_sigmas
    assert (off < 3.5).mean() > 0.97
    # Smoothed, a month is worth more than a session: what is left is what the sessions have in common.
    assert (course.smoothed_sigmas[50:, 0] < 0.75 * cell.sigma[0]).all()


def test_the_order_in_which_runs_arrive_does_not_matter(month, tmp_path):
    cell, history = month
    records = list(records_of(cell))[:40]
    shuffled = [records[k] for k in (*range(30), 35, 32, 39, 30, 31, 33, 34, 36, 37, 38)]
    answers = []
    for name, order in (("a", records), ("b", shuffled)):
        with open_history(tmp_path / name, new=True) as other:
            append_runs(other, order[:30])
            for record in order[30:]:
                assert append_runs(other, [record]) == 1
                assert append_runs(other, [record]) == 0
            answers.append([p.value for p in cell_report(other).parameters])
    np.testing.assert_allclose(answers[0], answers[1], rtol=1e-9)


def test_one_session_that_is_worse_than_the_tolerance_says_so_and_does_not_recalibrate(month, tmp_path):
    """Within half of its own U nobody can say whether a calibration holds; within five times of it everybody can."""
    cell, _ = month
    with open_history(tmp_path / "one", new=True) as history:
        append_runs(history, list(records_of(cell))[:1])
        sigma = max(p.own_sigma for p in cell_report(history).parameters if p.name in ("hand_eye.x", "hand_eye.y"))
        narrow, wide = (cell_report(history, tolerance=share * 2 * sigma) for share in (0.5, 5.0))
    assert narrow.recalibrate_before is None and light(narrow)[0] == "check"
    worst = narrow.too_uncertain[0]
    assert 2 * worst.own_sigma > worst.limit and "more sessions tell whether it holds" in headline(narrow)
    assert not [p for p in wide.too_uncertain if p.name in ("hand_eye.x", "hand_eye.y")]
    assert "recalibrate now" not in headline(narrow)
