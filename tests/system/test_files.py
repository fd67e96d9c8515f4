"""A folder is there as it was or as it shall be, and a person's own files outlive every change.

Foreign code that does not end.
"""

import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from stitch.errors import InputError
from stitch.system import files
from stitch.system.files import claim_folder, only_writer, rewrite_folder
from stitch.system.time_limit import running_over, time_limit


def ours(inside):
    return inside.name in ("model", "result")


@pytest.fixture
def run(tmp_path):
    run = tmp_path / "run"
    (run / "own" / "empty").mkdir(parents=True)
    for name in ("model", "result", "notes", "own/model.txt"):
        (run / name).write_text(f"old {name}")
    (run / "link").symlink_to("nowhere")
    return run


def contents(folder):
    return {
        str(p.relative_to(folder)): p.read_text() if p.is_file() else str(p.is_symlink()) for p in folder.rglob("*")
    }


KEPT = {
    "notes": "old notes",
    "own": "False",
    "own/empty": "False",
    "own/model.txt": "old own/model.txt",
    "link": "True",
}


def rewrite(run):
    with rewrite_folder(run, ours) as scratch:
        (scratch / "model").write_text("new")


@pytest.mark.parametrize("way", ["exchange", "two renames", "in place", "link"])
def test_only_what_is_ours_is_replaced(run, tmp_path, monkeypatch, way):
    path = run
    if way == "two renames":
        monkeypatch.setattr(files, "exchange_paths", lambda *_: False)
    elif way == "in place":
        monkeypatch.chdir(run)
    elif way == "link":
        path = tmp_path / "link"
        path.symlink_to(run)
    before = run.stat().st_ino
    rewrite(path)
    assert contents(run) == KEPT | {"model": "new"}
    assert path.is_symlink() == (way == "link")
    assert {p.name for p in tmp_path.iterdir()} == {"run", *(["link"] if way == "link" else [])}
    if way == "in place":
        assert run.stat().st_ino == before, "who stands in it must not stand in a folder that is gone"


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="names of open files are read from /proc")
def test_what_is_new_is_on_the_disk_before_it_takes_its_place(run, monkeypatch):
    seen = []
    monkeypatch.setattr(os, "fsync", lambda descriptor: seen.append(os.readlink(f"/proc/self/fd/{descriptor}")))
    monkeypatch.setattr(files, "exchange_paths", lambda *_: bool(seen.append("exchanged")))
    rewrite(run)
    assert any(name.endswith("/model") for name in seen[: seen.index("exchanged")])


def test_a_block_that_fails_changes_nothing(run, tmp_path):
    before = contents(run)
    with pytest.raises(OSError, match="disk full") as error, rewrite_folder(run, ours) as scratch:
        (scratch / "model").write_text("new")
        raise OSError(28, "disk full", str(scratch / "model"))
    assert contents(run) == before and list(tmp_path.iterdir()) == [run]
    assert error.value.filename == str(run / "model"), "the scratch folder is nobody's business"


@pytest.mark.parametrize("moment", range(12))
def test_an_end_at_any_moment_of_a_change_in_place_is_made_good(run, monkeypatch, moment):
    """The process ends before its n-th call that changes the disk; whoever comes next finishes or clears away."""
    before = contents(run)
    monkeypatch.chdir(run)
    process = os.fork()
    if not process:
        calls = iter(range(moment))
        for name in ("rename", "replace", "unlink"):
            true = getattr(type(run), name)
            monkeypatch.setattr(
                type(run),
                name,
                lambda *a, true=true, **k: true(*a, **k) if next(calls, None) is not None else os._exit(9),
            )
        rewrite(run)
        os._exit(0)
    os.waitpid(process, 0)
    with claim_folder(run):
        pass
    assert contents(run) in (before, KEPT | {"model": "new"})


WINDOWS = Path(__file__).parents[1] / "as_on_windows.py"


HERE_OR_THERE = {"here": "", "windows": f"import runpy; runpy.run_path({str(WINDOWS)!r})['behave_as_windows']()"}


HOLDING = """
import sys, time
from pathlib import Path
from stitch.system.files import only_writer
with only_writer(Path(sys.argv[1]), Path("r")):
    print("held", flush=True)
    time.sleep(float(sys.argv[2]))
"""


FILE_IN_USE = """
import sys
from pathlib import Path
from stitch.system.files import rewrite_folder
run = Path(sys.argv[1])
with open(run / "notes"):
    try:
        with rewrite_folder(run, lambda inside: inside.name in ("model", "result")) as scratch:
            (scratch / "model").write_text("new", encoding="utf-8")
    except PermissionError as error:
        print(error)
"""


def python(machine, code, *arguments):
    return [sys.executable, "-c", f"{HERE_OR_THERE[machine]}\n{code}", *map(str, arguments)]


@pytest.mark.parametrize("machine", HERE_OR_THERE)
def test_a_second_process_is_refused_until_the_first_has_ended(tmp_path, machine):
    lock = tmp_path / ".r.lock"
    with subprocess.Popen(python(machine, HOLDING, lock, 60), stdout=subprocess.PIPE) as first:
        assert first.stdout.readline() == b"held\n"
        second = subprocess.run(python(machine, HOLDING, lock, 0), capture_output=True, text=True)
        assert "r: another stitch is writing there" in second.stderr
        first.kill()
    subprocess.run(python(machine, HOLDING, lock, 0), check=True, capture_output=True)
    assert not lock.exists()


def test_a_block_within_a_block_of_one_process_holds_the_lock_with_it(tmp_path):
    lock = tmp_path / ".r.lock"
    with only_writer(lock, "r"), only_writer(lock, "r"):
        assert lock.exists()
    assert not lock.exists()


def test_a_folder_whose_file_is_in_use_stays_as_it_was_where_it_cannot_move(run, tmp_path):
    before = contents(run)
    said = subprocess.run(python("windows", FILE_IN_USE, run), capture_output=True, text=True, check=True)
    assert "used by another process" in said.stdout
    assert contents(run) == before
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def spin(seconds):
    with time_limit(0.3, "too long"):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            pass


@pytest.mark.parametrize("wait", [spin, time.sleep])
def test_what_takes_too_long_is_interrupted(wait):
    began = time.monotonic()
    with pytest.raises(InputError, match="too long"), time_limit(0.3, "too long"):
        wait(30)
    assert time.monotonic() - began < 10 and not running_over()


def test_a_thread_that_takes_too_long_interrupts_who_waits_for_it():
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(spin, 2)
        with pytest.raises(InputError, match="too long"):
            waiting.result()
        assert running_over()
    assert not running_over()


def test_what_ends_in_time_is_left_alone():
    with time_limit(0.5, "outer"):
        with time_limit(0.1, "inner"):
            pass
        time.sleep(0.2)
    time.sleep(0.6)
