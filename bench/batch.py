"""Many sessions: two workers against one, what a session costs, what the scheduler holds of a day of a plant; imports.

Run: python bench/batch.py [PART...] with the parts of `PARTS`; writes the tables of docs/scale.md.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

from batch_cost import cost
from batch_scheduler import scheduler
from batch_speed import speed
from batch_start import start

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "scale.md"
PARTS: dict[str, Callable[[], list[str]]] = {"speed": speed, "cost": cost, "scheduler": scheduler, "start": start}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", default=list(PARTS))
    for name in parser.parse_args().parts:
        lines = PARTS[name]()
        print("\n".join(lines), flush=True)
        into_page(name, lines)


def into_page(name: str, lines: list[str], page: Path = PAGE) -> None:
    """Put a table between its marks."""
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    head, _, rest = page.read_text(encoding="utf-8").partition(begin)
    tail = rest.partition(end)[2]
    page.write_text("\n".join([head + begin, "", *lines, "", end]) + tail, encoding="utf-8")


if __name__ == "__main__":
    main()
