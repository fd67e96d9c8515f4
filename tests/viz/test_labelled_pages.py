"""Runs on labelled points where people look: page, page of two runs, review, terminal."""

import base64
import html
import json
import re
import shutil

import numpy as np
import pyarrow.parquet as pq
import pytest

from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from stitch.cli.main import main
from viz.page_parts import unbroken
from viz.review.chosen_field import Choice
from viz.review.run_review import RunReview


def told(capsys, *words):
    """What a command says to people, as one line."""
    try:
        main([str(word) for word in words])
    except SystemExit as ended:
        assert not ended.code
    return " ".join(capsys.readouterr().err.split())


def unpacked(values):
    """Numbers as the browser unpacks them; NaN where nobody knows."""
    counts = np.frombuffer(base64.b64decode(values["data"]), "<i2")
    return np.where(counts == -32768, np.nan, counts * values["count"])


@pytest.mark.usefixtures("no_drawing")
@pytest.mark.parametrize("kind", ["points", pytest.param("frames", marks=pytest.mark.slow)])
def test_labelled_runs_say_the_same_everywhere(kind, tmp_path, few_effects, capsys):
    offset = np.array([0, 1e-3, -1.5e-3, 0, 2e-3, 0])
    session, *_ = labelled_cell(2, views=24, offset=offset, probe=kind == "frames")
    folder, before, run = write_labelled(tmp_path / "s", session, kind), tmp_path / "before", tmp_path / "after"
    told(capsys, "run", folder, "-o", run, "--no-recording")
    shutil.copytree(run, before)
    diagnosed = told(capsys, "diagnose", run)
    finding = json.loads((run / "diagnosis.json").read_text())
    named = "Missing in the model: joint_offset (a joint counts its angle from a wrong zero). "
    assert finding["plain"].startswith(f"{named}Adding it should reduce the error from ")
    state = RunReview(run).state()
    assert f"{finding['plain']} {finding['sentence']}" in diagnosed
    assert (state["diagnosis"]["plain"], state["diagnosis"]["sentence"]) == (finding["plain"], finding["sentence"])
    page = (run / "report.html").read_text()
    assert page.count(unbroken(finding["plain"])) == 1  # where the evidence stands
    screen = finding["screen"]
    assert all(unbroken(said) in html.unescape(page) for said in (screen["headline"], screen["proof"]))
    assert screen["candidates"][0]["effect"] == "joint_offset" and screen["why"]["of"].startswith("joint ")
    holds = "U of the hand-eye holds for a complete model"
    assert f"{holds}; whether an effect is missing has not been asked" in (before / "report.html").read_text()
    assert all(
        f"{holds}, and this one seems to lack" in said for said in (diagnosed, (run / "report.html").read_text())
    )
    added = told(capsys, "add", run, "joint_offset", "--no-recording")
    result, ledger = (json.loads((run / f"{name}.json").read_text()) for name in ("result", "ledger"))
    rms = [f"{1e3 * step['residual_rms']:.3g} µm" for step in ledger]
    assert result["plain"].startswith(
        f"Adding joint_offset brought the targets from {rms[0]} to {rms[1]} off their place"
    )
    state = RunReview(run).state()
    assert result["plain"] in added
    assert (state["sentence"], state["evidence"], state["part"]) == (result["plain"], result["verdict"], True)
    assert state["labelled"] and not state["outdated"]
    # The picture counts what the ledger does, step by step.
    scene = json.loads(RunReview(run).snapshot().part)
    names = ["coarse", "hand-eye alone", "+ joint_offset", "register"]
    assert [step["name"] for step in scene["steps"]] == names
    shown = [step["mean"] for step in scene["steps"][1:3]]
    assert shown == pytest.approx([1e3 * step["residual_rms"] for step in ledger], rel=0.02)
    assert shown[1] == pytest.approx(1e3 * result["residual_rms"], rel=1e-6)
    # Every mark has the value that residuals.parquet has of its view and target, also where one of them was chosen.
    table = pq.read_table(run / "residuals.parquet")
    distance = {
        (v, t): 1e3 * e
        for v, t, e in zip(*(table[c].to_pylist() for c in ("view", "partner", "residual")), strict=True)
    }
    marks = [tuple(mark) for mark in scene["marks"]]
    assert sorted(mark for mark in marks if any(mark)) == sorted(distance)
    some = {view for view, _ in distance if view.endswith("1")}
    for values, known in (
        (scene["steps"][2]["values"], distance),
        (
            RunReview(run).chosen(Choice(views=frozenset(some)))["chosen"]["values"],
            {key: e for key, e in distance.items() if key[0] in some},
        ),
    ):
        expected = np.array([known.get(mark, np.nan) for mark in marks])
        np.testing.assert_allclose(unpacked(values), expected, atol=values["count"])
    # Chosen in a plot, the numbers are those of `stitch compare`.
    told(capsys, "compare", run)
    tables = json.loads((run / "compare.json").read_text())["tables"]
    for table in (next(t for t in tables if t["name"] == name) for name in ("order", "j2")):
        chosen = RunReview(run).chosen(Choice(bins={table["name"]: (1, 1)}))["chosen"]
        assert (chosen["correspondences"], chosen["views"]) == (table["count"][1], table["views"][1])
        assert chosen["rms"] == pytest.approx(1e3 * table["rms"][1], rel=0.02)
    # The tolerance counts: 95 % of the distances as residuals.parquet has them, to a percent.
    reach = np.quantile(pq.read_table(run / "residuals.parquet")["residual"].to_numpy(), 0.95)
    for tolerance, light in ((1.01 * reach, "light good"), (0.99 * reach, "light bad")):
        told(capsys, "report", run, "--no-diagnosis", "--tolerance", tolerance)
        page = (run / "report.html").read_text()
        assert f'class="{light}"' in page
        assert unbroken(result["plain"]).replace("'", "&#39;") in page
    of_two = told(capsys, "report", before, run, "--tolerance", 1.01 * reach)
    assert f"by {rms[1]} instead of {rms[0]}, rms over the labelled points. The hand-eyes put the targets" in of_two
    page = (run / "two-runs.html").read_text()
    assert re.findall(r'class="light (\w+)"', page) == ["bad", "good"]
    assert "views of B" in page and "<canvas" not in page
