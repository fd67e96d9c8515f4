"""An inbox of sessions: each is run once, whatever ends the program; who does not bring the token learns nothing."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
import zlib

import pytest

from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from stitch.plugins.watch import serve
from stitch.plugins.watch.serve import Inbox

PROGRAM = "from stitch.plugins.watch.serve import serve; import sys; serve(__import__('pathlib').Path(sys.argv[1]), port=int(sys.argv[2]), host='127.0.0.1', token='secret', workers=1, scheduler='')"


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    return write_labelled(tmp_path_factory.mktemp("made") / "s", labelled_cell(2, views=8)[0], "points")


def dropped(session, folder, names):
    for name in names:
        (folder / "inbox" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copytree(session, folder / "inbox" / name)
        # Two sessions with one and the same content are one to a history.
        points = folder / "inbox" / name / "points.csv"
        text = points.read_text().rstrip()
        points.write_text(f"{text}{zlib.crc32(name.encode()) % 100000:05d}\n")


def test_each_session_is_run_once_and_joins_the_history_of_its_cell(session, tmp_path, monkeypatch):
    monkeypatch.setattr(serve, "_SETTLED", 0.0)
    inbox = Inbox(tmp_path)
    dropped(session, tmp_path, ["robot-7/monday", "robot-7/tuesday", "alone"])
    (tmp_path / "inbox" / "bad").mkdir()
    (tmp_path / "inbox" / "bad" / "session.toml").write_text("no = ")
    assert inbox.work_once() == 0  # seen for the first time: they may still be copied
    assert inbox.work_once() == 4
    assert inbox.work_once() == 0
    assert {row["name"]: row["error"] is None for row in inbox.rows} == {
        "robot-7/monday": True, "robot-7/tuesday": True, "alone": True, "bad": False
    }  # fmt: skip
    assert [(cell["cell"], cell["sessions"]) for cell in inbox.cells()] == [("robot-7", 2)]
    assert 'stitch_serve_sessions{state="failed"} 1' in inbox.metrics() and inbox.metrics().endswith("# EOF\n")
    # Started again it knows all; a line that was half written does not count.
    with (tmp_path / "rows.jsonl").open("a") as file:
        file.write('{"name": "half')
    again = Inbox(tmp_path)
    again.work_once()
    assert again.work_once() == 0 and len(again.rows) == 4
    (tmp_path / "inbox" / "bad" / "session.toml").write_text("still = no")
    assert [again.work_once() for _ in range(2)] == [0, 1]


def asked(port, path, token="secret"):
    request = urllib.request.Request(f"http://127.0.0.1:{port}{path}", headers={"Authorization": f"Bearer {token}"})
    with urllib.request.urlopen(request, timeout=10) as answer:
        return answer.read().decode()


def started(folder, port):
    process = subprocess.Popen([sys.executable, "-c", PROGRAM, folder, str(port)], stderr=subprocess.DEVNULL)
    for _ in range(600):
        try:
            asked(port, "/runs")
            return process
        except OSError:
            time.sleep(0.1)
    raise AssertionError("it does not answer")


@pytest.mark.slow
def test_twenty_sessions_survive_a_kill(session, tmp_path):
    port = 20000 + os.getpid() % 20000
    dropped(session, tmp_path, [f"robot-{i % 3}/s{i:02d}" for i in range(20)])
    process = started(tmp_path, port)
    with pytest.raises(urllib.error.HTTPError, match="401"):
        asked(port, "/runs", token="guessed")
    while len(json.loads(asked(port, "/runs"))) < 7:
        time.sleep(0.2)
    process.send_signal(signal.SIGKILL)
    process.wait()
    process = started(tmp_path, port)
    try:
        until = time.monotonic() + 300
        while 'state="waiting"} 0' not in asked(port, "/metrics") or len(json.loads(asked(port, "/runs"))) < 20:
            assert time.monotonic() < until
            time.sleep(0.5)
        rows = json.loads(asked(port, "/runs"))
        cells = json.loads(asked(port, "/cells"))
    finally:
        process.kill()
        process.wait()
    assert sorted(row["name"] for row in rows) == sorted(f"robot-{i % 3}/s{i:02d}" for i in range(20))
    assert all(row["error"] is None and (tmp_path / "runs" / row["name"] / "result.json").is_file() for row in rows)
    assert sum(cell["sessions"] for cell in cells) == 20
