"""Is the largest source of a budget the one that is largest? A table of docs/measure.md.

Run: python -m bench.feature_shares

Ten cells (`feature_coverage.py`) in which one thing is far larger than all others.
"""

from pathlib import Path

import numpy as np

from bench.feature_coverage import Sizes, measured_cell
from stitch.plugins.metrology.error_sources import ARM, SCANNER, SCATTER, WANDERING

PAGE = Path(__file__).resolve().parents[1] / "docs" / "measure.md"
BEGIN, END = "<!-- shares: begin -->", "<!-- shares: end -->"
# What is large, the cell that has it, the feature that shows it, and how many cells.
BUILT = (
    (SCATTER, "clean", Sizes(repeatability=(150e-6, 0.1)), "point", 3),
    (ARM, "ordinary arm", Sizes(arm=1.0), "point", 3),
    (WANDERING, "clean", Sizes(drift=6.0), "point", 2),
    (SCANNER, "smooth scanner errors", Sizes(field=0.03), "distance", 2),
)


def main(first_seed: int = 820) -> None:
    lines = ["| large | cells | largest source of U | its share of the variance |", "|---|---|---|---|"]
    seed = first_seed
    for source, kind, sizes, feature, count in BUILT:
        named, shares = list[str](), list[float]()
        for _ in range(count):
            found, _, _ = measured_cell(kind, seed, sizes)
            numbers = [n for n in found.numbers if n.feature.kind == feature]
            mean = {name: np.mean([n.shares[name] for n in numbers]) for name in numbers[0].shares}
            named.append(max(mean, key=lambda name: mean[name]))
            shares.append(100 * mean[named[-1]])
            seed += 1
        told = ", ".join(f"{name} ({named.count(name)})" for name in dict.fromkeys(named))
        lines.append(f"| {source} | {count} | {told} | {min(shares):.0f} to {max(shares):.0f} % |")
        print(lines[-1], flush=True)
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(page.split(BEGIN)[0] + BEGIN + "\n" + "\n".join(lines) + "\n" + END + page.split(END)[1])


if __name__ == "__main__":
    main()
