"""A batch started again: what is finished is found, what is not is run, and nothing twice."""

import fcntl
import json
import os
import threading
from pathlib import Path

import pytest

from data_synth.fixtures.edits import edit
from stitch.cli.main import main
from stitch.output.run_folder import write_with_page
from stitch.plugins.watch.batch import run_batch
from stitch.plugins.watch.batch.run_batch import BatchJob, run_session

pytestmark = pytest.mark.usefixtures("no_drawing")


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
