"""Does the hand-eye's sigma hold on arms that are a little wrong everywhere? χ² of the hand-eye against the truth.

Usage: python bench/ordinary_arms.py [--draws N] [--held-out] [--scenes A,B] [--alone]

Cells are simulated and run once each; what their views show under other errors of the poses is then drawn in the
pose channel: true poses of data_synth's own kinematics, noise of the normal equations. Each cell counts with its mean
over draws. χ²/6 is 1 on the average where sigmas are right; medians are put over the median of χ²(6)/6, 0.891.
--alone fits as if poses scattered independently. Seeds are of two kinds: those of development, and held-out ones, to be
run once for each version of the statistics. Used up: 700 and 701 (one size for quick and slow wandering, sizes by a
chain that follows the slope), 710 to 712 (sizes drawn in turn, one slow wandering), 720 to 725 (each size by itself),
726 to 737 (one factor on all sizes of an arm).
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from blind_trials import pin
from ordinary_cells import SCANS_A_STOP, Cell, cell_of, erring, seen

from stitch.model.model import Model
from stitch.numerics import frames
from stitch.observations.pose_errors import prior_pose_errors
from stitch.observations.surfaces.hand_eye_fit import fit_hand_eye

SCENES = ("blade", "drill-plate", "blade-table")
DEVELOPMENT, HELD_OUT = (0, 1), (750, 751, 752, 753)
KINDS = (
    *(("clean", 0.0), ("ordinary arm", 0.1), ("ordinary arm", 0.3), ("ordinary arm", 1.0), ("ordinary arm", 2.0)),
    *(("memory", 0.5), ("memory", 0.9), ("stops", 1.0), ("coupling", 1.5e-4), ("coupling", 6e-4)),
    *(("joints scatter", 1.5e-5), ("joints scatter", 6e-5)),
)
_MEDIAN = 0.891  # of χ²(6)/6
_NORMAL = 1.96  # 95 % of a normal number


@dataclass
class Tally:
    """What came of one kind of arm."""

    chi_squares: list[float] = field(default_factory=list)  # over 6
    inside: list[float] = field(default_factory=list)  # share of the six numbers within their 95 %
    cells: dict[str, list[float]] = field(default_factory=dict)

    def add(self, cell: Cell, xi: np.ndarray, covariance: np.ndarray) -> None:
        """One fit: the error of the hand-eye and its covariance."""
        self.chi_squares.append(float(xi @ np.linalg.solve(covariance, xi)) / 6)
        self.inside.append(float(np.mean(np.abs(xi) < _NORMAL * np.sqrt(np.diag(covariance)))))
        self.cells.setdefault(f"{cell.scene} {cell.seed}", []).append(self.chi_squares[-1])

    def line(self, kind: str, size: float) -> str:
        """A row of the table."""
        means = [float(np.mean(own)) for own in self.cells.values()]
        return (
            f"| {kind} {size:g} | {len(self.chi_squares)} | {np.mean(self.chi_squares):.2f} "
            f"| {np.median(self.chi_squares) / _MEDIAN:.2f} | {np.mean(self.inside):.3f} "
            f"| {min(means):.2f} … {max(means):.2f} |"
        )


def trials(cell: Cell, kind: str, size: float, draws: int, alone: bool) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Errors of the hand-eye (6,) and their covariances, one a draw."""
    measurement, T = cell.measurement, cell.T_mount
    centre = cell.freed.overlaps.gram.centre
    errors = None if alone else prior_pose_errors([measurement], Model(T), [centre])
    for draw in range(draws):
        rng = np.random.default_rng([cell.seed, draw, round(size * 1e6), len(kind)])
        freed = seen(cell, erring(cell, kind, size, rng), rng)
        found = fit_hand_eye([measurement.capture], [freed], T, errors=errors)
        yield frames.log(frames.inverse(found.T_mount) @ T), found.covariance


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=10)
    parser.add_argument("--held-out", action="store_true")
    parser.add_argument("--alone", action="store_true")
    parser.add_argument("--scenes", default=",".join(SCENES))
    options = parser.parse_args()
    pin(0)
    seeds = HELD_OUT if options.held_out else DEVELOPMENT
    built: dict[tuple[str, int, int], Cell] = {}
    begun = time.process_time()
    print("| arm | fits | mean χ²/6 | median | inside 95 % | cells |\n|---|---:|---:|---:|---:|---|", flush=True)
    for kind, size in KINDS:
        tally, scans = Tally(), SCANS_A_STOP if kind == "stops" else 1
        for scene in options.scenes.split(","):
            for seed in seeds:
                key = (scene, seed, scans)
                cell = built[key] = built.get(key) or cell_of(*key)
                for xi, covariance in trials(cell, kind, size, options.draws, options.alone):
                    tally.add(cell, xi, covariance)
        print(tally.line(kind, size), flush=True)
    print(f"\n{time.process_time() - begun:.0f} s of processor time")


if __name__ == "__main__":
    main()
