"""A cell over days: false alarms, what is named and when, coverage, time and size; then a real arm over hours.

Run: python bench/watch.py [PART...] with the parts of `PARTS`; writes the tables of docs/watch.md.
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path

from watch_months import months
from watch_real import real
from watch_silence import silence
from watch_size import size

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "watch.md"
PARTS: dict[str, Callable[[], list[str]]] = {"silence": silence, "months": months, "size": size, "real": real}
BEGIN, END = "<!-- tables: begin -->", "<!-- tables: end -->"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", default=list(PARTS))
    parser.add_argument("--cache", type=Path, default=ROOT / "runs" / "watch")
    arguments = parser.parse_args()
    arguments.cache.mkdir(parents=True, exist_ok=True)
    for name in arguments.parts:
        lines = PARTS[name]()
        print("\n".join(lines), flush=True)
        (arguments.cache / f"{name}.json").write_text(json.dumps(lines))
    files = [arguments.cache / f"{name}.json" for name in PARTS]
    tables = ["\n".join(json.loads(file.read_text())) for file in files if file.exists()]
    head, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    text = "\n\n".join([head + BEGIN, *tables, END + rest.partition(END)[2]])
    PAGE.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
