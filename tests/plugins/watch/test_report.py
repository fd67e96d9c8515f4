"""A simulated month: what happened is named, with its session; nothing else is.

The whole way: sessions on disk, run by the command line, one after the other into the history of their cell.

A session of another arm or scanner is refused; one whose arm was calibrated since is not.

Run lengths of charts against published ones, and against charts that run.

What a cell says to dashboards: read by the parser of Prometheus, and by the rules of the Q-DAS format.
"""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_synth.arms import ARMS
from data_synth.cell_history import CellPlan, cell_history
from data_synth.fixtures.cell_records import records_of
from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from data_synth.write import robot_table
from stitch.plugins.watch.control_charts import (
    CUSUM_REFERENCES,
    EWMA_WEIGHT,
    chart_limits,
    cusum_limit,
    cusum_run_length,
    empty_charts,
    ewma_limit,
    ewma_run_length,
    limit_shares,
    updated_charts,
)
from stitch.plugins.watch.exported import dfq_text, openmetrics
from stitch.plugins.watch.history import open_history
from stitch.plugins.watch.report import cell_report, cell_trend, headline
from stitch.plugins.watch.update import append_runs, cell_identity, other_cell
from tests.command_line import ended
from viz.watch.cell_page import light

MOVED = np.array([0.15, 0.0, -0.08])  # mm, frame of the sensor: how the mount jumped
TURNED = Rotation.from_rotvec([0.0, 2e-4, 0.0]).as_matrix()


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


def session_of_day(folder, k, moved):
    """The same cell at the same poses; noise of its own, and a sensor that has moved."""
    session, T_mount, _ = labelled_cell(0, views=16, scatter=(0.0, 0.0), noise=0.0)
    rng = np.random.default_rng(100 + k)
    views = []
    for view in session.views:
        points = view.sighting.points
        if moved:
            points = (points - MOVED) @ TURNED
        points = points + 0.02 * rng.normal(size=points.shape)
        views.append(replace(view, sighting=replace(view.sighting, points=points)))
    return write_labelled(folder, replace(session, views=tuple(views))), T_mount


@pytest.mark.slow
def test_a_mount_that_jumped_is_found_from_run_folders(tmp_path):
    days, cell = 9, tmp_path / "cell"
    for k in range(days):
        session, _ = session_of_day(tmp_path / f"d{k}", k, moved=k >= 6)
        ended("run", session, "-o", tmp_path / f"r{k}", "--no-recording")
        day = ("--at", f"2026-03-{k + 1:02d}T08:00")
        told = json.loads(ended("watch", cell, "--add", tmp_path / f"r{k}", *day, "--json", code=3 * (k >= 7)).out)
    moved = {p["name"]: p["alarm"] for p in told["parameters"] if p["alarm"]}
    assert all(alarm["since"] == "d6" and alarm["kind"] == "step" for alarm in moved.values())
    assert all(name.startswith("hand_eye.") for name in moved)
    # What the mount did, from the runs themselves: the last hand-eye against the mean of the first six.
    hand_eyes = [
        np.array(json.loads((tmp_path / f"r{k}" / "result.json").read_text())["hand_eye"]) for k in range(days)
    ]
    turned = Rotation.from_matrix(hand_eyes[-1][:3, :3] @ hand_eyes[0][:3, :3].T).magnitude()
    assert turned == pytest.approx(2e-4, abs=4e-5)


def rows_of(arm):
    keys = ("a", "alpha_deg", "d", "theta_deg")
    return [[float(joint.get(key, 0.0)) for key in keys] for joint in robot_table(arm)["joints"]]


def test_arms_of_the_generator_are_told_apart_by_their_rows_alone():
    arms = [arm for arm in ARMS.values() if len(robot_table(arm)["joints"]) == 6]
    assert len(arms) > 1
    for one in arms:
        for other in arms:
            told = other_cell({"rows": rows_of(one)}, {"rows": rows_of(other)}, "mm")
            assert (told is None) == (rows_of(one) == rows_of(other))


def test_a_calibrated_arm_is_the_same_arm():
    rows = rows_of(next(iter(ARMS.values())))
    corrected = [[a + 0.8, alpha + 0.1, d - 0.5, theta + 0.2] for a, alpha, d, theta in rows]
    assert other_cell({"rows": rows}, {"rows": corrected}, "mm") is None


@pytest.mark.parametrize("key", ["arm", "scanner"])
def test_another_name_is_another_cell_and_a_missing_one_is_none(key):
    assert other_cell({key: "left"}, {key: "right"}, "mm") == f"has {key} right, the cell left"
    assert other_cell({key: "left"}, {}, "mm") is None


def test_the_identity_is_what_the_session_states(tmp_path):
    text = '[scanner]\nname = "left"\n[robot]\nname = "KR"\njoints = [{ a = 150, alpha_deg = -90 }]\n'
    (tmp_path / "session.toml").write_text(text)
    assert cell_identity(tmp_path) == {"arm": "KR", "scanner": "left", "rows": [[150.0, -90.0, 0.0, 0.0]]}
    assert cell_identity(tmp_path / "none") == {}


# Montgomery, Introduction to Statistical Quality Control, table 9.3 and 9.4: both sides together, from Brook & Evans.
@pytest.mark.parametrize(
    ("limit", "shift", "published"), [(4, 0, 168), (5, 0, 465), (5, 0.5, 38.0), (5, 1, 10.4), (4, 2, 3.34)]
)
def test_cusum_run_lengths_are_the_published_ones(limit, shift, published):
    up, down = (cusum_run_length(0.5, limit, side * shift) for side in (1, -1))
    assert 1 / (1 / up + 1 / down) == pytest.approx(published, rel=0.01)


# Lucas & Saccucci 1990, table 3: weight, factor of the asymptotic sigma.
@pytest.mark.parametrize(
    ("weight", "factor", "shift", "published"),
    [(0.1, 2.814, 0, 500), (0.1, 2.814, 1, 10.3), (0.05, 2.615, 0, 500), (0.05, 2.615, 0.5, 28.7)],
)
def test_ewma_run_lengths_are_the_published_ones(weight, factor, shift, published):
    assert ewma_run_length(weight, factor * np.sqrt(weight / (2 - weight)), shift) == pytest.approx(published, rel=0.02)


def test_limits_give_the_run_length_asked_for():
    for k in CUSUM_REFERENCES:
        assert cusum_run_length(k, cusum_limit(k, 1e6)) / 2 == pytest.approx(1e6, rel=1e-3)
    assert ewma_run_length(EWMA_WEIGHT, ewma_limit(EWMA_WEIGHT, 1e6)) == pytest.approx(1e6, rel=1e-3)


def test_a_silent_cell_alarms_no_more_often_than_stated():
    """1,000 parameters as 250 cells of four: until an alarm they run 300 sessions at least."""
    rng = np.random.default_rng(0)
    limit, charts = chart_limits(300.0, 4), empty_charts(1000)
    first = np.full(250, np.inf)
    for k in range(1, 900):
        charts = updated_charts(charts, rng.normal(size=1000))
        hit = (limit_shares(charts, limit).max(axis=1) >= 1).reshape(250, 4).any(axis=1)
        first = np.where(np.isinf(first) & hit, k, first)
    # The time until an alarm is about exponential: its mean by the share of all sessions that were run.
    mean = np.minimum(first, 899).sum() / np.isfinite(first).sum()
    assert 300 < mean < 600


@pytest.fixture(scope="module")
def day(tmp_path_factory):
    """One day of a cell with its report."""
    cell = cell_history(0, CellPlan(days=1, knock_day=0.7))
    with open_history(tmp_path_factory.mktemp("plant") / 'hall "2"', new=True) as history:
        append_runs(history, list(records_of(cell)))
        yield cell, history, cell_report(history)


def test_openmetrics_is_read_by_the_parser_of_prometheus(day):
    parser = pytest.importorskip("prometheus_client.openmetrics.parser", reason="prometheus_client is not installed")
    _, _, report = day
    families = {f.name: f for f in parser.text_string_to_metric_families(openmetrics([report]))}
    values = {s.labels["parameter"]: s.value for s in families["stitch_parameter"].samples}
    assert values == {p.name: p.value for p in report.parameters}
    assert families["stitch_cell_sessions"].samples[0].labels == {"cell": 'hall "2"'}
    assert families["stitch_cell_sessions"].samples[0].value == 20


def test_openmetrics_has_one_line_a_parameter_and_an_end(day):
    text = openmetrics([day[2]])
    assert text.endswith("# EOF\n")
    lines = re.findall(
        r'^stitch_parameter_alarm\{cell="hall \\"2\\"",parameter="[\w.]+",unit="[^"]+"\} [01]\.0$', text, re.MULTILINE
    )
    assert len(lines) == 12


def test_a_dfq_file_holds_every_session(day):
    cell, history, report = day
    lines = dfq_text(history, report).split("\r\n")
    keys = dict(line.split(" ", 1) for line in lines if line.startswith("K"))
    rows = [line for line in lines if line and not line.startswith("K")]
    assert keys["K0100"] == "12"
    assert len(rows) == 20
    of_joint = next(i for i in range(1, 13) if keys[f"K2002/{i}"] == "joint_compliance.c3")
    for k, row in enumerate(rows):
        value, attribute, when = row.split("\x0f")[of_joint - 1].split("\x14")
        assert float(value) == pytest.approx(cell.found[k, 8], rel=1e-8)
        assert attribute == "0"
        assert re.fullmatch(r"\d\d\.\d\d\.\d{4}/\d\d:\d\d:\d\d", when)
    low, middle, high = (float(keys[f"{key}/{of_joint}"]) for key in ("K2110", "K2101", "K2111"))
    assert middle == pytest.approx(cell.found[0, 8], rel=1e-8)
    np.testing.assert_allclose([middle - low, high - middle], 2 * cell.sigma[8], rtol=1e-6)
