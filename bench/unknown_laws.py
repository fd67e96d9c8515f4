"""Do names hold, and do unknowns stay unknown? Worlds that no model holds, judged blind.

Usage: python bench/unknown_laws.py [--held-out] [--parts nothing,memory,...] [--scenes A,B] [--as-before]
       [--fewer N]

Every cell is simulated and run once; what its views show in other worlds is then drawn: true poses and points of
data_synth's own laws, noise of the normal equations. Sizes of effects are multiples of what an arm that only scatters
would show at the least in that cell. Seeds are of two kinds: those of development, and held-out ones, to be run once
for each version of the diagnosis. --as-before asks as if poses scattered independently from view to
view; --fewer N takes the first N-th of the trials.
"""

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from unknown_cells import Asked, World, asked, seen, with_overlaps_of
from unknown_trials import HEAD, Trial, shares
from unknown_worlds import MULTIPLES, PARTS

from stitch.diagnosis.evidence import gather_evidence
from stitch.diagnosis.score import ScatterLimit
from stitch.diagnosis.thresholds import IMPLAUSIBLE, ODDS
from stitch.diagnosis.unmodelled_time_effects import find_repeating_errors
from stitch.diagnosis.verdict import Evidence
from stitch.observations.linear_model import LinearModel
from stitch.system.threads import library_threads_off

SCENES = ("blade", "drill-plate", "blade-table")
DEVELOPMENT, HELD_OUT = (0, 1), (960, 961, 962, 963)
USUAL = ScatterLimit(*IMPLAUSIBLE)
# Worlds with several effects, asked again after each that is named.
AGAIN, ASKED_AGAIN = ("beside", "two", "three"), 4
MUST_SHOW = ("effect", *AGAIN, *(f"unnamed_{n}x" for n in MULTIPLES), "foreign_3x", "further_3x", "later_3x")
OF_THE_ARM = ("joint_offset", "link_geometry", "gear_eccentricity")


def trials(part: str, cells: Sequence[Asked], as_before: bool = False, fewer: int = 1) -> Iterator[Trial]:
    """All draws of a part that show what is hidden, over the cells in turn.

    Args:
        as_before: as if poses scattered independently.
    """
    make, count = PARTS[part]
    for k in range(count // fewer):
        a = cells[k % len(cells)]
        rng = np.random.default_rng([a.cell.seed, k, list(PARTS).index(part), 17])
        world, hidden = make(a, rng, k)
        if part in MUST_SHOW and not hidden:
            continue  # these views do not show it at any size
        linear, begun = seen(a, world, rng), time.process_time()
        linear = linear.restricted(()) if as_before else linear
        found = gather_evidence(linear, a.candidates, USUAL)
        names = tuple(r.name for r in found.named) + ((found.second.name,) if found.second else ())
        then, group = named_after(a, world, linear, found) if part in AGAIN else ((), ())
        also = () if world.arm is None else OF_THE_ARM
        cell = f"{a.cell.scene} {a.cell.seed}"
        follows = find_repeating_errors(linear) if found.verdict == "unknown_effect" else ()
        words = ", ".join(u.words for u in follows)
        seconds = time.process_time() - begun
        certain = found.log_odds_over_nothing > ODDS
        yield Trial(cell, hidden, found.verdict, also, names, then, group, words, seconds, certain)


def named_after(
    asked: Asked, world: World, linear: LinearModel, found: Evidence
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """What is named next, and next again, when the effect that was named is added, as `stitch add` would; and the
    group that cannot be told apart, if it ends with one."""
    then, candidates = list[str](), asked.candidates
    for _ in range(ASKED_AGAIN):
        if found.verdict != "missing_effect":
            break
        name, form = found.named[0].name, found.named[0].score.form
        world = replace(world, laws=world.laws.without(name))
        linear = with_overlaps_of(asked, world, linear).conditioned_on(form.columns, form.sizes)
        candidates = [c for c in candidates if c.name != name]
        found = gather_evidence(linear, candidates, USUAL)
        then += [found.named[0].name] if found.verdict == "missing_effect" else []
    return tuple(then), tuple(r.name for r in found.named) if found.verdict == "cannot_tell" else ()


def told(part: str, cells: Sequence[Asked], as_before: bool, fewer: int) -> Iterator[Trial]:
    """The trials of a part, printed as they come."""
    for t in trials(part, cells, as_before, fewer):
        print(f"{part}: {t}", flush=True)
        yield t


def main() -> None:
    """Print every trial, and the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--held-out", action="store_true")
    parser.add_argument("--as-before", action="store_true")
    parser.add_argument("--fewer", type=int, default=1)
    parser.add_argument("--parts", default=",".join(PARTS))
    parser.add_argument("--scenes", default=",".join(SCENES))
    options = parser.parse_args()
    seeds = HELD_OUT if options.held_out else DEVELOPMENT
    with library_threads_off():
        cells = [asked(name, seed) for seed in seeds for name in options.scenes.split(",")]
        rows = [
            shares(part, list(told(part, cells, options.as_before, options.fewer))) for part in options.parts.split(",")
        ]
    print("", HEAD, *rows, sep="\n")
    print(f"\n{time.process_time():.0f} s of processor time")


if __name__ == "__main__":
    main()
