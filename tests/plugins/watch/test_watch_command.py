"""`stitch watch` on run folders: what it says, how it ends, and what it refuses.

An inbox of sessions: each is run once, whatever ends the program; who does not bring the token learns nothing.
"""

import json
import os
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
import time
import urllib.error
import urllib.request
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from data_synth.fixtures.run_folders import bare_run
from stitch.numerics import frames
from stitch.plugins.watch import serve
from stitch.plugins.watch.history import mount_twist, open_history, read_record, twist_covariance
from stitch.plugins.watch.serve import Inbox
from stitch.plugins.watch.update import append_runs
from tests.command_line import ended

SIGMA = np.diag([2e-5] * 3 + [0.01] * 3) ** 2
PROGRAM = "from stitch.plugins.watch.serve import serve; import sys; serve(__import__('pathlib').Path(sys.argv[1]), port=int(sys.argv[2]), host='127.0.0.1', token='secret', workers=1, scheduler='')"


def run_folder(folder: Path, name: str, shift: float = 0.0, c2: float = 1e-6) -> Path:
    """A run that found the mount somewhere, an hour after the one before."""
    rng = np.random.default_rng(int(name[1:]))
    R = Rotation.from_rotvec([0.1, 2.0, 0.3] + 1e-5 * rng.normal(size=3)).as_matrix()
    T = frames.make(R, [1200.0 + shift, -50.0, 700.0] + 0.005 * rng.normal(size=3))
    effects = {"joint_compliance": {"c2": (c2 * (1 + 0.02 * rng.normal()), "rad/(N m)")}}
    run = bare_run(folder / name, T, SIGMA, mount="eye_to_hand", name=name, effects=effects)
    time = 1.79e9 + 3600 * int(name[1:])
    os.utime(run / "result.json", (time, time))
    return run


def test_a_knock_ends_with_3_and_its_session(tmp_path):
    runs = [run_folder(tmp_path, f"s{k}", shift=0.2 * (k >= 20)) for k in range(24)]
    cell = tmp_path / "cell-7"
    quiet = json.loads(ended("watch", cell, "--add", *runs[:20], "--json").out)
    assert [p["alarm"] for p in quiet["parameters"]] == [None] * 7
    told = json.loads(ended("watch", cell, "--add", *runs, "--json", code=3).out)
    assert told["sessions"] == 24
    alarm = next(p["alarm"] for p in told["parameters"] if p["name"] == "hand_eye.x")
    assert (alarm["since"], alarm["kind"]) == ("s20", "step")
    assert alarm["p_value"] < 1e-6
    assert alarm["size"] == pytest.approx(0.2, abs=0.01)
    for name in ("watch.html", "watch.prom", "history.sqlite"):
        assert (cell / name).stat().st_size > 500
    assert "the mount jumped before session s20" in " ".join(ended("watch", cell, "--no-page", code=3).out.split())
    # A new calibration, of after the knock: what was is settled.
    assert json.loads(ended("watch", cell, "--in-use", runs[23], "--json").out)["in_use"] == "s23"


def test_a_plant_has_a_page_with_a_row_a_cell(tmp_path):
    cells = []
    for c in range(2):
        runs = [run_folder(tmp_path, f"s{10 * c + k}") for k in range(3)]
        cells.append(tmp_path / f"cell-{c}")
        ended("watch", cells[-1], "--add", *runs, "--no-page")
    assert [cell["cell"] for cell in json.loads(ended("watch", *cells, "--json").out)] == ["cell-0", "cell-1"]
    page = (tmp_path / "plant.html").read_text(encoding="utf-8")
    assert 'href="cell-0/watch.html"' in page


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("nowhere",), "no cell with a history"),
        (("cell", "--add"), "name the cell first"),
        (("cell", "--add", "nowhere"), "no such run folder"),
        (("s0", "--add", "s1"), "is a run, no cell"),
        (("cell", "--add", "s0", "s1", "--at", "2026-01-01"), "name one RUN"),
        (("cell", "--add", "s0", "--at", "noon"), "no time; to fix"),
        (("cell", "--add", "s0", "--in-use", "s1"), "is not in the history"),
        (("cell", "--add", "s0", "--dfq", "s0/result.json"), "ends in .dfq"),
        (("session/cell", "--add", "s0"), "lies in the session"),
        (("cell", "--add", "metres"), None),
        (("cell", "--add", "s0", "copy"), "has the very numbers of"),
        (("cell", "--add", "reused"), "as it is, so nothing was measured anew"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line_and_leaves_nothing(arguments, told, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("s0", "s1"):
        run_folder(tmp_path, name)
    T = np.array(json.loads((tmp_path / "s0" / "result.json").read_text())["hand_eye"])
    bare_run(tmp_path / "metres", T, SIGMA, length_unit="m", mount="eye_to_hand")
    effects = {"joint_compliance": {"c2": (read_record(tmp_path / "s0").estimates[0].value, "rad/(N m)")}}
    bare_run(tmp_path / "copy", T, SIGMA, mount="eye_to_hand", name="other", effects=effects)
    (tmp_path / "session").mkdir()
    (tmp_path / "session" / "session.toml").touch()
    reused = bare_run(tmp_path / "reused", T, SIGMA, mount="eye_to_hand") / "result.json"
    stage = {"name": "coarse", "rms": 0.1, "correspondences": 9, "iterations": 1, "seconds": 0.0}
    note = {"note": "hand-eye of another run, used as it is"}
    reused.write_text(json.dumps(json.loads(reused.read_text()) | {"stages": [stage | note]}))
    if told is None:
        # Metres after millimetres: another cell.
        ended("watch", "cell", "--add", "s0", "--no-page")
        assert "has length_unit m, the cell cell mm" in ended("watch", *arguments, code=2).err
        return
    assert told in ended("watch", *arguments, code=2).err.strip().splitlines()[-1]
    assert not (tmp_path / "cell").exists()


def test_a_damaged_history_is_named(tmp_path):
    (tmp_path / "cell").mkdir()
    (tmp_path / "cell" / "history.sqlite").write_bytes(b"no data base" * 500)
    assert "history.sqlite: damaged" in ended("watch", tmp_path / "cell", code=2).err


def test_a_database_of_something_else_is_left_as_it_is(tmp_path):
    run = run_folder(tmp_path, "s0")
    (tmp_path / "cell").mkdir()
    file = tmp_path / "cell" / "history.sqlite"
    connection = sqlite3.connect(file)
    connection.execute("CREATE TABLE parts (name)")
    connection.close()
    before = file.read_bytes()
    told = ended("watch", tmp_path / "cell", "--add", run, code=2)
    assert "is no history in the form" in told.err and file.read_bytes() == before


def test_many_writers_lose_nothing(tmp_path):
    runs = [run_folder(tmp_path, f"s{k}") for k in range(12)]

    def append(run: Path) -> int:
        with open_history(tmp_path / "cell", new=True) as history:
            return append_runs(history, [read_record(run)])

    with ThreadPoolExecutor(4) as pool:
        assert sum(pool.map(append, [*runs, *runs])) == 12
    with open_history(tmp_path / "cell") as history:
        assert history.sql("SELECT count(*) FROM runs")[0][0] == 12
        assert history.sql("SELECT max(number) FROM states")[0][0] == 12


def test_the_twist_of_the_mount_is_its_motion_about_the_part():
    first, middle = np.eye(4), np.array([10.0, -20.0, 400.0])
    first[:3, :3] = Rotation.from_rotvec([0.4, -2.0, 0.3]).as_matrix()
    first[:3, 3] = [1200.0, -50.0, 700.0]
    place = first[:3, :3] @ middle + first[:3, 3]
    turn, shift = np.array([1e-4, -2e-4, 3e-4]), np.array([0.05, -0.02, 0.01])
    R = Rotation.from_rotvec(turn).as_matrix()
    motion = frames.make(R, place + shift - R @ place)
    found = mount_twist(motion @ first, first, middle)
    np.testing.assert_allclose(found, [*turn, *shift], rtol=1e-3, atol=1e-8)
    # A turn about the scanner's own origin alone moves the part by its lever.
    only_turn = np.zeros((6, 6))
    only_turn[1, 1] = 1e-8
    told = twist_covariance(only_turn, np.eye(4), np.eye(4), np.array([0.0, 0, 400.0]))
    np.testing.assert_allclose(np.sqrt(np.diag(told)), [0, 1e-4, 0, 0.04, 0, 0], atol=1e-12)


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
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
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
