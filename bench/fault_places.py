"""Bad inputs: places for the output, full disks, two commands at once, command lines, terminals."""

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

from fault_folders import REPORT
from fault_room import Case
from fault_sessions import RUN

_PLACES = {
    "in the session": "s/run",
    "the session": "s",
    "clouds of the session": "s/clouds",
    "here": ".",
    "above": "..",
    "another session": "o",
    "in another session": "p/x",
    "a file": "mine.txt",
    "below a file": "mine.txt/x",
    "own files": "own",
    "a model alone": "model",
    "run of another session": "q",
    "long": "x" * 300,
    "system": "/proc/stitch",
    "link to a session": "link",
}
_LINES = """
rnu s
run
run nowhere
run s --what
run s --effects nothing
run s --effects range_scale --hand-eye r
run s --hand-eye nowhere
run s --hand-eye p
run s s
run s p -o out
check
check nowhere
check :smile:
add r
add r range_scale
add r nothing
add r incidence_bias --suggested
add r --suggested --at-most x
drop r nothing
drop r incidence_bias
batch nowhere
effects nothing
import nowhere.ls
import s/session.toml
import s
calibrate
calibrate sphere s
calibrate tracker s
calibrate robot nowhere
view s
compare [red]
diagnose r --effects-file nowhere.py
"""


def outputs() -> Iterator[Case]:
    """Places for the run where something would be lost, or nothing can be written."""
    base = ["run", "s", "--no-recording", "-o"]
    for name, place in _PLACES.items():
        yield Case("places for the run", name, _places([*base, place]))
    writes = ("q", "r", "out")
    yield Case("places that are right", "--force", _places([*base, "q", "--force"]), fine=True, writes=("q/",))
    yield Case("places that are right", "the same run", _places([*base, "r"]), fine=True, writes=("r/",))
    yield Case("places that are right", "link to a run", _places([*base, "linked"]), fine=True, writes=("r/",))
    for size in (3_000, 20_000, 60_000, 120_000):
        for command in (["run", "s", "-o", "out"], ["run", "s", "-o", "r"], ["add", "r", "incidence_bias"]):
            name = f"{command[0]} {size // 1000} kB"
            yield Case("disk full", name, lambda room, c=command: c, largest_file=size, writes=writes)
    for command in (
        ["run", "s", "-o", "r"],
        ["add", "r", "incidence_bias"],
        ["diagnose", "r"],
        ["compare", "r"],
        REPORT,
    ):
        yield Case("two at once", command[0], _held(command))


def _places(command: list[str]) -> Callable[[Path], list[str]]:
    def spoil(room: Path) -> list[str]:
        (room / "mine.txt").write_text("mine")
        (room / "own").mkdir()
        (room / "own" / "thesis.txt").write_text("mine")
        (room / "model").mkdir()
        shutil.copy(room / "r" / "model.toml", room / "model")
        (room / "link").symlink_to(room / "s")
        (room / "linked").symlink_to(room / "r")
        return command

    return spoil


def _held(command: list[str]) -> Callable[[Path], list[str]]:
    """Another process, this one, is writing into the run."""

    def spoil(room: Path) -> list[str]:
        import fcntl

        held = os.open(room / ".r.lock", os.O_RDWR | os.O_CREAT)
        fcntl.flock(held, fcntl.LOCK_EX)
        return command

    return spoil


def command_lines() -> Iterator[Case]:
    """Words that are no command, options that contradict, terminals without UTF-8."""
    for line in ["", *_LINES.strip().splitlines()]:
        yield Case("command lines", line, lambda room, words=line: words.split())
    for encoding in ("ascii", "latin-1", "cp437"):
        for command in (["effects"], ["compare", "r"], [*RUN]):
            yield Case(
                "terminals without UTF-8",
                f"{encoding} {command[0]}",
                lambda room, c=command: c,
                fine=True,
                environment={"PYTHONIOENCODING": encoding},
                writes=("r", "out"),
            )
