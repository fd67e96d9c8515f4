"""Is an arm that was kept from another run doubted where it does not hold, and only there?

Run: python bench/arm_doubt.py [--trials N] [--write]; writes the table of docs/points.md. Some ten minutes.

Every trial draws an arm with wrong zeros and gears, and calibrates it on one session; on poses of another session the
same arm is used, another one, or one of which a third has changed since. What is true is asked of 400 further poses
without noise: how far the kept arm, and the nominal one, leave the targets from their place, base and tool fitted.
Of few poses in the first session an arm is known badly, and may be worse than the nominal one without any change.
"""

import argparse
import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.stats import binomtest

from data_synth.fixtures.labelled_arm import labelled_cell
from stitch.api.pipeline import run
from stitch.model.model_toml import ModelFile, keep_arm_effects
from stitch.numerics.frames import Array
from stitch.output.result_document import model_of
from stitch.session.session import SessionData

PAGE = Path(__file__).resolve().parents[1] / "docs" / "points.md"
MARKS = ("<!-- arm doubt: begin -->", "<!-- arm doubt: end -->")
EFFECTS = ("joint_offset", "gear_eccentricity")
FIRST = (9, 14, 60)  # views of the session that calibrates
SECOND, FURTHER = 40, 400
USUAL = 5e-4  # rad, of zeros and gears
BINS = (0.0, 0.5, 0.8, 1.0, 1.25, 2.0, np.inf)


def cell(seed: int, views: int, arm: Array, quiet: bool = False) -> SessionData:
    """Labelled points on an arm (3, 6) of wrong zeros and gears."""
    zeros, sines, cosines = arm

    def gears(joints: Array) -> Array:
        return np.asarray(sines * np.sin(joints) + cosines * np.cos(joints))

    scatter, noise = ((1e-8, 1e-5), 1e-5) if quiet else ((2e-5, 0.02), 0.01)
    return labelled_cell(seed, views, offset=zeros, gears=gears, scatter=scatter, noise=noise)[0]


def trials(seed: int) -> Iterator[tuple[float, bool]]:
    """Rms of the kept arm over that of the nominal one, in truth, and whether it was doubted."""
    rng = np.random.default_rng([seed, 41])
    own, other = USUAL * rng.normal(size=(2, 3, 6))
    kept = keep_arm_effects(model_of(run(cell(3 * seed, int(rng.choice(FIRST)), own), effects=EFFECTS)))
    for used in (own, other, own + 0.33 * other):
        found = run(cell(3 * seed + 1, SECOND, used), arm=kept)
        further = cell(3 * seed + 2, FURTHER, used, quiet=True)
        yield _rms(further, kept) / _rms(further, None), bool(found.doubts)


def _rms(session: SessionData, arm: ModelFile | None) -> float:
    return run(session, arm=arm).residual_rms


def table(found: list[tuple[float, bool]]) -> str:
    """Share of doubts by what is true."""
    lines = [
        "| what the kept arm leaves, of what the nominal one leaves | sessions | doubted | 95 % |",
        "|---|---:|---:|---|",
    ]
    for least, most in pairwise(BINS):
        doubts = [doubted for ratio, doubted in found if least <= ratio < most]
        if doubts:
            low, high = binomtest(sum(doubts), len(doubts)).proportion_ci(method="wilson")
            name = f"{least:g} … {most:g}" if np.isfinite(most) else f"more than {least:g}"
            lines.append(f"| {name} | {len(doubts)} | {np.mean(doubts):.0%} | {low:.2f} … {high:.2f} |")
    return "\n".join(lines)


def main() -> None:
    """Print the table, or write it into the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=150)
    parser.add_argument("--first", type=int, default=400, help="seeds below it were looked at")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.trials)
    told = table([own for seed in seeds for own in trials(seed)])
    print(told)
    if options.write:
        begin, end = MARKS
        page = re.sub(f"{begin}.*{end}", lambda _: f"{begin}\n{told}\n{end}", PAGE.read_text(), flags=re.S)
        PAGE.write_text(page)


if __name__ == "__main__":
    main()
