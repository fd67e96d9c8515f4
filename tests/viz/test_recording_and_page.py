"""What people see: the recording and the page of a small run."""

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from viz.colours import UNSEEN, signed_colours
from viz.run_page import write_report


def rerun(*arguments: str) -> subprocess.CompletedProcess[str]:
    program = Path(sys.executable).with_name("rerun")
    return subprocess.run([program, *arguments], capture_output=True, text=True, check=False)


def test_recording_is_whole_and_shows_every_stage(recorded):
    _, path = recorded
    assert rerun("rrd", "verify", str(path)).returncode == 0
    printed = rerun("rrd", "print", str(path)).stdout
    for entity in (
        "/scans/by_view/v000",
        "/scans/by_residual/v004",
        "/fused",
        "/verdict",
        "/before",
        "/after",
        "/convergence/rms_um/correct",
        "/convergence/rms_um/register",
        "/views/correction_um",
        "/robot/flange_path",
    ):
        assert entity in printed, entity


def test_page_needs_nothing_beside_it_and_says_everything(recorded, tmp_path):
    result, _ = recorded
    write_report(replace(result, unobservable=("translation along the axis of joint 6",)), tmp_path / "r.html")
    page = (tmp_path / "r.html").read_text()
    assert not re.search(r"""(src|href)=["'](?!data:)""", page)
    assert "blade &lt;1&gt;" in page
    assert "translation along the axis of joint 6" in page
    assert all(view.name in page for view in result.session.views)
    assert all(f"<td>{stage.name}</td>" in page for stage in result.stages)


def test_colours_say_below_above_and_unseen():
    below, level, above, unseen = signed_colours(np.array([-1.0, 0.0, 1.0, np.nan]), 1.0).astype(int)
    assert below[2] > below[0]
    assert above[0] > above[2]
    assert level.min() > 230
    assert tuple(unseen) == UNSEEN
