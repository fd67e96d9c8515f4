"""What all tables share: trials over workers, kept rows, shares with intervals, Markdown, blocks of pages.

A table names its jobs, runs each as a trial, and makes the lines of a page of all rows. Jobs and rows are plain JSON,
so that rows can be kept in a file and a long table goes on where it was stopped.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from itertools import chain
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from scipy.stats import binomtest

from stitch.system.threads import library_threads_off

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PICTURES = DOCS / "pictures"
# Measured data and cases lie beside the project.
SHARED_DATA = Path(os.environ.get("STITCH_SHARED_DATA") or ROOT.parent / "shared" / "data")
SHARED_CASES = Path(os.environ.get("STITCH_SHARED_CASES") or ROOT.parent / "shared" / "cases")
STITCH = (sys.executable, "-P", "-c", "from stitch.cli.main import main; main()")

Row = dict[str, Any]


@dataclass(frozen=True)
class Table:
    """One benchmark."""

    jobs: Callable[..., Iterable[Row]]  # jobs(seeds, **settings): what names each trial
    trial: Callable[[Row], Row]  # a job: what came of it
    summary: Callable[[list[Row]], list[str]]  # rows, each a job with what came of it: lines of Markdown
    seeds: range  # of the page's table or, where those are named, of development
    page: str = ""  # docs/PAGE.md
    block: str = ""  # the lines stand there between <!-- BLOCK: begin --> and <!-- BLOCK: end -->
    settings: dict[str, Any] = field(default_factory=dict)  # further keywords of `jobs` and their defaults
    one_core: bool = True  # False where the trials measure what all cores do


@dataclass(frozen=True)
class Parts:
    """Trial and summary of a table whose jobs name the part that they belong to."""

    parts: dict[str, tuple[Callable[[Row], Row], Callable[[list[Row]], list[str]]]]  # trial and table of each

    def trial(self, job: Row) -> Row:
        """Run the trial of the job's part."""
        return self.parts[job["part"]][0](job)

    def summary(self, rows: list[Row]) -> list[str]:
        """Return the tables of all parts that have rows."""
        groups = grouped(rows, "part")
        return [line for part in self.parts if part in groups for line in [*self.parts[part][1](groups[part]), ""]]


def run(table: Table, jobs: Sequence[Row], rows: Path | None = None, workers: int = 1) -> list[Row]:
    """Return a row for each job, in their order; those that stand in the file `rows` are not run again."""
    names = [json.dumps(job, sort_keys=True) for job in jobs]
    lines = rows.read_text(encoding="utf-8").splitlines() if rows is not None and rows.exists() else []
    done = {line["trial"]: line["row"] for line in map(json.loads, lines)}
    todo = [job for job, name in zip(jobs, names, strict=True) if name not in done]
    for number, (job, row) in enumerate(_finished(table, todo, workers), 1):
        name = json.dumps(job, sort_keys=True)
        done[name] = row
        print(f"{number} of {len(todo)}: {json.dumps(row, ensure_ascii=False, default=float)[:400]}", flush=True)
        if rows is not None:
            rows.parent.mkdir(parents=True, exist_ok=True)
            with rows.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"trial": name, "row": row}, default=float) + "\n")
    return [done[name] for name in names]


def _finished(table: Table, jobs: Sequence[Row], workers: int) -> Iterator[tuple[Row, Row]]:
    """Jobs and their rows as they come."""
    if workers == 1:
        if table.one_core:
            library_threads_off()
        for job in jobs:
            yield job, _timed(table.trial, job)
        return
    context = get_context("spawn")
    number = context.Value("i", 0)
    with ProcessPoolExecutor(workers, context, initializer=_pin, initargs=(number,)) as pool:
        running = {pool.submit(_timed, table.trial, job): job for job in jobs}
        for future in as_completed(running):
            yield running[future], future.result()


def _timed(trial: Callable[[Row], Row], job: Row) -> Row:
    begun = time.process_time()
    row = trial(job)
    return {**job, **row, "cpu_seconds": round(time.process_time() - begun, 2)}


def _pin(number: Any) -> None:
    """One core a worker: a trial is too small to share out."""
    with number.get_lock():
        number.value += 1
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[number.value % len(cores)]})
    library_threads_off()


def stitch_process(*arguments: object, cores: set[int] | None = None, memory: bool = False) -> dict[str, float]:
    """Run a command of stitch as a process of its own; return its seconds, those of the processor, and its peak in GB.

    Raises:
        RuntimeError: it ends with another code than 0.
    """
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    affinity = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores or affinity)
    begun = time.perf_counter()
    try:
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        process = subprocess.Popen([*STITCH, *map(str, arguments)], env=environment, **quiet)
        _, status, used = os.wait4(process.pid, 0)
    finally:
        os.sched_setaffinity(0, affinity)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"stitch {' '.join(map(str, arguments))} ended with {process.returncode}")
    seconds = time.perf_counter() - begun
    return {"seconds": seconds, "cpu": used.ru_utime + used.ru_stime, "memory": used.ru_maxrss / 1e6}


def share(flags: Iterable[object]) -> str:
    """Return k/n of what is true with its 95 % Wilson interval."""
    hits = [bool(flag) for flag in flags]
    if not hits:
        return "–"
    low, high = binomtest(sum(hits), len(hits)).proportion_ci(method="wilson")
    return f"{sum(hits)}/{len(hits)} [{low:.2f}, {high:.2f}]"


def named_shares(rows: Sequence[Row]) -> tuple[str, str, str]:
    """Return how often rows name their `true` effect alone, among others, and others without it."""
    right = share(row["effects"] == [row["true"]] for row in rows)
    group = share(row["true"] in row["effects"] and len(row["effects"]) > 1 for row in rows)
    return right, group, share(bool(row["effects"]) and row["true"] not in row["effects"] for row in rows)


def markdown(head: str, rows: Iterable[Iterable[object]]) -> list[str]:
    """Return a table whose heads stand in one text between bars; columns of numbers stand to the right."""
    cells = [[str(cell) for cell in row] for row in rows]
    marks = ["---:" if _numbers(column) else "---" for column in zip(*cells, strict=True)]
    bar = "|" + "|".join(marks or ["---"] * (head.count("|") + 1)) + "|"
    return [f"| {head} |", bar, *(f"| {' | '.join(row)} |" for row in cells)]


def _numbers(column: Sequence[str]) -> bool:
    """Whether every cell that is filled begins with a number."""
    filled = [cell for cell in column if cell not in ("", "–")]
    return bool(filled) and all(cell.lstrip("+-≤±")[:1].isdigit() for cell in filled)


def grouped(rows: Iterable[Row], *keys: str) -> dict[Any, list[Row]]:
    """Return the rows by what they have under one key, or under several as a tuple, in the order of appearance."""
    groups: dict[Any, list[Row]] = {}
    for row in rows:
        name = tuple(row[key] for key in keys)
        groups.setdefault(name if len(keys) > 1 else name[0], []).append(row)
    return groups


def with_all(groups: dict[Any, list[Row]], name: str = "all") -> dict[Any, list[Row]]:
    """Return the groups with all their rows as one group more."""
    return {**groups, name: list(chain.from_iterable(groups.values()))}


def into_page(page: str, block: str, lines: Iterable[str]) -> None:
    """Put lines between the marks of a block of docs/PAGE.md.

    Raises:
        ValueError: the page has no such marks.
    """
    path = DOCS / f"{page}.md"
    text = path.read_text(encoding="utf-8")
    begin, end = f"<!-- {block}: begin -->", f"<!-- {block}: end -->"
    if begin not in text or end not in text:
        raise ValueError(f"{path}: no block {block}; put {begin} and {end} where the table shall stand")
    before, after = text.split(begin)[0], text.split(end)[1]
    path.write_text("\n".join([before + begin, "", *lines, "", end]) + after, encoding="utf-8")
