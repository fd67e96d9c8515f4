"""One bad input in a room of its own: what a command says to it, and what it leaves behind; and commands that are
killed."""

import hashlib
import json
import os
import resource
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from bench.harness import Row
from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from data_synth.write import write_session
from stitch.cli.main import main

KILLED = {
    "run": ["run", "o", "-o", "r", "--force", "--no-recording"],
    "add": ["add", "r", "incidence_bias", "--no-recording"],
}
TRIED_AGAIN = 5  # after every so many kills the command runs once more, to its end
_HANG = 10.0  # seconds beyond what a good run takes here
# What differs from run to run although the numbers are the same.
_VARIES = {"result.json", "report.html", "recording.rrd", "diagnosis.rrd"}


@dataclass(frozen=True)
class Case:
    """A way to spoil the room and the command that meets it. Its folders: s, o clouds, p points; r, q, a: runs."""

    kind: str
    name: str
    spoil: Callable[[Path], list[str]]  # the room -> arguments
    fine: bool = False  # a right input that looks odd: it must not be refused
    writes: tuple[str, ...] = ("out", "runs")  # where a command that ends well may write
    environment: dict[str, str] = field(default_factory=dict)
    largest_file: int | None = None  # bytes, as on a full disk
    holds: str = ""  # what the result on standard output must begin with
    right: Callable[[Path], bool] | None = None  # what holds of the room where the command ends well, as it may then


@cache
def material() -> tuple[TemporaryDirectory[str], Path, float]:
    """Return a folder with two small cloud sessions s and o, labelled points p, runs r of s, q of o, a of p; and the
    seconds of a run. In processes of their own: this one must stay without threads, or its forks would wait."""
    kept = TemporaryDirectory(prefix="faults-")
    folder = Path(kept.name).resolve() / "material"
    folder.mkdir()
    _must(_forked(lambda: _write_sessions(folder)))
    seconds = 0.0
    for line in ("s -o r --effects range_scale", "o -o q", "p -o a --effects gear_eccentricity"):
        begun = time.monotonic()
        _must(_forked(lambda line=line: (os.chdir(folder), main(["run", *line.split()]))))
        seconds = max(seconds, time.monotonic() - begun)
    (folder / "r" / "mine.txt").write_text("a person's own")
    return kept, folder, seconds


def _write_sessions(folder: Path) -> None:
    for seed, name in enumerate("so"):
        write_session(folder / name, measured_blade(seed, views=6, pixels=50), name)
    write_labelled(folder / "p", labelled_cell(5, views=16)[0])


def _forked(work: Callable[[], object]) -> int:
    """The process in which some work is done; it ends with the code of a command."""
    sys.stdout.flush()
    process = os.fork()
    if process:
        return process
    code = 1
    try:
        work()
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _must(process: int) -> None:
    if os.waitpid(process, 0)[1]:
        raise SystemExit("the good input of the benchmark fails already")


def fresh(room: Path) -> Path:
    """Make a room of the material, whose runs name the sessions of the room, and return it."""
    shutil.rmtree(room, ignore_errors=True)
    shutil.copytree(material()[1], room, symlinks=True)
    for file in room.rglob("result.json"):
        file.write_text(file.read_text().replace(str(material()[1]), str(room)))
    return room


def judged(case: Case) -> Row:
    """Run a case in a process and a room of its own; return how it ended and what is wrong with that."""
    limit = material()[2] + _HANG
    with TemporaryDirectory(prefix="fault-") as name:
        outer = Path(name).resolve() / "outer"
        room, out, error = fresh(outer / "room"), outer.with_suffix(".out"), outer.with_suffix(".err")
        arguments = case.spoil(room)
        before, begun = snapshot(outer), time.monotonic()
        process = _forked(lambda: _command(room, arguments, case, out, error))
        done, status = 0, 0
        while not done and time.monotonic() - begun < limit:
            time.sleep(0.02)
            done, status = os.waitpid(process, os.WNOHANG)
        if not done:
            os.kill(process, signal.SIGKILL)
            os.waitpid(process, 0)
        code = os.waitstatus_to_exitcode(status) if done else None
        seconds, text = time.monotonic() - begun, error.read_text(errors="replace")
        faults = ["hang"] if code is None else list(_faults(case, code, out.read_text(errors="replace"), text))
        if code == 0 and case.right is not None and not case.right(room):
            faults.append("silent")
        after = snapshot(outer)
        changed = {path for path in {*after, *before} if after.get(path) != before.get(path)}
        allowed = tuple(f"room/{place}" for place in (case.writes if code == 0 else ())) or ("/",)
        if not all(path.startswith(allowed) for path in changed):
            faults.append("leftovers")
    return {"code": code, "seconds": seconds, "faults": faults, "error": " ".join(text.split())[-300:]}


def _command(room: Path, arguments: list[str], case: Case, out: Path, error: Path) -> None:
    os.setsid()
    os.chdir(room)
    os.environ.update(case.environment)
    for file, descriptor in ((out, 1), (error, 2)):
        os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT), descriptor)
    encoding = case.environment.get("PYTHONIOENCODING", "utf-8")
    sys.stdout = os.fdopen(1, "w", encoding=encoding)
    sys.stderr = os.fdopen(2, "w", encoding=encoding, errors="backslashreplace")
    if case.largest_file is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (case.largest_file, case.largest_file))
    main(arguments)


def _faults(case: Case, code: int, out: str, error: str) -> Iterator[str]:
    if "Traceback (most" in error or "stitch: unexpected" in error or code not in (0, 1, 2):
        yield "traceback"
    elif case.fine and code:
        yield "refused though right"
    elif not (code or case.fine or case.right):
        yield "silent"
    elif case.holds and not out.startswith(case.holds):
        yield "not the result alone"
    elif code and not _clear(error):
        yield "unclear"


def _clear(error: str) -> bool:
    """One line of stitch with the place and what to do, or the usage of a command line."""
    lines = [line for line in error.splitlines() if line.startswith("stitch: ")]
    return "Usage: " in error or (len(lines) == 1 and any(sign in lines[0] for sign in (";", "to fix:", "; use ")))


def snapshot(folder: Path) -> dict[str, str]:
    """Return what lies in a folder, by path: the digest of a file, where a link points, the kind of anything else."""
    entries = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_symlink():
            entries[name] = f"-> {path.readlink()}"
        elif path.is_file():
            entries[name] = hashlib.sha256(path.read_bytes()).hexdigest()
        else:
            entries[name] = "folder" if path.is_dir() else "pipe"
    return entries


def killed(command: str, share: float, try_again: bool) -> Row:
    """Kill a command after a share of its usual seconds; return whether the old run or the new one is left, whole, and
    whether the command works on, if that is tried."""
    usual, new = _whole(command)
    room = _kill_room(command)
    process = _forked(lambda: _quietly(command, room))
    time.sleep(share * usual)
    os.kill(process, signal.SIGKILL)
    os.waitpid(process, 0)
    state = _contents(room / "r")
    left = "old" if state == _contents(material()[1] / "r") else "new" if state == new else "neither"
    return {"left": left, "works": not try_again or _works_on(command, room)}


def _kill_room(command: str) -> Path:
    """A fresh room at the same place for every kill of a command: some files of a run name their folder."""
    return fresh(material()[1].with_name(f"kill-{command}"))


@cache
def _whole(command: str) -> tuple[float, dict[str, str]]:
    """Seconds of a command, and what it leaves."""
    room, begun = _kill_room(command), time.monotonic()
    _must(_forked(lambda: _quietly(command, room)))
    return time.monotonic() - begun, _contents(room / "r")


def _quietly(command: str, room: Path) -> None:
    os.chdir(room)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    main(KILLED[command])


def _works_on(command: str, room: Path) -> bool:
    """The same command again ends well, or says that it has been done; nothing of the first one stays."""
    _, status = os.waitpid(_forked(lambda: _quietly(command, room)), 0)
    code = os.waitstatus_to_exitcode(status)
    done = json.loads((room / "r" / "ledger.json").read_text())[-1]["effects"][-1:] == ["incidence_bias"]
    clean = not [path for path in room.iterdir() if path.name.startswith(".")]
    return clean and (code == 0 or (command == "add" and done)) and (room / "r" / "mine.txt").is_file()


def _contents(run: Path) -> dict[str, str]:
    """A run folder: its files by digest; of files that hold times, that they are whole, and the numbers in them."""
    entries = snapshot(run)
    for name in _VARIES & set(entries):
        data = (run / name).read_bytes()
        entries[name] = f"{len(data) > 1000}"
        if name == "result.json":
            document = json.loads(data)
            entries[name] = json.dumps([document["hand_eye"], document["effects"], Path(document["session"]).name])
    return entries
