"""Bad inputs: cells over days, batches, plans, formulas and reviews of what is none."""

import os
import shutil
import socket
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path

from fault_folders import REPORT
from fault_room import Case
from fault_sessions import with_text

_LINES = """
watch
watch nowhere
watch s
watch mine.txt
watch cell --add
watch cell --add nowhere
watch cell --add s
watch cell --add r nowhere
watch s --add r
watch s/cell --add r
watch r --add r
watch mine.txt --add r
watch cell --add r q --at 2026-01-01
watch cell --add r --at yesterday
watch cell --add r --in-use nowhere
watch cell --add r --in-use q
watch cell --add r --tolerance nan
watch cell --add r --dfq nowhere/x.dfq
watch cell --add r --dfq s/session.toml
batch mine.txt
batch s s -o out
batch s -o mine.txt
batch s -o s
batch s -o s/clouds
batch s --scheduler nonsense -o out
batch s --workers 2 --scheduler tcp://127.0.0.1:1
batch s --workers 0
plan nowhere
plan mine.txt
plan s --views 0
plan s --split nothing backlash
plan s --split backlash backlash
plan s --for 1,2
plan s --for nan,0,0
plan s --part nowhere.stl
plan s --part mine.txt
plan s --part mine.pipe
plan s --part s/clouds/v000.ply
plan s --part empty.stl
plan s --part noise.stl
plan s --size nan
plan s --size 1e-9
plan s --field 180
plan s --start 1,2
plan s --start x
plan s -o r
plan r --size 3
explain nowhere
explain s
explain r -o x.txt
explain r -o mine.py
explain r -o nowhere/x.py
review nowhere --no-browser
review s --no-browser
review r --port 99999 --no-browser
review r --effects-file nowhere.py --no-browser
"""


def _line(words: str) -> Callable[[Path], list[str]]:
    def spoil(room: Path) -> list[str]:
        for name in ("mine.txt", "mine.py"):
            (room / name).write_text("mine")
        os.mkfifo(room / "mine.pipe")
        (room / "empty.stl").touch()
        (room / "noise.stl").write_bytes(bytes(range(256)) * 40)
        return words.split()

    return spoil


def _history(change: Callable[[Path], object]) -> Callable[[Path], list[str]]:
    """Something else where the history of a cell should be."""

    def spoil(room: Path) -> list[str]:
        (room / "cell").mkdir()
        change(room / "cell" / "history.sqlite")
        return ["watch", "cell", "--add", "r"]

    return spoil


def _database(*statements: str) -> Callable[[Path], None]:
    def write(file: Path) -> None:
        connection = sqlite3.connect(file)
        for statement in statements:
            connection.execute(statement)
        connection.commit()
        connection.close()

    return write


def cells() -> Iterator[Case]:
    """What is named where a cell, a run, a mesh or a place for something is asked for."""
    for words in _LINES.strip().splitlines():
        yield Case(f"stitch {words.split()[0]}", words, _line(words))
    older = ("CREATE TABLE cell (key, value)", "INSERT INTO cell VALUES ('format', '\"stitch-history/0\"')")
    for name, change in {
        "noise": lambda file: file.write_bytes(bytes(range(256)) * 40),
        "folder": Path.mkdir,
        "pipe": os.mkfifo,
        "device": lambda file: file.symlink_to("/dev/zero"),
        "another database": _database("CREATE TABLE parts (name)"),
        "an older form": _database(*older),
    }.items():
        yield Case("histories of cells", name, _history(change))
    yield Case("stitch review", "port in use", _port_in_use)
    command = ["review", "r", "--no-browser"]
    yield Case("stitch review", "damaged", with_text("r/result.json", lambda text: text[:300], command))


def _port_in_use(room: Path) -> list[str]:
    held = socket.socket()
    held.bind(("127.0.0.1", 0))
    held.listen()
    _HELD.append(held)
    return ["review", "r", "--no-browser", "--port", str(held.getsockname()[1])]


_HELD: list[socket.socket] = []


def gone() -> Iterator[Case]:
    """Runs whose session has been moved away."""
    for command in (["explain", "r"], ["plan", "r"], ["diagnose", "r"], ["add", "r", "incidence_bias"], REPORT[:2]):
        yield Case("session moved away", command[0], _moved_away(command))


def _moved_away(command: list[str]) -> Callable[[Path], list[str]]:
    def spoil(room: Path) -> list[str]:
        shutil.move(room / "s", room / "elsewhere")
        return command

    return spoil
