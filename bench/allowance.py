"""Stock on a casting beside its pose: do value and sigma hold? The table of docs/window.md.

Usage: python bench/allowance.py [--seeds N]

A blade grown facet by facet (`casting.py` of data_synth), scanned from eight sides all around, noise 20 µm; the start
is off by 4 mrad and 0.6 mm per axis. Seeds 200 … took no part in development. Intervals of shares: 95 %, Wilson's.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import binomtest

from data_synth.cells import window_scans
from data_synth.scanning import scan
from data_synth.shapes import build_shape
from data_synth.shapes.casting import around, with_stock
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.plugins.cells.cad import CadSurface, cad_surface
from stitch.plugins.cells.placed_scans import JoinedScans, join_scans
from stitch.plugins.cells.scan_to_cad import AllowancePrior, CadFit, fit_cad
from stitch.session.scan import prepare_scan

PAGE = Path(__file__).resolve().parents[1] / "docs" / "window.md"
BEGIN, END = "<!-- allowance: begin -->", "<!-- allowance: end -->"
FIRST = 200
_NORMAL = 1.96  # 95 % of a normal number
FREE, VARYING = AllowancePrior(free=True), AllowancePrior(free=True, varying=True)


def even(points: Array) -> Array:
    return np.full(len(points), 0.3)


def wave(points: Array) -> Array:
    """0.22 to 0.38 along the span, and a slope along the chord: no polynomial."""
    return 0.3 + 0.08 * np.sin(points[:, 2] / 80) + 0.04 * points[:, 0] / 40


CASES: tuple[tuple[str, Callable[[Array], Array], float, AllowancePrior], ...] = (
    ("even 0.3, asked for even", even, 0.0, FREE),
    ("the same, asked for varying", even, 0.0, VARYING),
    ("the same with flash, asked for even", even, 0.125, FREE),
    ("0.2 to 0.4, a wave, asked for varying", wave, 0.0, VARYING),
)


def casting(mesh, stock: Callable[[Array], Array], flash: float, seed: int) -> tuple[JoinedScans, Array, Array]:
    """Scans in the base, true T_base_part, a start; a share `flash` of the points stands 0.02 to 0.2 further out."""
    rng = np.random.default_rng([seed, 5])
    T = frames.make(Rotation.random(rng=rng).as_matrix(), np.array([1200.0, -300.0, 800.0]))
    tool = window_scans.area_scanner(110, 34.0, 420.0, depth=300.0, noise=0.02)
    poses, grown = around(mesh, 8, 420.0, rng), with_stock(mesh, stock)
    clouds = [scan(grown, pose, tool, window_scans.NO_FIELD, rng).points for pose in poses]
    off = frames.exp(rng.normal(size=6) * np.repeat([4e-3, 0.6], 3))
    centre = frames.make(np.eye(3), mesh.bounds.mean(axis=0))
    seen = join_scans([prepare_scan("", c) for c in clouds], T @ poses)
    out = np.where(rng.random(len(seen.points)) < flash, rng.uniform(0.02, 0.2, len(seen.points)), 0.0)
    seen.points[:] += out[:, None] * seen.normals
    return seen, T, T @ centre @ off @ frames.inverse(centre)


def numbers_of(seen: JoinedScans, T: Array, found: CadFit, cad: CadSurface, stock: Callable[[Array], Array]) -> Array:
    """Error of the mean and of the field (rms), stated sigma of the mean, and z of the mean and of the pose's six."""
    assert found.allowance is not None
    places = frames.transform(frames.inverse(T), seen.points[seen.usable])
    off = found.allowance.at(places) - stock(places)
    centre = frames.make(np.eye(3), cad.centre)
    pose = frames.log(frames.inverse(T @ centre) @ found.T_base_part @ centre) / found.sigma
    mean, sigma = off.mean(), found.allowance.sigma
    return np.array([mean, np.sqrt(np.mean(off**2)), sigma, mean / sigma, *pose])


def row(name: str, rows: Array) -> str:
    """One line of the table; lengths in µm."""

    def inside(z: Array) -> str:
        within = binomtest(int((np.abs(z) < _NORMAL).sum()), z.size)
        low, high = within.proportion_ci(method="wilson")
        return f"{within.statistic:.2f} ({low:.2f} … {high:.2f})"

    mean, field, sigma = rows[:, 0] * 1e3, rows[:, 1] * 1e3, rows[:, 2] * 1e3
    sizes = (np.sqrt(np.mean(mean**2)), np.abs(mean).max(), sigma.mean(), np.sqrt(np.mean(field**2)))
    cells = (*(f"{x:.2f}" for x in sizes), inside(rows[:, 3]), inside(rows[:, 4:]))
    return f"| {name} | {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    seeds = parser.parse_args().seeds
    mesh = build_shape("blade")
    cad = cad_surface(mesh)
    lines = [
        f"{seeds} blades each, µm; shares within 1.96 σ with 95 % intervals (of the pose: six numbers a blade).",
        "",
        "| stock / mm | mean: error, rms | largest | σ stated | at its place: error, rms | mean within | pose within |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for name, stock, flash, wanted in CASES:
        rows = []
        for seed in range(FIRST, FIRST + seeds):
            seen, T, start = casting(mesh, stock, flash, seed)
            rows.append(numbers_of(seen, T, fit_cad(seen, cad, start, prior=wanted), cad, stock))
        lines.append(row(name, np.array(rows)))
        print(lines[-1], flush=True)
        write(lines)


def write(lines: list[str]) -> None:
    """Put the table into the page."""
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(
        text.split(BEGIN)[0] + BEGIN + "\n" + "\n".join(lines) + "\n" + END + text.split(END)[1], encoding="utf-8"
    )


if __name__ == "__main__":
    main()
