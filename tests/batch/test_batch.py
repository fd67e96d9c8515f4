"""stitch batch: what is finished is found again, what is not is run once, and how it ends."""

import fcntl
import json
import os
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_synth.fixtures.edits import edit
from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from stitch.batch import cluster, finished, one_session
from stitch.batch.job import Job
from stitch.batch.one_session import run_session
from stitch.batch.results import results
from stitch.batch.session_row import SessionRow
from stitch.cli.main import main
from stitch.pipeline import run
from stitch.writing.run_folder import write_with_page
from viz.batch_page import write_page

pytestmark = pytest.mark.usefixtures("no_drawing")


@pytest.fixture(scope="module")
def cell():
    return labelled_cell(2, views=8)[0]


@pytest.fixture
def sessions(cell, tmp_path, monkeypatch):
    """Two small sessions of labelled points, in the folder one stands in."""
    monkeypatch.chdir(tmp_path)
    return [write_labelled(tmp_path / name, cell, "points") for name in ("monday", "tuesday")]


@pytest.fixture(scope="module")
def result(cell):
    """What a run of such a session finds; computed once."""
    return run(cell)


@pytest.fixture
def ran(monkeypatch, result):
    """Names of the sessions that were run, in their order; all have the same numbers."""
    names = []

    def noted(loaded, recorder):
        names.append(loaded.path.name)
        return replace(result, session=loaded)

    monkeypatch.setattr(one_session, "run", noted)
    return names


def batch(*arguments, code=0):
    with pytest.raises(SystemExit) as ended:
        main(["batch", *map(str, arguments), "--no-recording"])
    assert (ended.value.code or 0) == code


def test_started_again_it_runs_what_is_new_changed_or_missing(sessions, ran, capsys):
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


def test_it_goes_on_after_whatever_befalls_one_session(sessions, result, monkeypatch, capsys):
    """Also after an error that nobody foresaw."""

    def fails_once(loaded, recorder):
        if loaded.path.name == "monday":
            raise ZeroDivisionError("by\nzero")
        return replace(result, session=loaded)

    monkeypatch.setattr(one_session, "run", fails_once)
    batch(*sessions, "--json", code=1)
    bad, good = json.loads(capsys.readouterr().out)["sessions"]
    assert bad["error"] == "ZeroDivisionError: by zero" and good["error"] is None
    assert sorted(path.name for path in Path("runs").iterdir()) == ["batch.html", "batch.json", "tuesday"]
    assert {"result.json", "report.html"} <= {path.name for path in Path("runs/tuesday").iterdir()}


def test_a_model_that_was_changed_since_is_kept_and_a_run_that_took_its_place_is_not_trusted(sessions, ran):
    batch(sessions[0])
    main_ends("note", "runs/monday", "looks well")
    main_ends("add", "runs/monday", "joint_offset", "--no-recording")
    batch(sessions[0])
    assert ran == ["monday"]
    # A run of a session that is different now leaves the mark of the batch where it is.
    edit(sessions[0] / "points.csv", r"(?m)(\d)$", lambda found: str((int(found[1]) + 1) % 10))
    before = (sessions[0] / "points.csv").read_bytes()
    main_ends("run", sessions[0], "-o", "runs/monday", "--no-recording")
    assert (sessions[0] / "points.csv").read_bytes() == before
    batch(sessions[0])
    assert ran == ["monday", "monday"]


def main_ends(*arguments):
    with pytest.raises(SystemExit) as ended:
        main([str(a) for a in arguments])
    assert not ended.value.code


def test_all_that_a_run_reads_counts_as_content(sessions):
    (sessions[0] / "session.toml").write_text(
        (sessions[0] / "session.toml").read_text() + '\n[part]\ncad = "../part.stl"\n'
    )
    part = sessions[0].parent / "part.stl"
    seen = []
    for text in ("solid", "solid again"):
        part.write_text(text)
        seen.append(finished.content_of(sessions[0]))
    assert None not in seen and seen[0] != seen[1]
    assert finished.content_of(sessions[0] / "nowhere") is None


def test_one_that_was_given_up_and_still_writes_is_waited_for(sessions, ran, tmp_path):
    """As after a worker that the scheduler has lost but that lives: the second finds what the first wrote."""
    job = Job(sessions[0], tmp_path / "runs" / "monday", "a", recording=False)
    content = finished.content_of(job.session)
    result = one_session.run(one_session.load_session(job.session), None)
    with one_session.run_folder.new_folder(job.run, [job.session]) as scratch:
        write_with_page(result, scratch)
        finished.mark(job, content, scratch)
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
        run_session(Job(sessions[0], tmp_path / "runs" / "monday", name, force=True, recording=False))
        for name in ("first", "second", "second")
    ]
    assert not any(row.skipped or row.error for row in rows)
    assert ran == ["monday", "monday"]


def test_the_workers_of_a_scheduler(sessions, tmp_path):
    """Two threads of this process as workers; a session that cannot be read does not stop the others."""
    distributed = pytest.importorskip("distributed")
    jobs = [Job(path, tmp_path / "runs" / path.name, "a", recording=False) for path in (*sessions, tmp_path / "gone")]
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address="127.0.0.1:0"
    ) as two:
        rows = {row.name: row for row in results(jobs, scheduler=two.scheduler_address)}
    assert "gone/session.toml: not found" in rows["gone"].error and rows["gone"].bad_input
    alone = run_session(Job(sessions[0], tmp_path / "alone", "b", recording=False))
    numbers = ("residual_um", "registered_um", "noise_floor_um", "worst_view_um", "coarse_um")
    assert [getattr(rows["monday"], key) for key in numbers] == [getattr(alone, key) for key in numbers]
    assert np.isfinite(alone.residual_um)


def test_no_answer_is_one_line(sessions, monkeypatch, capsys):
    pytest.importorskip("distributed")
    monkeypatch.setattr(cluster, "_ANSWER", 0.3)
    batch(*sessions, "--scheduler", "tcp://127.0.0.1:9", code=2)
    told = capsys.readouterr().err
    assert told.startswith("stitch: --scheduler tcp://127.0.0.1:9: no answer") and told.count("\n") == 1
    batch(*sessions, "--scheduler", "what://ever", code=2)
    batch(*sessions, "--scheduler", "tcp://127.0.0.1:9", "--workers", "2", code=2)


@pytest.mark.usefixtures("ran")
def test_without_the_package_one_process_works(sessions, monkeypatch, capsys):
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    batch(sessions[0], "--workers", "2", code=2)
    assert "pip install 'stitch[cluster]'" in capsys.readouterr().err
    batch(sessions[0])


def test_an_interrupt_keeps_what_is_finished(sessions, ran, monkeypatch, capsys):
    def stopped(jobs, *_):
        yield run_session(jobs[0])
        raise KeyboardInterrupt

    monkeypatch.setattr("stitch.cli.batch_sessions.results", stopped)
    batch(*sessions, code=1)
    assert "stitch: stopped with 1 of 2 sessions" in capsys.readouterr().err.splitlines()[-1]
    monkeypatch.setattr("stitch.cli.batch_sessions.results", results)
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
    assert "&lt;b&gt;Odd" in page and "9 of 10" in page and "80.0 µm" in page
    assert str(tmp_path) not in page
