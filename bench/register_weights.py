"""Which weights should register take? Pose errors of 40 simulated cells: the table of docs/register.md.

Usage: python bench/register_weights.py [--held-out] [--cells N] [--keep FILE] [--write]

Ten cells each of four kinds (`register_cells.py`). All weights begin at the same poses, with the same prior, scans and
samples; each is iterated by the register's own loop. Seeds are of two kinds: those of development (100 …), and held-out
ones (900 …), run once. --keep stores every cell as it is done, and goes on from there; --write puts the table into the
page. A pose error is the rms displacement of a view's own points, the motion that all views have in common removed:
no overlap shows it. Intervals: 90 %, cells drawn with replacement within their kind.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from register_cells import KINDS, Cell, cell_of
from weighings import WEIGHINGS

from stitch import frames
from stitch.frames import Array
from stitch.stages.register import register

PAGE = Path(__file__).resolve().parents[1] / "docs" / "register.md"
BEGIN, END = "<!-- weights: begin -->", "<!-- weights: end -->"
DEVELOPMENT, HELD_OUT = 100, 900
PUBLISHED = ("Tukey", "Huber", "GICP", "GICP inside Tukey")
_DRAWS = 4000


def pose_error(cell: Cell, poses: Array) -> float:
    """Rms displacement of the views' usable points by the errors of their poses, µm."""
    truth, scans = cell.T_reference_scanner, cell.capture.scans
    centre = np.mean([frames.transform(T, s.points).mean(axis=0) for T, s in zip(truth, scans, strict=True)], axis=0)
    to_centre = frames.make(np.eye(3), -centre)
    xi = frames.log(to_centre @ poses @ frames.inverse(to_centre @ truth))
    xi -= xi.mean(axis=0)
    squares = []
    for T, scan, x in zip(truth, scans, xi, strict=True):
        arm = frames.transform(T, scan.points[scan.usable]) - centre
        squares.append(np.mean(np.sum((np.cross(x[:3], arm) + x[3:]) ** 2, axis=1)))
    return 1e3 * float(np.sqrt(np.mean(squares)))


def errors_of(kind: str, seed: int) -> dict[str, float]:
    """Pose error of one cell by the weights taken."""
    cell = cell_of(kind, seed)
    out = {"robot and hand-eye alone": pose_error(cell, cell.model_poses)}
    for name, weigh in WEIGHINGS.items():
        found = register(cell.capture, cell.model_poses, cell.scatter, cell.gate, start=cell.start, weigh=weigh)
        out[name] = pose_error(cell, found.poses)
    return out


def collected(first: int, cells: int, keep: Path | None) -> dict[str, list[dict[str, float]]]:
    """Errors of every cell by kind."""
    done = {}
    if keep is not None and keep.is_file():
        rows = map(json.loads, keep.read_text(encoding="utf-8").splitlines())
        done = {(row["kind"], row["seed"]): row["errors"] for row in rows}
    for seed in range(first, first + cells):
        for kind in KINDS:
            if (kind, seed) in done:
                continue
            done[kind, seed] = errors_of(kind, seed)
            if keep is not None:
                with keep.open("a", encoding="utf-8") as file:
                    file.write(json.dumps({"kind": kind, "seed": seed, "errors": done[kind, seed]}) + "\n")
    return {kind: [done[kind, seed] for seed in range(first, first + cells)] for kind in KINDS}


def table(found: dict[str, list[dict[str, float]]]) -> list[str]:
    """Rms over the cells of each kind and over all, and the ratio to the best published weights."""
    names = list(found[next(iter(found))][0])
    squares = {name: np.array([[row[name] ** 2 for row in rows] for rows in found.values()]) for name in names}
    total = {name: float(np.sqrt(s.mean())) for name, s in squares.items()}
    best = min(PUBLISHED, key=total.__getitem__)
    cells = squares[best].shape[1]
    lines = [
        f"Rms pose error in µm, {cells} cells of each kind. Last columns: against {best}, the best published, with "
        "90 % intervals; of all cells together, and the geometric mean of the cells' own ratios.",
        "",
        f"| weights | {' | '.join(found)} | all | all, ratio | cell by cell |",
        "|---|" + "---:|" * (len(found) + 3),
    ]
    draws = np.random.default_rng(0).integers(cells, size=(_DRAWS, len(found), cells))
    kinds = np.arange(len(found))[:, None]
    for name in names:
        own, other = squares[name], squares[best]
        drawn = np.sqrt(own[kinds, draws].mean(axis=(1, 2)) / other[kinds, draws].mean(axis=(1, 2)))
        logs = 0.5 * np.log(own / other)
        each = np.exp(logs[kinds, draws].mean(axis=(1, 2)))
        ratios = (_ratio(total[name] / total[best], drawn), _ratio(float(np.exp(logs.mean())), each))
        numbers = " | ".join(f"{x:.1f}" for x in [*np.sqrt(own.mean(axis=1)), total[name]])
        lines.append(f"| {name} | {numbers} | {' | '.join(ratios if name != best else ('1', '1'))} |")
    return lines


def _ratio(value: float, drawn: Array) -> str:
    low, high = np.quantile(drawn, [0.05, 0.95])
    return f"{value:.2f} ({low:.2f} … {high:.2f})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--held-out", action="store_true")
    parser.add_argument("--cells", type=int, default=10)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    found = collected(HELD_OUT if options.held_out else DEVELOPMENT, options.cells, options.keep)
    lines = table(found)
    print("\n".join(lines))
    if options.write:
        text = PAGE.read_text(encoding="utf-8")
        before, after = text.split(BEGIN)[0], text.split(END)[1]
        PAGE.write_text(f"{before}{BEGIN}\n" + "\n".join(lines) + f"\n{END}{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
