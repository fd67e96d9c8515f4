"""What a cell says to dashboards: read by the parser of Prometheus, and by the rules of the Q-DAS format."""

import re

import numpy as np
import pytest

from data_synth.cell_history import CellPlan, cell_history
from data_synth.fixtures.cell_records import records_of
from stitch.plugins.watch.exported import dfq_text, openmetrics
from stitch.plugins.watch.history import open_history
from stitch.plugins.watch.report import cell_report
from stitch.plugins.watch.update import append_runs


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
