"""Who is answered, what a page may ask for, what becomes of a run while it is looked at, and the files of the Rerun viewer."""

import asyncio
import http.client
import json
import os
import re
import shutil
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from stitch.errors import InputError
from tests import command_line
from tests.viz.review.conftest import ended, served, until
from viz.review import rerun_viewer
from viz.review.jobs import Jobs


@pytest.fixture(scope="module")
def run(small_run, tmp_path_factory):
    """A copy of one's own."""
    return Path(shutil.copytree(small_run, tmp_path_factory.mktemp("served") / "r"))


@pytest.fixture(scope="module")
def server(run):
    with served(run) as found:
        yield found


def test_only_who_knows_token_and_machine_is_answered(server):
    port = server.place.partition(":")[2]
    assert server.place.startswith("127.0.0.1:")
    assert len(server.token) >= 32
    status, page = server.get("")
    assert status == 200
    assert "<main>" in page
    for path in ("/", "/state", f"/{server.token[:-1]}/", f"/{server.token}x/", f"/{'x' * len(server.token)}/state"):
        assert server.ask("GET", path)[0] == 404, path
    inside = f"/{server.token}/state"
    assert server.ask("GET", inside, host=f"localhost:{port}")[0] == 200
    for host in (f"rebound.example:{port}", "127.0.0.1.nip.io", ""):
        assert server.ask("GET", inside, host=host)[0] == 421, host
    for origin in ("http://127.0.0.1:1", "https://example.org", "null"):
        assert server.ask("POST", f"/{server.token}/stop", {}, origin=origin)[0] == 403, origin


def test_nothing_beside_its_own_files_can_be_read(server, run):
    assert server.get("scripts/review.js")[0] == 200
    assert server.get("scripts/part_viewer.js")[0] == 200
    (run / "private.txt").write_text("private")
    for path in ("scripts/../run_review.py", "scripts/%2e%2e/run_review.py", "scripts/..%2frun_review.py", "private.txt",
                 "scripts//etc/passwd", "../r/private.txt", "scripts/....//run_review.py"):  # fmt: skip
        status, told = server.get(path)
        assert status == 404, path
        assert "private" not in told


def test_the_page_of_the_run_stands_in_a_frame_that_reaches_nothing(server):
    status, page = server.get("screen")
    assert status == 200 and 'id="screen"' in page
    connection = http.client.HTTPConnection(server.place, timeout=60)
    connection.request("GET", f"/{server.token}/screen")
    policy = connection.getresponse().headers["content-security-policy"]
    assert "default-src 'none'" in policy and "sandbox allow-scripts" in policy and "connect-src" not in policy


@pytest.mark.parametrize(
    "path, body, status",
    [
        ("jobs", b"no json", 400),
        ("jobs", [], 400),
        ("jobs", {"kind": "run"}, 422),
        ("jobs", {"kind": "add", "effects": ["--trust"]}, 422),
        ("jobs", {"kind": "add", "effects": ["a b"]}, 422),
        ("jobs", {"kind": "add", "effects": []}, 422),
        ("jobs", {"kind": "drop", "effects": "range_scale"}, 422),
        ("jobs", {"kind": "undo"}, 422),
        ("jobs", {"kind": "note", "text": 5}, 422),
        ("jobs", {"kind": "note", "text": "a\0b"}, 422),
        ("jobs", b"x" * 300_000, 413),
        ("jobs", b'{"kind": "note", "text": "half an emoji \\ud83d"}', 400),
        ("jobs", b"[" * 90_000, 400),
        ("chosen", b'{"bins": {"range": [0, 1e400]}}', 400),
        ("chosen", b'{"bins": {"range": [0, NaN]}}', 400),
        ("chosen", b"\xff{}", 400),
        ("jobs", {"kind": "own"}, 403),
        ("own", {"text": "import os"}, 403),
        ("own", {"text": "import os", "trust": "yes"}, 403),
        ("own", {"trust": True}, 400),
        ("chosen", {"views": ["nobody"]}, 422),
        ("chosen", {"bins": {"humour": [0, 1]}}, 422),
        ("chosen", {"bins": {"range": [0, 99]}}, 422),
        ("chosen", {"place": "here"}, 400),
    ],
)
def test_what_no_command_is_made_of_is_refused_in_a_line(server, run, path, body, status):
    before = {file.name: file.read_bytes() for file in run.iterdir() if file.is_file()}
    if isinstance(body, dict) and path == "jobs":
        body = body | {"model": server.state()["model"]}
    found, told = server.post(path, body)
    assert found == status, told
    if status != 413:
        assert told["problem"]
        assert "\n" not in told["problem"]
    assert {file.name: file.read_bytes() for file in run.iterdir() if file.is_file()} == before


def test_a_body_in_chunks_has_the_same_limit(server):
    connection = http.client.HTTPConnection(server.place, timeout=60)
    chunks = iter([b'{"kind": "note", "text": "', *[b"x" * 10_000] * 30, b'"}'])
    connection.request("POST", f"/{server.token}/jobs", chunks, encode_chunked=True)
    assert connection.getresponse().status == 400
    connection.close()


def test_a_command_that_cannot_be_started_ends_alone():
    async def tried():
        told = []
        jobs = Jobs(told.append, lambda: None)
        queue = asyncio.create_task(jobs.work())
        for text in ("half an emoji \ud83d", "a\0b"):
            jobs.submit("note", ["note", text])
        last = jobs.submit("note", ["--version"])
        while last.state in ("waiting", "running"):
            await asyncio.sleep(0.05)
        queue.cancel()
        return [job.state for job in jobs.all], told

    # In a thread of its own: a browser that another test drives has a loop running in this one.
    with ThreadPoolExecutor(1) as thread:
        states, told = thread.submit(asyncio.run, tried()).result()
    assert states == ["failed", "failed", "done"]
    assert json.dumps(told, ensure_ascii=False)


def test_numbers_of_a_choice_are_those_of_the_tables(server, run):
    """By the tables of compare.json and the rms of result.json, which come from other code."""
    result, tables = (json.loads((run / name).read_text()) for name in ("result.json", "compare.json"))
    told = server.post("chosen", {})[1]
    assert told["chosen"]["rms"] == pytest.approx(1e3 * result["residual_rms"], rel=1e-6)
    table = next(t for t in tables["tables"] if t["name"] == "view")
    for name, rms, count in zip(table["label"], table["rms"], table["count"], strict=True):
        own = server.post("chosen", {"views": [name]})[1]["chosen"]
        assert (own["views"], own["correspondences"]) == (1, count)
        assert own["rms"] == pytest.approx(1e3 * rms, rel=1e-6)
    table = next(t for t in tables["tables"] if t["name"] == "range")
    own = [server.post("chosen", {"bins": {"range": [i, i]}})[1]["chosen"] for i in range(len(table["low"]))]
    # The place of a correspondence lies between its two points: a few change the bin.
    np.testing.assert_allclose([o["correspondences"] for o in own], table["count"], rtol=0.03)
    np.testing.assert_allclose([o["rms"] for o in own], 1e3 * np.array(table["rms"]), rtol=0.05)
    middle = np.mean([view["pose"] for view in result["views"]], axis=0)[:3, 3]
    nothing = server.post("chosen", {"place": list(middle), "within": 1e-3})[1]["chosen"]
    assert nothing["correspondences"] == 0


@pytest.mark.slow
def test_two_pages_hear_the_same_and_a_stale_one_changes_nothing(server, run, stitch_command):
    pages, before = [server.listen(), server.listen()], server.state()
    status, job = server.post("jobs", {"kind": "add", "effects": ["range_scale"], "model": before["model"]})
    assert status == 200
    assert job["command"] == f"stitch add {run} range_scale --no-recording"
    again = server.post("jobs", {"kind": "add", "effects": ["range_scale"], "model": before["model"]})[1]
    assert again["number"] == job["number"]
    ends = [until(page, ended(job["number"]))["job"] for page in pages]
    assert ends[0] == ends[1]
    assert ends[0]["state"] == "done", ends[0]["lines"]
    assert {"start", "fit", "register", "writing"} <= {line["progress"] for line in ends[0]["progress"]}
    after = server.state()
    assert [row["change"] for row in after["ledger"]] == ["hand-eye alone", "+ range_scale"]
    assert after["history"]["undo"] == {"command": "drop", "effects": ["range_scale"], "to": []}
    stale = server.post("jobs", {"kind": "add", "effects": ["backlash"], "model": before["model"]})
    assert stale[0] == 409
    undone = server.post("jobs", {"kind": "undo", "model": after["model"]})[1]
    assert undone["command"].startswith(f"stitch drop {run} range_scale")
    assert until(pages[0], ended(undone["number"]))["job"]["state"] == "done"
    after = server.state()
    assert [row["change"] for row in after["ledger"]][2:] == ["− range_scale"]
    assert after["history"] == {
        "undo": None,
        "redo": {"command": "add", "effects": ["range_scale"], "to": ["range_scale"]},
    }
    # Somebody else writes into the folder, by the command line.
    stitch_command("note", run, "seen by hand")
    until(pages[0], lambda e: e["type"] == "changed" and e["version"] != after["version"])
    assert server.state()["ledger"][2]["notes"][0]["text"] == "seen by hand"
    away = run.rename(run.with_name("away"))
    assert "to fix" in server.state()["problem"] or "no such run folder" in server.state()["problem"]
    away.rename(run)
    assert server.state()["problem"] is None


def test_own_python_is_checked_by_a_command_and_its_fault_told_in_a_line(server, run):
    page, text = server.listen(), "from stitch.effects import effect, number\n\nraise ValueError('not yet')\n"
    job = server.post("own", {"text": text, "trust": True})[1]
    end = until(page, ended(job["number"]))["job"]
    assert end["state"] == "failed"
    assert re.match(rf"stitch: {run}/review_effects.py line 3: .*not yet", end["lines"][-1])
    assert server.state()["own"] == text


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="finds the fit's process by Linux's /proc")
@pytest.mark.slow
@pytest.mark.parametrize("how", ["stopped", "killed"])
def test_a_fit_that_is_ended_leaves_the_run_as_it_was(server, run, how):
    page, before = server.listen(), server.state()
    kept = {file.name: file.read_bytes() for file in run.iterdir() if file.is_file()}
    job = server.post("jobs", {"kind": "add", "effects": ["incidence_bias"], "model": before["model"]})[1]
    until(page, lambda e: e["type"] == "job" and e["job"]["number"] == job["number"] and e["job"]["progress"])
    if how == "stopped":
        server.post("stop", {})
    else:
        own = server.process.pid
        children = {
            int(p) for task in Path(f"/proc/{own}/task").iterdir() for p in (task / "children").read_text().split()
        }
        assert len(children) == 1
        os.kill(children.pop(), signal.SIGKILL)
    end = until(page, lambda e: ended(job["number"])(e) and e["job"]["seconds"] > 0)["job"]
    assert end["state"] == {"stopped": "stopped", "killed": "failed"}[how]
    assert {file.name: file.read_bytes() for file in run.iterdir() if file.is_file()} == kept
    assert server.state() == before
    note = server.post("jobs", {"kind": "note", "text": f"was {how}"})[1]
    assert until(page, ended(note["number"]))["job"]["state"] == "done"
    assert not list(run.parent.glob(".r.stitch-*"))


def test_what_is_no_run_and_a_taken_port_end_in_a_line(run, server, tmp_path):
    port = server.place.partition(":")[2]
    for words in (
        [tmp_path / "none"],
        [tmp_path],
        [run, "--port", port],
        [run, "--effects-file", tmp_path / "none.py"],
    ):
        told = command_line.ended("review", *words, "--no-browser", code=InputError.exit_code).err
        assert told.startswith("stitch: ")
        assert told.count("\n") == 1


@pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="/proc tells which programs run")
def test_no_program_outlives_what_was_asked_of_it(monkeypatch):
    free, ports = rerun_viewer._free_port, []
    monkeypatch.setattr(rerun_viewer, "_free_port", lambda: ports.append(free()) or ports[-1])
    viewer = rerun_viewer.RerunViewer()
    assert b"<html" in viewer.file("index.html").read_bytes().lower()
    viewer.close()
    # The launcher was waited for; what it had started belongs to nobody and may take a moment to die.
    end = time.monotonic() + 30
    while (left := {str(port).encode() for port in ports} & running()) and time.monotonic() < end:
        time.sleep(0.05)
    assert not left


def running():
    """Words of all command lines."""
    words = set()
    for file in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words.update(file.read_bytes().split(b"\0"))
        except OSError:
            continue
    return words
