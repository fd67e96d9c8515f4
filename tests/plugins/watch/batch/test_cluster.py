"""A batch on real processes: workers and the client are killed; nothing is lost and nothing is run twice."""

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest

from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.labelled_files import write_labelled

pytest.importorskip("distributed")
pytestmark = [pytest.mark.slow, pytest.mark.skipif(not hasattr(os, "killpg"), reason="kills by signals")]

ROOT = Path(__file__).resolve().parents[4]
# A recorder like that of any other package: notes who is run, and kills its own process where a file asks for it.
PLUGIN = """
import os, signal
from pathlib import Path

here = Path(__file__).parent


class Witness:
    def __init__(self, path):
        pass

    def start(self, session):
        self.name = session.name
        for kind in ("always", "once"):
            order = here / f"die-{kind}-{session.name}"
            if order.exists():
                if kind == "once":
                    order.unlink()
                (here / f"died-{session.name}-{os.getpid()}").touch()
                os.kill(os.getpid(), signal.SIGKILL)

    def iteration(self, stage, index, poses, rms, gate):
        pass

    def stage(self, result, poses):
        pass

    def finish(self, run):
        (here / f"ran-{self.name}-{os.getpid()}").touch()
"""


@pytest.fixture
def room(tmp_path):
    """Six small sessions, and a package beside stitch that watches their runs."""
    cell = labelled_cell(2, views=8)[0]
    for i in range(6):
        write_labelled(tmp_path / f"s{i}", cell, "points")
    info = tmp_path / "witness-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: witness\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[stitch.recorders]\nwitness = witness:Witness\n")
    (tmp_path / "witness.py").write_text(PLUGIN)
    return tmp_path


def start(room, *more):
    code = "from stitch.cli.main import main; main()"
    command = [sys.executable, "-c", code, "batch", *(f"s{i}" for i in range(6)), "--workers", "2", *more]
    places = [str(room), str(ROOT), os.environ.get("PYTHONPATH", "")]
    return subprocess.Popen(
        command,
        cwd=room,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(places)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def noted(room, kind):
    """How often the recorder wrote this of each session."""
    return Counter(path.name.split("-")[1] for path in room.glob(f"{kind}-s*"))


def stands(room):
    """What tells a run that was written from one that was written again."""
    return {path.parent.name: path.stat().st_ino for path in room.glob("runs/s*/result.json")}


def test_a_dead_worker_costs_time_only_and_what_kills_its_workers_is_given_up(room):
    (room / "die-once-s1").touch()
    (room / "die-always-s3").touch()
    process = start(room, "--json")
    out, err = process.communicate(timeout=240)
    rows = {row["name"]: row for row in json.loads(out)["sessions"]}
    assert process.returncode == 1
    assert [name for name, row in rows.items() if row["error"]] == ["s3"]
    assert "workers died over it, also when it ran alone" in rows["s3"]["error"]
    # Two beside others, two alone.
    assert noted(room, "died") == {"s1": 1, "s3": 4}
    assert noted(room, "ran") == {f"s{i}": 1 for i in (0, 1, 2, 4, 5)}
    # One line a session and one at the end: nothing of what the cluster says to itself.
    assert len(err.splitlines()) == 7, err


def test_a_killed_or_interrupted_client_is_started_again_and_goes_on(room):
    first = start(room)
    first.stderr.readline()
    os.kill(first.pid, signal.SIGKILL)
    # Its workers hold the end of this pipe too: they have ended when it does.
    first.communicate(timeout=60)
    before = stands(room)
    assert 1 <= len(before) < 6
    second = start(room)
    until = time.monotonic() + 120
    while len(stands(room)) < len(before) + 1 and time.monotonic() < until:
        time.sleep(0.05)
    os.killpg(second.pid, signal.SIGINT)
    _, told = second.communicate(timeout=60)
    assert second.returncode == 1
    assert told.splitlines()[-1].startswith("stitch: stopped after ")
    assert "Traceback" not in told
    after = stands(room)
    third = start(room, "--json")
    out, _ = third.communicate(timeout=240)
    assert third.returncode == 0
    whole = stands(room)
    assert before.items() <= after.items() <= whole.items() and len(whole) == 6
    skipped = {row["name"] for row in json.loads(out)["sessions"] if row["skipped"]}
    assert skipped == set(after)
    assert not [path.name for path in (room / "runs").iterdir() if path.name.startswith(".")]
