"""At every step of the model page and recording say the number of result.json."""

import json
import re

import pytest
from rerun.chunk import RrdReader

from stitch.numerics.units import length_text
from stitch.output.result_document import result_document
from viz.model_timeline import FRAMES
from viz.page_parts import unbroken


def told_at(recording):
    """Frame of the timeline `model` → the words beside the part."""
    chunks = (c.to_record_batch() for c in RrdReader(str(recording)).stream() if c.entity_path == "/now")
    rows = (zip(b.column("model"), b.column("TextDocument:text"), strict=True) for b in chunks)
    return {frame.as_py(): text.as_py()[0] for batch in rows for frame, text in batch}


def require_steps(recording, rows):
    """Rows of `disagreement.steps` of a result in mm."""
    told = told_at(recording)
    assert max(told) == FRAMES * (len(rows) - 1)
    for k, row in enumerate(rows):
        words = unbroken(f"## {row['step']}\nviews disagree by {length_text(row['mean'], 'mm')} on average.")
        assert told[FRAMES * k].startswith(words)


def test_the_recording_of_a_small_run(recorded):
    run, path = recorded
    require_steps(path, result_document(run)["disagreement"]["steps"])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rubik"])
def test_page_and_recording_of_a_real_object(reghec, name, tmp_path, stitch_command):
    stitch_command("run", reghec(name), "-o", tmp_path / "r")
    rows = json.loads((tmp_path / "r" / "result.json").read_text())["disagreement"]["steps"]
    require_steps(tmp_path / "r" / "recording.rrd", rows)
    page = (tmp_path / "r" / "report.html").read_text(encoding="utf-8")
    shown = json.loads(re.search(r'id="part-data">(.*?)</script>', page, re.S)[1])["steps"]
    assert [(s["name"], s["mean"]) for s in shown] == [(r["step"], pytest.approx(1e3 * r["mean"])) for r in rows]
