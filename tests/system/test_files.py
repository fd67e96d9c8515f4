"""A folder is there as it was or as it shall be, and a person's own files outlive every change.

Foreign code that does not end.

PLY files against another library, in every encoding, with every type of number and with lists.
"""

import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Event

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from stitch.errors import InputError
from stitch.system import files
from stitch.system.files import claim_folder, only_writer, rewrite_folder
from stitch.system.ply_file import Lists, PlyError, read_ply, vertex_columns, write_ply
from stitch.system.time_limit import running_over, time_limit

KINDS = ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"]
ENCODINGS = [(True, "="), (False, "<"), (False, ">")]


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


def hold(release):
    with time_limit(0.3, "too long"):
        release.wait(60)


def test_a_thread_that_takes_too_long_interrupts_who_waits_for_it():
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(hold, release := Event())
        with pytest.raises(InputError, match="too long"):
            waiting.result()
        assert running_over()
        release.set()
    assert not running_over()


def test_what_ends_in_time_is_left_alone():
    with time_limit(1.0, "outer"):
        with time_limit(0.1, "inner"):
            pass
        time.sleep(0.2)
    time.sleep(1.0)


def numbers_of_every_kind(count: int) -> np.ndarray:
    rng = np.random.default_rng(count)
    rows = np.empty(count, [(f"of_{kind}", kind) for kind in KINDS])
    for kind in KINDS:
        limits = None if kind[0] == "f" else np.iinfo(kind)
        values = rng.normal(size=count) if limits is None else rng.integers(limits.min, limits.max, count)
        rows[f"of_{kind}"] = values.astype(kind)
    return rows


def triangles(count: int) -> np.ndarray:
    rows = np.empty(count, [("vertex_indices", "i4", (3,)), ("flag", "u1")])
    rows["vertex_indices"] = np.arange(3 * count).reshape(-1, 3)
    rows["flag"] = 7
    return rows


def lists_of_different_lengths(count: int) -> np.ndarray:
    rows = np.empty(count, [("pixel", "O"), ("weight", "f4")])
    for k in range(count):
        rows["pixel"][k] = np.arange(k % 4, dtype="i4")
    rows["weight"] = 0.25
    return rows


@pytest.mark.parametrize(("text", "order"), ENCODINGS)
@pytest.mark.parametrize("count", [0, 1, 500])
def test_files_of_another_library_are_read_to_the_same_numbers(tmp_path, count, text, order):
    elements = [
        PlyElement.describe(numbers_of_every_kind(count), "vertex"),
        PlyElement.describe(triangles(count), "face"),
        PlyElement.describe(
            lists_of_different_lengths(count), "grid", len_types={"pixel": "u2"}, val_types={"pixel": "i4"}
        ),
    ]
    PlyData(elements, text=text, byte_order=order).write(str(tmp_path / "c.ply"))
    read, other = read_ply(tmp_path / "c.ply"), PlyData.read(str(tmp_path / "c.ply"))
    for name in other["vertex"].data.dtype.names:
        np.testing.assert_array_equal(read["vertex"][name], other["vertex"][name])
    faces, pixels = read["face"]["vertex_indices"], read["grid"]["pixel"]
    assert isinstance(faces, Lists) and isinstance(pixels, Lists)
    np.testing.assert_array_equal(faces.lengths, np.full(count, 3))
    np.testing.assert_array_equal(faces.values, np.arange(3 * count))
    np.testing.assert_array_equal(pixels.lengths, np.arange(count) % 4)
    np.testing.assert_array_equal(pixels.values, np.concatenate([np.empty(0), *other["grid"]["pixel"]]))
    np.testing.assert_array_equal(read["grid"]["weight"], other["grid"]["weight"])


@pytest.mark.parametrize("count", [0, 1, 500])
def test_files_are_written_byte_for_byte_as_another_library_writes_them(tmp_path, count):
    elements = {"vertex": numbers_of_every_kind(count), "face": triangles(count)}
    write_ply(tmp_path / "ours.ply", elements)
    PlyData([PlyElement.describe(rows, name) for name, rows in elements.items()], byte_order="<").write(
        str(tmp_path / "theirs.ply")
    )
    assert (tmp_path / "ours.ply").read_bytes() == (tmp_path / "theirs.ply").read_bytes()


def test_blank_lines_comments_and_unknown_remarks_in_a_header_are_passed_over(tmp_path):
    file = tmp_path / "c.ply"
    file.write_bytes(
        b"ply\r\nformat ascii 1.0\r\n\r\ncomment by hand\r\nobj_info num_cols 2\r\nelement vertex 2\r\n"
        b"property float32 x\r\nproperty uint8 grey\r\nend_header\r\n1.5 3\r\n-2 255\r\n"
    )
    columns = vertex_columns(file)
    np.testing.assert_array_equal(columns["x"], np.float32([1.5, -2]))
    np.testing.assert_array_equal(columns["grey"], [3, 255])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (b"plyx\n", "does not begin with ply"),
        (b"ply\nformat ascii 1.0\n", "no end_header"),
        (b"ply\nformat odd 1.0\nend_header\n", "format odd"),
        (b"ply\nelement vertex 1\nproperty float x\nend_header\n", "format"),
        (b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n1\n", "1 rows"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\none\n", "one"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty float x\nend_header\n1234", "ends early"),
        (b"ply\nformat binary_big_endian 1.0\nelement face 2\nproperty list uchar int i\nend_header\n\1", "ends early"),
        (b"ply\nformat ascii 1.0\nelement face 1\nproperty list uchar int i\nend_header\n2 1\n", "face"),
        (b"ply\nformat ascii 1.0\nelement face 1\nproperty quad i\nend_header\n2 1\n", "property quad i"),
        (b"ply\nformat ascii 1.0\nelement face 0\nproperty float i\nend_header\n", "no element is called vertex"),
    ],
)
def test_what_is_no_whole_file_is_refused_in_words(tmp_path, text, said):
    (tmp_path / "c.ply").write_bytes(text)
    with pytest.raises(PlyError, match=said):
        vertex_columns(tmp_path / "c.ply")
