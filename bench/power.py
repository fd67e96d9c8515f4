"""Do effects of the smallest detectable size show in eight cells of ten? Noise drawn in the channel itself.

Usage: python bench/power.py [--scenes blade,drill-plate] [--draws N] [--multiple M]

The blind benchmark simulates every scan and has few cells for each effect. Here one cell with nothing hidden is
simulated; what its views saw is drawn anew from their covariance, with each effect added at a multiple of its
smallest detectable size, and diagnosed. That judges the statistics alone; some 3 minutes a scene.
"""

import argparse
from dataclasses import replace

import numpy as np
from blind_cells import drawn, smallest
from blind_trials import LIBRARY, cell_without, pin

from stitch.diagnosis.candidates import Candidate, candidates_of
from stitch.diagnosis.conclusion import concluded
from stitch.diagnosis.plausible_scatter import ScatterLimit
from stitch.diagnosis.thresholds import IMPLAUSIBLE
from stitch.frames import Array
from stitch.observations.linear_model import LinearModel
from stitch.statistics.variance_components import fit_variances


def verdict(linear: LinearModel, candidates: list[Candidate]) -> str:
    """As `diagnose` judges, less what it says about it."""
    return concluded(linear, candidates, ScatterLimit(*IMPLAUSIBLE)).verdict


def redrawn(linear: LinearModel, shift: Array, rng: np.random.Generator) -> LinearModel:
    """The same views with other noise and a shift (n,) of what they see."""
    half = np.linalg.cholesky(linear.covariance[0])
    mixed = replace(linear.mixed, z=(half @ rng.standard_normal(len(half)) + shift)[None])
    return replace(linear, mixed=mixed, null=fit_variances(mixed, both_starts=True))


def shift_of(linear: LinearModel, candidate: Candidate, true: dict[str, float]) -> Array:
    """(n,) what true parameters do to what the views see."""
    values = np.array([true.get(p.name, 0.0) for p in candidate.parameters])
    fitted = np.array([not p.grid for p in candidate.parameters])
    whole = [form for form in candidate.forms if form.keep.sum() == fitted.sum()]
    nearest = min(whole, key=lambda form: np.abs(form.term.values - values)[~fitted].sum())
    return np.asarray(nearest.columns @ values[nearest.keep])


def main() -> None:
    """Print the share of draws in which something is said to be missing, effect by effect."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", default="blade,drill-plate")
    parser.add_argument("--draws", type=int, default=12)
    parser.add_argument("--multiple", type=float, default=1.0)
    options = parser.parse_args()
    pin(0)
    shares = []
    for scene in options.scenes.split(","):
        cell = cell_without(scene, 0)
        candidates, rng = candidates_of(cell.linear)[0], np.random.default_rng(1)
        true = drawn(scene, cell.plan, cell.linear.measurement, LIBRARY, 0)
        for candidate in candidates:
            size = smallest(cell.linear, candidate.name, true[candidate.name]) if candidate.name in true else None
            if size is None:
                continue
            shift = options.multiple * size * shift_of(cell.linear, candidate, true[candidate.name])
            drawn_again = (redrawn(cell.linear, shift, rng) for _ in range(options.draws))
            shares.append(np.mean([verdict(e, candidates) != "adequate" for e in drawn_again]))
            print(f"{scene:12} {candidate.name:24} {shares[-1]:.2f}", flush=True)
        empty = [verdict(redrawn(cell.linear, np.zeros(1), rng), candidates) for _ in range(10 * options.draws)]
        print(f"{scene:12} {'nothing':24} {np.mean([v != 'adequate' for v in empty]):.3f}", flush=True)
    print(f"mean over {len(shares)} effects: {np.mean(shares):.3f}")


if __name__ == "__main__":
    main()
