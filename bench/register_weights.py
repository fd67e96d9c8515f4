"""Which method should register take? Pose errors of 40 simulated cells: the first tables of docs/register.md.

Usage: python bench/register_weights.py [--held-out] [--cells N] [--keep FILE] [--write]

Eight cells each of five kinds (`register_cells.py`). All methods begin at the same poses, with the same prior, scans
and samples; each is iterated by the register's own loop. Seeds are of two kinds: those of development (100 …), and
held-out ones (2700 …), run once. --keep stores every cell as it is done, and goes on from there; --write puts the
tables into the page. A pose error is the rms displacement of a view's own points, the motion that all views have in
common removed: no overlap shows it.
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from register_cells import KINDS, STOCK, Cell, cell_of, view_with_stock
from scipy.stats import t as student
from weighings import CLOSED, DPWVM_STYLE, METHODS

from stitch.fusion.register import Method, Registration, normal_equations, register
from stitch.numerics import frames
from stitch.numerics.frames import Array

PAGE = Path(__file__).resolve().parents[1] / "docs" / "register.md"
BEGIN, END = "<!-- weights: begin -->", "<!-- weights: end -->"
DEVELOPMENT, HELD_OUT = 100, 2700
_CASTING = "stock left on a casting"
_DRAWS = 4000
Rows = dict[str, list[dict[str, Any]]]  # by kind, one per cell


def twists_of_error(cell: Cell, poses: Array, centre: Array) -> Array:
    """(V, 6) errors of the poses about a centre, the motion that all views have in common removed."""
    to_centre = frames.make(np.eye(3), -centre)
    xi = frames.log(to_centre @ poses @ frames.inverse(to_centre @ cell.T_reference_scanner))
    return np.asarray(xi - xi.mean(axis=0))


def pose_error(cell: Cell, poses: Array) -> float:
    """Rms displacement of the views' usable points by the errors of their poses, µm."""
    truth, scans = cell.T_reference_scanner, cell.capture.scans
    centre = np.mean([frames.transform(T, s.points).mean(axis=0) for T, s in zip(truth, scans, strict=True)], axis=0)
    squares = []
    for T, scan, x in zip(truth, scans, twists_of_error(cell, poses, centre), strict=True):
        arm = frames.transform(T, scan.points[scan.usable]) - centre
        squares.append(np.mean(np.sum((np.cross(x[:3], arm) + x[3:]) ** 2, axis=1)))
    return 1e3 * float(np.sqrt(np.mean(squares)))


def in_sigmas(cell: Cell, found: Registration, method: Method, view: int) -> list[float]:
    """The six errors of a view's pose over the sigmas that the normal equations state."""
    equations = normal_equations(
        found.overlaps, cell.capture, found.poses, cell.model_poses, scatter=cell.scatter, method=method
    )
    views = len(found.poses)
    own = np.kron(np.eye(views)[view] - 1 / views, np.eye(6))
    sigma = np.sqrt(np.diag(own @ np.linalg.inv(equations.H) @ own.T))
    return list(twists_of_error(cell, found.poses, found.overlaps.gram.centre)[view] / sigma)


def numbers_of(kind: str, seed: int) -> dict[str, Any]:
    """Pose errors of one cell by the method; of a casting also the view with stock in sigmas, and the stock found."""
    cell = cell_of(kind, seed)
    errors = {"robot and hand-eye alone": pose_error(cell, cell.model_poses)}
    casting: dict[str, Any] = {}
    for name, method in METHODS.items():
        found = register(cell.capture, cell.model_poses, cell.scatter, cell.gate, start=cell.start, method=method)
        errors[name] = pose_error(cell, found.poses)
        if kind == _CASTING and name in (CLOSED, DPWVM_STYLE):
            view = view_with_stock(seed)
            casting[name] = in_sigmas(cell, found, method, view)
            casting["stock"] = found.offsets.get(view, float("nan"))
    return {"errors": errors, "casting": casting}


def collected(
    first: int, cells: int, keep: Path | None, numbers: Callable[[str, int], dict[str, Any]] = numbers_of
) -> Rows:
    """Numbers of every cell by kind."""
    done = {}
    if keep is not None and keep.is_file():
        rows = map(json.loads, keep.read_text(encoding="utf-8").splitlines())
        done = {(row["kind"], row["seed"]): row for row in rows}
    for seed in range(first, first + cells):
        for kind in KINDS:
            if (kind, seed) in done:
                continue
            done[kind, seed] = {"kind": kind, "seed": seed} | numbers(kind, seed)
            if keep is not None:
                with keep.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(done[kind, seed]) + "\n")
    return {kind: [done[kind, seed] for seed in range(first, first + cells)] for kind in KINDS}


def table(found: Rows) -> list[str]:
    """Rms over the cells of each kind, and the mean ratio of a cell's error to that of GICP inside Tukey."""
    first = next(iter(found.values()))
    names, cells = list(first[0]["errors"]), len(first)
    errors = {name: np.array([[row["errors"][name] for row in rows] for rows in found.values()]) for name in names}
    lines = [
        f"Rms pose error in µm, {cells} cells of each kind. Last column: the error of a cell over that by {CLOSED}, "
        "geometric mean of all kinds but the casting, with the 95 % interval of cells drawn with replacement.",
        "",
        f"| method | {' | '.join(found)} | cell by cell |",
        "|---|" + "---:|" * (len(found) + 1),
    ]
    others = [i for i, kind in enumerate(found) if kind != _CASTING]
    draws = np.random.default_rng(0).integers(cells, size=(_DRAWS, len(others), cells))
    for name in names:
        logs = np.log(errors[name] / errors[CLOSED])[others]
        low, high = np.exp(np.quantile(logs[np.arange(len(others))[:, None], draws].mean(axis=(1, 2)), [0.025, 0.975]))
        ratio = "1" if name == CLOSED else f"{np.exp(logs.mean()):.3f} ({low:.3f} … {high:.3f})"
        numbers = " | ".join(f"{x:.1f}" for x in np.sqrt((errors[name] ** 2).mean(axis=1)))
        lines.append(f"| {name} | {numbers} | {ratio} |")
    return lines


def paired(found: Rows) -> list[str]:
    """The two methods that `--register` offers, cell against cell."""
    lines = [
        f"{DPWVM_STYLE} less {CLOSED}, pose error in µm: mean of the cells' differences with Student's 95 % interval.",
        "",
        "| kind | difference | 95 % interval | lower in |",
        "|---|---:|---:|---:|",
    ]
    for kind, rows in found.items():
        off = np.array([row["errors"][DPWVM_STYLE] - row["errors"][CLOSED] for row in rows])
        half = student.ppf(0.975, len(off) - 1) * off.std(ddof=1) / np.sqrt(len(off))
        low, high = off.mean() - half, off.mean() + half
        lines.append(f"| {kind} | {off.mean():+.2f} | {low:+.2f} … {high:+.2f} | {(off < 0).sum()} of {len(off)} |")
    return lines


def casting(found: Rows) -> list[str]:
    """Whether the pose of the view with stock lies within its sigmas, and the stock that was found."""
    rows = [row["casting"] for row in found[_CASTING]]
    stock = np.array([row["stock"] for row in rows])
    lines = [
        f"The view with {STOCK} mm of stock: its six pose errors over their stated sigmas; within 1.96 lie 95 % of "
        "normal ones.",
        "",
        "| method | rms of z | largest | within 1.96 |",
        "|---|---:|---:|---:|",
    ]
    for name in (CLOSED, DPWVM_STYLE):
        z = np.abs([row[name] for row in rows])
        lines.append(f"| {name} | {np.sqrt(np.mean(z**2)):.2f} | {z.max():.1f} | {(z < 1.96).sum()} of {z.size} |")
    seen = stock[np.isfinite(stock)]
    off = 1e3 * (seen - STOCK)
    return [
        *lines,
        "",
        f"{DPWVM_STYLE} found the stock in {len(seen)} of {len(stock)} cells, {1e3 * seen.mean():.1f} µm on average, "
        f"rms error {np.sqrt(np.mean(off**2)):.1f} µm.",
    ]


def write(lines: list[str], begin: str, end: str) -> None:
    """Put lines into the page between two marks."""
    text = PAGE.read_text(encoding="utf-8")
    before, after = text.split(begin)[0], text.split(end)[1]
    PAGE.write_text(f"{before}{begin}\n" + "\n".join(lines) + f"\n{end}{after}", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--held-out", action="store_true")
    parser.add_argument("--cells", type=int, default=8)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    found = collected(HELD_OUT if options.held_out else DEVELOPMENT, options.cells, options.keep)
    lines = [*table(found), "", *paired(found), "", *casting(found)]
    print("\n".join(lines))
    if options.write:
        write(lines, BEGIN, END)


if __name__ == "__main__":
    main()
