"""One table of the benchmarks: python bench/run.py TABLE [options].

Seeds are those of the page unless stated; of some tables they are used up (the pages say which): take new ones to judge
a change. `--only WORD[,WORD…]` keeps the jobs that have one of the words among their values, and may be repeated.
"""

import argparse
import importlib
import sys
import textwrap
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])

from bench import harness  # noqa: E402

# By name: the module of bench and the table in it.
TABLES = {
    "axes": "cells:AXES",
    "certificate": "metrology:CERTIFICATES",
    "blind": "blind:TABLE",
    "deciding-view": "next_views:DECIDING",
    "degenerate": "degenerate:TABLE",
    "doors": "degenerate:DOORS",
    "diagnose-time": "speed:DIAGNOSE",
    "drawn-folders": "intake:DRAWN",
    "drilling": "drilling:TABLE",
    "driven": "next_views:DRIVEN",
    "faults": "faults:TABLE",
    "features": "metrology:FEATURES",
    "field-cases": "intake:CASES",
    "field-kinds": "intake:FIELD",
    "large": "speed:LARGE",
    "mistakes": "integrity:MISTAKES",
    "no-mistake": "integrity:GOOD",
    "other-programs": "other_programs:TABLE",
    "outside-cells": "outside_cells:TABLE",
    "panel": "panel:TABLE",
    "peers": "speed:PEERS",
    "results": "results:TABLE",
    "scanners": "cells:SCANNERS",
    "stock": "stock:TABLE",
    "unknown-laws": "unknown_laws:TABLE",
    "watch": "watch:TABLE",
    "window": "window:TABLE",
    "window-bond": "window:BOND",
    "window-line": "window:LINE",
}


def main() -> None:
    """Run the jobs of a table, print its lines, and write them into its page."""
    names = textwrap.fill("tables: " + ", ".join(TABLES), 100, break_on_hyphens=False)
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, epilog=names, formatter_class=raw)
    parser.add_argument("table", choices=TABLES, metavar="TABLE")
    parser.add_argument("--seeds", type=int, nargs=2, metavar=("FIRST", "END"), help="END itself is left out")
    parser.add_argument("--only", action="append", default=[], metavar="WORDS", help="jobs with one of these values")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="a setting of the table")
    parser.add_argument("--rows", type=Path, help="keeps a line for each trial; those that stand there are not run")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--write", action="store_true", help="put the lines into the page")
    asked = parser.parse_args()
    module, _, name = TABLES[asked.table].partition(":")
    table = getattr(importlib.import_module(f"bench.{module}"), name)
    settings = dict(table.settings)
    for text in asked.set:
        key, _, value = text.partition("=")
        if key not in settings:
            parser.error(f"no setting {key!r}; {asked.table} has {', '.join(settings) or 'none'}")
        default = settings[key]
        settings[key] = value == "true" if isinstance(default, bool) else type(default)(value)
    jobs = list(table.jobs(range(*asked.seeds) if asked.seeds else table.seeds, **settings))
    for words in asked.only:
        jobs = [job for job in jobs if {words, *words.split(",")} & _values(job)]
    if not jobs:
        parser.error("no job is left")
    lines = table.summary(harness.run(table, jobs, asked.rows, asked.workers))
    print("", *lines, sep="\n")
    if asked.write and table.page:
        harness.into_page(table.page, table.block, lines)


def _values(job: harness.Row) -> set[str]:
    """What a job has for values, those of its lists too, as words."""
    values = [inner for value in job.values() for inner in (value if isinstance(value, list) else [value])]
    return {str(value) for value in values}


if __name__ == "__main__":
    main()
