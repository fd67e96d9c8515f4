"""Many sessions: each is run once."""

import fcntl
import json
import os
import threading
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
from pyarrow import parquet

from data_synth.fixtures.edits import edit
from data_synth.fixtures.labelled_files import write_labelled
from stitch.errors import InputError
from stitch.output.run_folder import write_with_page
from stitch.plugins.watch.batch import bounds, cluster, run_batch
from stitch.plugins.watch.batch.run_batch import BatchJob, SessionRow, run_jobs, run_session
from stitch.plugins.watch.verb import batch as stitch_batch
from tests.command_line import ended
from viz.batch_page import write_page
from viz.page_parts import unbroken


def test_started_again_it_runs_what_is_new_changed_or_missing(sessions, ran, capsys, batch):
    batch(*sessions, "nowhere", code=2)
    assert "nowhere" in capsys.readouterr().err
    batch(*sessions, "--json")
    document = json.loads(capsys.readouterr().out)
    assert ran == ["monday", "tuesday"]
    assert [row["skipped"] for row in document["sessions"]] == [True, True]
    assert document == json.loads(Path("runs/batch.json").read_text())
    # One digit of one point.
    edit(sessions[1] / "points.csv", r"(?m)(\d)$", lambda found: str((int(found[1]) + 1) % 10))
    batch(*sessions)
    assert ran == ["monday", "tuesday", "tuesday"]
    batch(sessions[0], "--force")
    assert ran[3:] == ["monday"]


def test_a_model_that_was_changed_since_is_kept_and_a_run_that_took_its_place_is_not_trusted(sessions, ran, batch):
    batch(sessions[0])
    ended("note", "runs/monday", "looks well")
    ended("add", "runs/monday", "joint_offset", "--no-recording")
    batch(sessions[0])
    assert ran == ["monday"]
    # A run of a session that is different now leaves the mark of the batch where it is.
    edit(sessions[0] / "points.csv", r"(?m)(\d)$", lambda found: str((int(found[1]) + 1) % 10))
    before = (sessions[0] / "points.csv").read_bytes()
    ended("run", sessions[0], "-o", "runs/monday", "--no-recording")
    assert (sessions[0] / "points.csv").read_bytes() == before
    batch(sessions[0])
    assert ran == ["monday", "monday"]


def test_all_that_a_run_reads_counts_as_content(sessions):
    (sessions[0] / "session.toml").write_text(
        (sessions[0] / "session.toml").read_text() + '\n[part]\ncad = "../part.stl"\n'
    )
    part = sessions[0].parent / "part.stl"
    seen = []
    for text in ("solid", "solid again"):
        part.write_text(text)
        seen.append(run_batch.session_content_hash(sessions[0]))
    assert None not in seen and seen[0] != seen[1]
    assert run_batch.session_content_hash(sessions[0] / "nowhere") is None


def test_one_that_was_given_up_and_still_writes_is_waited_for(sessions, ran, tmp_path):
    """As after a worker that the scheduler has lost but that lives: the second finds what the first wrote."""
    job = BatchJob(sessions[0], tmp_path / "runs" / "monday", "a", recording=False)
    content = run_batch.session_content_hash(job.session)
    result = run_batch.run(run_batch.load_session(job.session), None)
    with run_batch.run_folder.new_folder(job.run, [job.session]) as scratch:
        write_with_page(result, scratch)
        run_batch.write_mark(job, content, scratch)
    kept = job.run.rename(tmp_path / "kept")
    held = os.open(job.run.parent / ".monday.lock", os.O_RDWR | os.O_CREAT)
    fcntl.flock(held, fcntl.LOCK_EX)

    def finish():
        kept.rename(job.run)
        os.close(held)

    del ran[:]
    timer = threading.Timer(0.2, finish)
    timer.start()
    row = run_session(job)
    timer.join()
    assert row.error is None and row.residual_um and not row.skipped and not ran


def test_all_again_runs_each_session_once(sessions, ran, tmp_path):
    """With --force too a session that comes to a second worker of the same batch is not run twice."""
    rows = [
        run_session(BatchJob(sessions[0], tmp_path / "runs" / "monday", name, force=True, recording=False))
        for name in ("first", "second", "second")
    ]
    assert not any(row.skipped or row.error for row in rows)
    assert ran == ["monday", "monday"]


pytestmark = pytest.mark.usefixtures("no_drawing")


def test_it_goes_on_after_whatever_befalls_one_session(sessions, result, monkeypatch, capsys, batch):
    """Also after an error that nobody foresaw."""

    def fails_once(loaded, recorder):
        if loaded.path.name == "monday":
            raise ZeroDivisionError("by\nzero")
        return replace(result, session=loaded)

    monkeypatch.setattr(run_batch, "run", fails_once)
    batch(*sessions, "--json", code=1)
    bad, good = json.loads(capsys.readouterr().out)["sessions"]
    assert bad["error"] == "ZeroDivisionError: by zero" and good["error"] is None
    assert sorted(path.name for path in Path("runs").iterdir()) == [
        "batch.html",
        "batch.json",
        "batch.parquet",
        "tuesday",
    ]
    assert {"result.json", "report.html"} <= {path.name for path in Path("runs/tuesday").iterdir()}


def test_the_workers_of_a_scheduler(sessions, tmp_path):
    """Two threads of this process as workers; a session that cannot be read does not stop the others."""
    distributed = pytest.importorskip("distributed")
    jobs = [
        BatchJob(path, tmp_path / "runs" / path.name, "a", recording=False) for path in (*sessions, tmp_path / "gone")
    ]
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address="127.0.0.1:0"
    ) as two:
        rows = {row.name: row for row in run_jobs(jobs, scheduler=two.scheduler_address)}
    assert "gone/session.toml: not found" in rows["gone"].error and rows["gone"].bad_input
    alone = run_session(BatchJob(sessions[0], tmp_path / "alone", "b", recording=False))
    numbers = ("residual_um", "registered_um", "noise_floor_um", "worst_view_um", "coarse_um")
    assert [getattr(rows["monday"], key) for key in numbers] == [getattr(alone, key) for key in numbers]
    assert np.isfinite(alone.residual_um)


def test_no_answer_is_one_line(sessions, monkeypatch, capsys, batch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(cluster, "_ANSWER_SECONDS", 0.3)
    batch(*sessions, "--scheduler", "tcp://127.0.0.1:9", code=2)
    told = capsys.readouterr().err
    assert told.startswith("stitch: --scheduler tcp://127.0.0.1:9: no answer") and told.count("\n") == 1
    batch(*sessions, "--scheduler", "what://ever", code=2)
    batch(*sessions, "--scheduler", "tcp://127.0.0.1:9", "--workers", "2", code=2)


def test_where_nothing_can_be_read_nothing_is_left(tmp_path, batch):
    batch(tmp_path / "nowhere", "-o", tmp_path / "runs", code=2)
    assert not list(tmp_path.iterdir())
    (tmp_path / "own").mkdir()
    batch(tmp_path / "nowhere", "-o", tmp_path / "own", code=2)
    assert list(tmp_path.iterdir()) == [tmp_path / "own"]


@pytest.mark.usefixtures("ran")
def test_without_the_package_one_process_works(sessions, monkeypatch, capsys, batch):
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    batch(sessions[0], "--workers", "2", code=2)
    assert "pip install 'stitch-scans[cluster]'" in capsys.readouterr().err
    batch(sessions[0])


def test_an_interrupt_keeps_what_is_finished(sessions, ran, monkeypatch, capsys, batch):
    def stopped(jobs, *_):  # as pressed in the middle of the second session
        yield run_session(jobs[0])
        raise KeyboardInterrupt

    monkeypatch.setattr("stitch.plugins.watch.batch.run_batch.run_jobs", stopped)
    batch(*sessions, code=1)
    assert "stitch: stopped after 1 of 2 sessions" in capsys.readouterr().err.splitlines()[-1]
    monkeypatch.setattr("stitch.plugins.watch.batch.run_batch.run_jobs", run_jobs)
    batch(*sessions)
    assert ran == ["monday", "tuesday"]


def test_the_page_shows_those_first_that_need_somebody(tmp_path):
    numbers = {"views": 9, "left_out": 1, "coarse_um": 1000.0, "registered_um": 20.0, "noise_floor_um": 20.0}
    rows = [
        SessionRow("s/good", "good", str(tmp_path / "good"), residual_um=21.0, verdict="Well.", **numbers),
        SessionRow("s/odd", "odd", str(tmp_path / "odd"), residual_um=80.0, verdict="<b>Odd</b>.", **numbers),
        SessionRow("s/bad", "bad", error="no views overlap"),
    ]
    write_page(rows, tmp_path / "batch.html")
    page = (tmp_path / "batch.html").read_text()
    places = [page.index(text) for text in ("no views overlap", "odd/report.html", "good/report.html")]
    assert places == sorted(places)
    assert "3 sessions: 2 run, 1 without a result." in page
    assert "&lt;b&gt;Odd" in page and "9 of 10" in page and unbroken("80.0 µm") in page
    assert str(tmp_path) not in page


def test_two_sessions_of_one_name_lie_as_their_folders_do(cell, ran, tmp_path, monkeypatch, batch):
    monkeypatch.chdir(tmp_path)
    for robot in ("robot-1", "robot-2"):
        (tmp_path / robot).mkdir()
    monday = [write_labelled(tmp_path / robot / "monday", cell, "points") for robot in ("robot-1", "robot-2")]
    batch(*monday)
    assert ran == ["monday", "monday"]
    rows = parquet.read_table("runs/batch.parquet").to_pylist()
    assert [row["name"] for row in rows] == ["robot-1/monday", "robot-2/monday"]
    assert all(Path("runs", row["name"], "result.json").is_file() for row in rows)
    assert all(len(row["hand_eye"]) == 16 and row["U_mm"] > 0 and row["length_unit"] == "mm" for row in rows)
    batch(*monday)
    assert len(ran) == 2
    batch(monday[0], monday[0], code=2)


def test_a_doubt_about_a_session_ends_with_three(sessions, result, monkeypatch, capsys, batch):
    doubted = replace(result, doubts=("The base has moved.",))
    monkeypatch.setattr(run_batch, "run", lambda loaded, recorder: replace(doubted, session=loaded))
    batch(sessions[0], code=3)
    assert "monday: The base has moved." in capsys.readouterr().out


def test_before_and_after_are_of_the_same_pairs():
    steps = [{"step": "coarse", "mean": 0.4}, {"step": "hand-eye", "mean": 0.02}, {"step": "register", "mean": 0.01}]
    document = {
        "length_unit": "mm",
        "stages": [{"name": "coarse", "rms": 0.01, "seconds": 1}],
        "views": [],
        "effects": {},
    }
    document |= {"verdict": "", "residual_rms": 0.03, "noise_floor": 0.01, "hand_eye": np.eye(4).tolist()}
    row = run_batch.row_of_document(document | {"disagreement": {"steps": steps}}, "s", "s", U=(0.1, 0.2))
    assert row.steps_um == (400.0, 20.0, 10.0) and (row.U_mm, row.U_mrad) == (0.1, 0.2)
    assert run_batch.row_of_document(document, "s", "s", U=None).steps_um == (10.0, 30.0, None)


@pytest.mark.parametrize("begins", ["spawn", "fork"])
def test_a_pool_of_any_kind_hands_back_runs(sessions, begins):
    stitch_batch(sessions[:1])  # with threads of this process, which forked ones lack
    with ProcessPoolExecutor(2, mp_context=get_context(begins)) as pool:
        found = stitch_batch([*sessions, "nowhere"], pool)
    assert [run.session.name for run in found.runs[:2]] == ["monday", "tuesday"]
    assert found.runs[2] is None and "nowhere/session.toml" in found.errors["nowhere"]
    assert [row["name"] for row in found.rows()] == ["monday", "tuesday", "nowhere"]
    assert found.to_arrow().num_rows == 3
    with pytest.raises(InputError, match="client is a str"):
        stitch_batch(sessions, "tcp://10.0.0.5:8786")


@pytest.mark.slow  # half a minute of starting workers
def test_workers_of_dask_hand_back_twenty_runs(sessions):
    pytest.importorskip("distributed")
    with cluster.local_client(2) as client:
        found = stitch_batch([sessions[n % 2] for n in range(20)], client)
    assert [run.session.name for run in found.runs] == ["monday", "tuesday"] * 10 and not found.errors
    assert found.runs[0] == found.runs[18] != found.runs[1]


def test_a_session_beyond_its_seconds_or_memory_is_ended_and_the_others_run(sessions, capsys, batch):
    batch(sessions[0], "--session-seconds", "0.01", code=1)
    assert "took more than 0.01 s; to fix: give it longer" in capsys.readouterr().err
    batch(sessions[0], "--session-memory", "30MB", code=1)
    assert "needs more than 0.03 GB; to fix: give it more" in capsys.readouterr().err
    batch(sessions[0], "--session-memory", "much", code=2)
    assert "--session-memory much: to fix: give a size such as 2GB" in capsys.readouterr().err
    batch(*sessions, "--session-seconds", "100", "--session-memory", "4GB", "--store", "small", "--json")
    assert json.loads(capsys.readouterr().out)["done"] == 2
    kept = {"model.toml", "result.json", "ledger.json", "batch-mark.json"}
    assert {path.name for path in Path("runs/monday").iterdir()} == kept
    ended("export", "runs/monday", "--to", "ros")
    capsys.readouterr()
    batch(*sessions, "--json")
    assert json.loads(capsys.readouterr().out)["skipped"] == 2


@pytest.mark.parametrize(
    ("ends", "said"),
    [
        ("os.kill(os.getpid(), 11)", "its process ended with Segmentation fault: it said nothing"),
        ("print('no key', file=sys.stderr); os._exit(3)", "its process ended with code 3: no key"),
        ("os.write(2, b'std::bad_alloc'); os.abort()", "needs more than 4 GB; to fix: give it more"),
        ("raise MemoryError", "needs more than 4 GB; to fix: give it more"),
    ],
)
def test_a_process_that_dies_within_a_limit_of_memory_is_said_to_lack_it_only_where_it_says_so(ends, said, monkeypatch):
    monkeypatch.setattr(bounds, "_PROGRAM", f"import os, sys; {ends}")
    row = bounds.run_bounded(run_batch.BatchJob(Path("s"), Path("r"), "b", memory=4 * 10**9))
    assert row.error is not None and row.error.startswith(said)


@pytest.mark.parametrize("store", ["memory://fleet", "file://FOLDER/fleet"])
def test_sessions_of_a_store_become_runs_of_a_store(sessions, tmp_path, capsys, batch, store):
    fsspec = pytest.importorskip("fsspec")
    store = store.replace("FOLDER", str(tmp_path))
    files, root = fsspec.core.url_to_fs(store)
    for session in sessions:
        files.put(str(session), f"{root}/in/{session.name}", recursive=True)
    places = [f"{store}/in/monday", f"{store}/in/tuesday"]
    batch(*places, f"{store}/in/nowhere", "-o", f"{store}/out", code=1)
    assert "nothing there; to fix: correct the address" in capsys.readouterr().err
    assert {"result.json", "batch-mark.json"} <= {Path(name).name for name in files.find(f"{root}/out/monday")}
    assert json.loads(files.cat(f"{root}/out/monday/result.json"))["session"] == places[0]
    batch(*places, "-o", f"{store}/out", "--json")
    rows = json.loads(capsys.readouterr().out)["sessions"]
    assert [row["skipped"] for row in rows] == [True, True] and rows[0]["run"] == f"{store}/out/monday"
    assert rows[0]["U_mm"] > 0 and files.exists(f"{root}/out/batch.parquet")
    text = files.cat(f"{root}/in/monday/points.csv").rstrip() + b"1\n"
    files.pipe(f"{root}/in/monday/points.csv", text)
    batch(*places, "-o", f"{store}/out", "--json")
    assert [row["skipped"] for row in json.loads(capsys.readouterr().out)["sessions"]] == [False, True]
    batch(sessions[0], "-o", f"{store}/out", code=2)
