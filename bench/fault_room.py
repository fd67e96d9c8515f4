"""One bad input in a room of its own: what a command says to it, and what it leaves behind."""

import hashlib
import os
import resource
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from stitch.cli.main import main

WIDE = 2  # cases at a time


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


@dataclass(frozen=True)
class Outcome:
    """What became of a case; `faults` is empty where all is as it should be."""

    case: Case
    code: int
    seconds: float
    error: str
    faults: tuple[str, ...]


def judge(cases: Iterable[Case], material: Path, rooms: Path, limit: float) -> Iterator[Outcome]:
    """Run all cases, `WIDE` at a time, each in a process and a copy of `material` of its own.

    Args:
        limit: seconds after which a command counts as hanging.
    """
    waiting, running = list(enumerate(cases)), {}
    while waiting or running:
        while waiting and len(running) < WIDE:
            number, case = waiting.pop(0)
            one = _Running(case, rooms / str(number), material)
            running[one.start()] = one
        for process, one in list(running.items()):
            done, status = os.waitpid(process, os.WNOHANG)
            if done or one.seconds > limit:
                del running[process]
                if not done:
                    os.kill(process, signal.SIGKILL)
                    os.waitpid(process, 0)
                yield one.outcome(os.waitstatus_to_exitcode(status) if done else None)
        time.sleep(0.02)


class _Running:
    def __init__(self, case: Case, outer: Path, material: Path) -> None:
        self.case, self.outer, self.room = case, outer, outer / "room"
        shutil.copytree(material, self.room, symlinks=True)
        for file in self.room.rglob("result.json"):
            file.write_text(file.read_text().replace(str(material), str(self.room)))
        self.arguments = case.spoil(self.room)
        self.before = snapshot(outer)
        self.began = time.monotonic()

    def start(self) -> int:
        """The process in which the command runs."""
        sys.stdout.flush()
        process = os.fork()
        if not process:
            _run(self.room, self.arguments, self.case, self.outer.with_suffix(".out"), self.outer.with_suffix(".err"))
        return process

    @property
    def seconds(self) -> float:
        return time.monotonic() - self.began

    def outcome(self, code: int | None) -> Outcome:
        """What is wrong with how the command ended; the room is removed."""
        out, error = (self.outer.with_suffix(e).read_text(errors="replace") for e in (".out", ".err"))
        faults = ["hang"] if code is None else list(_faults(self.case, code, out, error))
        if code == 0 and self.case.right is not None and not self.case.right(self.room):
            faults.append("silent")
        after = snapshot(self.outer)
        changed = {path for path in {*after, *self.before} if after.get(path) != self.before.get(path)}
        allowed = self.case.writes if code == 0 else ()
        if any(not path.startswith(tuple(f"room/{name}" for name in allowed) or ("/",)) for path in changed):
            faults.append("leftovers")
        for file in (self.outer.with_suffix(".out"), self.outer.with_suffix(".err")):
            file.unlink()
        shutil.rmtree(self.outer)
        return Outcome(self.case, -9 if code is None else code, self.seconds, error, tuple(faults))


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


def _run(room: Path, arguments: list[str], case: Case, out: Path, error: Path) -> None:
    os.setsid()
    os.chdir(room)
    os.environ.update(case.environment)
    for file, descriptor in ((out, 1), (error, 2)):
        opened = os.open(file, os.O_WRONLY | os.O_CREAT)
        os.dup2(opened, descriptor)
    encoding = case.environment.get("PYTHONIOENCODING", "utf-8")
    sys.stdout = os.fdopen(1, "w", encoding=encoding)
    sys.stderr = os.fdopen(2, "w", encoding=encoding, errors="backslashreplace")
    if case.largest_file is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (case.largest_file, case.largest_file))
    code = 1
    try:
        main(arguments)
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException as unexpected:
        print(f"Traceback (most of it left out): {unexpected!r}", file=sys.stderr)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def snapshot(folder: Path) -> dict[str, str]:
    """What lies in a folder, by path: the digest of a file, where a link points, the kind of anything else."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_symlink():
            found[name] = f"-> {path.readlink()}"
        elif path.is_file():
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
        elif path.is_dir():
            found[name] = "folder"
        else:
            found[name] = "pipe"
    return found
