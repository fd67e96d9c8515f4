"""What `stitch check --deep` and data snooping find in sessions with one mistake, and in sessions without any.

Usage: python bench/integrity.py good|scattering|kinds|many|real FILE [--seeds 0 5] [--minutes 30] [--every 6]

`scattering` runs sessions in which every joint errs anew in every view. `many` runs sessions in which a third of the
views and more are wrong. `real` puts mistakes into measured scans (folder in STITCH_SHARED_DATA), and runs them too.

Rows are appended to FILE (a JSON line each) as they come; what stands there already is not computed again.
Seeds 0 to 99 were used while the code was written, 1000 and above are run once.
"""

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any

from integrity_cells import MOUNTS, PARTS, good, kinds, scattering
from integrity_many import many
from integrity_real import real

from stitch.system.threads import library_threads_off


def append(file: Path, row: dict[str, Any]) -> None:
    """One line more."""
    with file.open("a") as out:
        out.write(json.dumps(row, default=float) + "\n")


def main() -> None:
    """Run one part of the bench."""
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=("good", "scattering", "kinds", "many", "real"))
    parser.add_argument("file", type=Path)
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 1))
    parser.add_argument("--minutes", type=float, default=30)
    parser.add_argument(
        "--every", type=int, default=1, help="of the mistakes, every n-th in a cell, another in the next"
    )
    given = parser.parse_args()
    library_threads_off()
    end = time.monotonic() + 60 * given.minutes
    rows = [json.loads(line) for line in given.file.read_text().splitlines()] if given.file.exists() else []
    done = {(r["part"], r["mount"], r["seed"], r["case"]) for r in rows}
    if given.what == "real":
        folder = Path(os.environ["STITCH_SHARED_DATA"]) / "reghec"
        for row in real(folder, {(part, case) for part, _, _, case in done}):
            append(given.file, row)
        return
    cells = [(p, m, s) for s in range(*given.seeds) for p in PARTS for m in MOUNTS]
    for number, (part, mount, seed) in enumerate(cells):
        cases = {case for p, m, s, case in done if (p, m, s) == (part, mount, seed)}
        if given.what != "kinds" and cases:
            continue
        found = (
            kinds(part, mount, seed, cases, (number, given.every))
            if given.what == "kinds"
            else {"good": good, "scattering": scattering, "many": many}[given.what](part, mount, seed)
        )
        for row in found:
            append(given.file, {"part": part, "mount": mount, "seed": seed} | row)
            if time.monotonic() > end:
                return


if __name__ == "__main__":
    main()
