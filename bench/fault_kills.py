"""`run` and `add` killed at random moments: the folder holds the old run or the new one, whole, and works on."""

import json
import os
import random
import shutil
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from fault_room import snapshot

from stitch.cli.main import main

COMMANDS = {
    "run": ["run", "o", "-o", "r", "--force", "--no-recording"],
    "add": ["add", "r", "incidence_bias", "--no-recording"],
}
_TRIED_AGAIN = 5  # after every so many kills the command runs once more, to its end
# What differs from run to run although the numbers are the same.
_VARIES = {"result.json", "report.html", "recording.rrd", "diagnosis.rrd"}


@dataclass(frozen=True)
class Kills:
    """Of so many kills of a command, how many left the old run, the new one, or something else."""

    command: str
    old: int
    new: int
    neither: list[str]


def kill_at_random(command: str, times: int, material: Path, rooms: Path, seed: int) -> Kills:
    """Kill a command at moments spread evenly from its start to a little after its usual end."""
    rng = random.Random(seed)
    room = rooms / f"kill-{command}"
    usual, new = _whole(COMMANDS[command], material, room)
    old_count = new_count = 0
    neither = []
    for i in range(times):
        after = rng.uniform(0, 1.1 * usual)
        state = _killed(COMMANDS[command], material, room, lambda after=after: time.sleep(after))
        before = _contents(material / "r")
        if state == before:
            old_count += 1
        elif state == new:
            new_count += 1
        else:
            neither.append(f"{command} {i}, after {after:.2f} s of {usual:.2f}")
        if i % _TRIED_AGAIN == 0 and not _works_on(command, room):
            neither.append(f"{command} {i}: the next command fails or leaves something")
    return Kills(command, old_count, new_count, neither)


def _whole(command: list[str], material: Path, room: Path) -> tuple[float, dict[str, str]]:
    """Seconds of the command, and what it leaves."""
    _fresh(material, room)
    began = time.monotonic()
    os.waitpid(_start(command, room), 0)
    return time.monotonic() - began, _contents(room / "r")


def _killed(command: list[str], material: Path, room: Path, wait: Callable[[], None]) -> dict[str, str]:
    _fresh(material, room)
    process = _start(command, room)
    wait()
    os.kill(process, signal.SIGKILL)
    os.waitpid(process, 0)
    return _contents(room / "r")


def _works_on(command: str, room: Path) -> bool:
    """The same command again ends well, or says that it has been done; nothing of the first one stays."""
    _, status = os.waitpid(_start(COMMANDS[command], room), 0)
    code = os.waitstatus_to_exitcode(status)
    done = json.loads((room / "r" / "ledger.json").read_text())[-1]["effects"][-1:] == ["incidence_bias"]
    clean = not [path for path in room.iterdir() if path.name.startswith(".")]
    return clean and (code == 0 or (command == "add" and done)) and (room / "r" / "mine.txt").is_file()


def _fresh(material: Path, room: Path) -> None:
    shutil.rmtree(room, ignore_errors=True)
    shutil.copytree(material, room, symlinks=True)
    for name in "rq":
        file = room / name / "result.json"
        file.write_text(file.read_text().replace(str(material), str(room)))


def _start(command: list[str], room: Path) -> int:
    process = os.fork()
    if process:
        return process
    os.chdir(room)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
    try:
        main(command)
    except SystemExit as end:
        os._exit(end.code if isinstance(end.code, int) else 1)
    os._exit(0)


def _contents(run: Path) -> dict[str, str]:
    """A run folder: its files by digest; of files that hold times, that they are whole, and the numbers in them."""
    found = snapshot(run)
    for name in _VARIES & set(found):
        data = (run / name).read_bytes()
        found[name] = f"{len(data) > 1000}"
        if name == "result.json":
            document = json.loads(data)
            found[name] = json.dumps([document["hand_eye"], document["effects"], Path(document["session"]).name])
    return found
