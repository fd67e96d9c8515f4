"""The rows of bench/integrity.py as tables: python bench/integrity_table.py good.jsonl kinds.jsonl …"""

import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

Row = dict[str, Any]
# Too small a mistake for these cells to tell: nothing may be said of it.
_BELOW = ("shift 0.2 mm",)


def cases(rows: Sequence[Row], key: Callable[[Row], str] = lambda r: str(r["case"])) -> dict[str, list[Row]]:
    """The rows of each case; a row that was written twice counts once."""
    once = {(r["part"], r["mount"], r["seed"], r["case"]): r for r in rows}
    out: dict[str, list[Row]] = {}
    for row in once.values():
        out.setdefault(key(row), []).append(row)
    return out


def good(rows: Sequence[Row]) -> None:
    """Sessions without a mistake."""
    print("| sessions without a mistake | sessions | a test leaves out | a run leaves out | a view suspected |")
    print("|---|---|---|---|---|")
    found = cases(rows, lambda r: str(r["case"]).removeprefix("good ") or "nothing hidden")
    every = [r for rows_of_case in found.values() for r in rows_of_case]
    for case, own in [*sorted(found.items()), ("all", every)]:
        counts = (sum(bool(r[what]) for r in own) for what in ("tested_out", "left_out", "suspected"))
        print(f"| {case.strip() or 'nothing hidden'} | {len(own)} | {' | '.join(map(str, counts))} |")


def kinds(rows: Sequence[Row]) -> None:
    """Every kind of mistake."""
    print("| mistake | cells | silent | culprit among those named | kind of mistake named |\n|---|---|---|---|---|")
    found = {case: own for case, own in cases(rows).items() if case != "nothing"}
    every = [r for case, rows_of_case in found.items() if case not in _BELOW for r in rows_of_case]
    for case, own in [*found.items(), ("all but those too small to be told", every)]:
        counts = (sum(bool(r[what]) for r in own) for what in ("silent", "culprit", "named"))
        print(f"| {case} | {len(own)} | {' | '.join(map(str, counts))} |")


def many(rows: Sequence[Row]) -> None:
    """A third of the views and more."""
    print(
        "| wrong views | sessions | refused | all of them left out | some fused, said so | silent | right ones lost |"
    )
    print("|---|---|---|---|---|---|---|")
    for case, own in cases(rows, lambda r: str(r["case"]).split(" ", 3)[3]).items():
        mixed = [r for r in own if r.get("mixed")]
        refused, silent = (
            sum(bool(x) for x in own_) for own_ in ((r["ended"] == "refused" for r in own), (r["silent"] for r in own))
        )
        clean, lost = len(own) - refused - len(mixed), sum(r.get("lost", 0) for r in own if not r.get("mixed"))
        print(f"| {case} | {len(own)} | {refused} | {clean} | {len(mixed) - silent} | {silent} | {lost} |")


def real(rows: Sequence[Row]) -> None:
    """Measured scans with mistakes."""
    print("| mistake in measured scans | objects | refused | ran without those views | ran | named |")
    print("|---|---|---|---|---|---|")
    for case, own in cases(rows).items():
        refused = sum(r["ended"].startswith("refused") for r in own)
        clean = sum(r["ended"].endswith("left out none") for r in own)
        counts = (len(own), refused, len(own) - refused - clean, clean, sum(r["named"] for r in own))
        print(f"| {case} | {' | '.join(map(str, counts))} |")


if __name__ == "__main__":
    for file in map(Path, sys.argv[1:]):
        {"good": good, "kinds": kinds, "many": many, "real": real}[file.stem](
            [json.loads(line) for line in file.read_text().splitlines()]
        )
        print()
