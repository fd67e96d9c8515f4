"""Bad inputs of all kinds, and kills: no traceback, no hang, nothing silent, nothing lost.

    python bench/faults.py [--only WORD] [--kills N] [--seed N] [--write]

Prints a line for every case that is not as it should be, then a table by kind; `--write` puts it into docs/limits.md.
"""

import argparse
import os
import re
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from datetime import date
from itertools import chain
from pathlib import Path

from fault_cells import cells, gone
from fault_clouds import cloud_headers, clouds, robots
from fault_code import effects_files, foreign_code
from fault_folders import models, run_folders
from fault_intake import clocks, raw_folders, spreadsheets
from fault_kills import COMMANDS, Kills, kill_at_random
from fault_loads import arms, boxes, loads, sessions_together
from fault_places import command_lines, outputs
from fault_programs import programs
from fault_room import Case, Outcome, judge
from fault_sessions import session_files, tables

from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from data_synth.write import write_session
from stitch.cli.main import main as stitch

_FAULTS = ("traceback", "hang", "silent", "leftovers", "refused though right", "unclear", "not the result alone")
_SOURCES = (
    session_files,
    tables,
    cloud_headers,
    clouds,
    robots,
    models,
    run_folders,
    foreign_code,
    effects_files,
    outputs,
    command_lines,
    spreadsheets,
    clocks,
    raw_folders,
    boxes,
    loads,
    arms,
    sessions_together,
    programs,
    cells,
    gone,
)
_HANG = 10.0  # seconds beyond what a good run takes here
_PAGE = Path(__file__).resolve().parents[1] / "docs" / "limits.md"


def make_material(folder: Path) -> float:
    """Two small cloud sessions s and o, labelled points p, runs r of s, q of o, a of p; seconds of a run in a fork."""
    folder.mkdir()
    # In processes of their own: this one must stay without threads, or its forks would wait for them.
    _forked(lambda: _write_sessions(folder))
    seconds = 0.0
    for line in ("s -o r --effects range_scale", "o -o q", "p -o a --effects gear_eccentricity"):
        arguments = ["run", *line.split()]
        began = time.monotonic()
        _forked(lambda arguments=arguments: (os.chdir(folder), stitch(arguments)))
        seconds = max(seconds, time.monotonic() - began)
    (folder / "r" / "mine.txt").write_text("a person's own")
    return seconds


def _write_sessions(folder: Path) -> None:
    for seed, name in enumerate("so"):
        write_session(folder / name, measured_blade(seed, views=6, pixels=50), name)
    write_labelled(folder / "p", labelled_cell(5, views=16)[0])


def _forked(work: Callable[[], object]) -> None:
    process = os.fork()
    if not process:
        code = 1
        try:
            work()
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
        except BaseException:
            traceback.print_exc()
        os._exit(code)
    if os.waitpid(process, 0)[1]:
        raise SystemExit("the good input of the benchmark fails already")


def cases(only: str) -> Iterator[Case]:
    """All cases whose kind or name holds a word."""
    for case in chain.from_iterable(source() for source in _SOURCES):
        if only in f"{case.kind} {case.name}":
            yield case


def table(outcomes: list[Outcome], kills: list[Kills]) -> str:
    """Faults by kind as a table of Markdown."""
    kinds = list(dict.fromkeys(outcome.case.kind for outcome in outcomes))
    lines = [f"| kind | cases | {' | '.join(_FAULTS)} |", "|---" * (len(_FAULTS) + 2) + "|"]
    for kind in [*kinds, None]:
        own = [outcome for outcome in outcomes if kind in (None, outcome.case.kind)]
        count = Counter(fault for outcome in own for fault in outcome.faults)
        name = f"**all {len(kinds)} kinds**" if kind is None else kind
        lines.append(f"| {name} | {len(own)} | {' | '.join(str(count[fault]) for fault in _FAULTS)} |")
    lines.append("")
    for k in kills:
        whole = k.old + k.new
        told = f"{k.old} times the old run, {k.new} times the new one, {len(k.neither)} times neither"
        lines.append(f"`{k.command}` killed {whole + len(k.neither)} times: {told}.")
    return "\n".join(lines)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--only", default="", help="cases whose kind or name holds this word")
    parser.add_argument("--kills", type=int, default=50, help="in all")
    parser.add_argument("--seed", type=int, default=20261122)
    parser.add_argument("--write", action="store_true", help="put the table into docs/limits.md")
    given = parser.parse_args()
    os.nice(10)
    with tempfile.TemporaryDirectory(prefix="faults-") as name:
        material, rooms = Path(name).resolve() / "material", Path(name).resolve() / "rooms"
        rooms.mkdir()
        usual = make_material(material)
        print(f"a good run takes {usual:.1f} s; a command hangs after {usual + _HANG:.1f} s", flush=True)
        outcomes = []
        for outcome in judge(cases(given.only), material, rooms, usual + _HANG):
            outcomes.append(outcome)
            if outcome.faults:
                said = " ".join(outcome.error.split())[-300:]
                case = f"{outcome.case.kind}: {outcome.case.name!r}"
                ended = f"exit {outcome.code}, {outcome.seconds:.1f} s"
                print(f"{', '.join(outcome.faults)}: {case} ({ended}): {said}", flush=True)
        each = given.kills // len(COMMANDS)
        kills = [kill_at_random(command, each, material, rooms, given.seed) for command in COMMANDS if each]
        for line in chain.from_iterable(k.neither for k in kills):
            print(line)
    printed = table(outcomes, kills)
    print(printed)
    if given.write:
        text = _PAGE.read_text(encoding="utf-8")
        marks = ("<!-- measured begins -->", "<!-- measured ends -->")
        block = (
            f"{marks[0]}\nMeasured on {date.today()} by `bench/faults.py`, seed {given.seed}:\n\n{printed}\n{marks[1]}"
        )
        _PAGE.write_text(re.sub(f"{marks[0]}.*{marks[1]}", lambda _: block, text, flags=re.S), encoding="utf-8")


if __name__ == "__main__":
    main()
