"""Does `stitch explain` find formulas where there are any, and none where there is none?

Usage: python bench/explained_laws.py [--held-out] [--parts A,B] [--scenes A,B] [--fewer N] [--write]

The cells and worlds of bench/unknown_laws.py: couplings of two joints stand in the dictionary of `explain`, most other
laws in a like form or not at all, and those of the parts `foreign`, `further` and `later` were written without a look
at it; nothing hidden and errors with memory must stay without a formula. A formula is good if on views left out it
leaves at most a tenth more than the truth itself would, of one free size. Held-out seeds are run once for each version.
"""

import argparse
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
from scipy.stats import binomtest
from unknown_cells import asked, seen, true_column
from unknown_worlds import PARTS, grown

from data_synth.laws.blind_first import FOREIGN
from data_synth.laws.blind_second import FURTHER
from data_synth.laws.blind_third import LATER
from data_synth.laws.unnamed import UNNAMED
from stitch.numerics.frames import Array
from stitch.observations.linear_model import LinearModel
from stitch.plugins.explain.explain import explain
from stitch.system.threads import library_threads_off

SCENES = ("blade", "drill-plate", "blade-table")
LAWS, _ON_THE_PAGE = ("unnamed", "foreign", "further", "later"), ("nothing", "memory", "unnamed")
_BY_NAME = (*UNNAMED, *FOREIGN, *FURTHER, *LATER)
DEVELOPMENT, HELD_OUT = (0, 1), (840, 841, 842, 843)
_PAGE = Path(__file__).resolve().parents[1] / "docs" / "explain.md"
_MARKS = ("<!-- laws: begin -->", "<!-- laws: end -->")
_NEAR = 1.1  # of the truth's rms on views left out


def share_left(linear: LinearModel, column: Array) -> float:
    """Mean square on views left out, of the present model's, with one column of free size; in the fit that `add` makes,
    under the scatter of `linear`, it is what `explain` says of its formula."""
    trial, present = linear.trial(np.column_stack([linear.design, column])), linear.baseline_trial
    left, before = 0.0, 0.0
    for fold in linear.observation.folds():
        touched = linear.observation.affected_squares(fold)
        left += trial.squares(trial.solve(fold))[touched].sum()
        before += present.squares(present.solve(fold))[touched].sum()
    return left / before


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--held-out", action="store_true")
    parser.add_argument("--parts", default=",".join(_ON_THE_PAGE))
    parser.add_argument("--scenes", default=",".join(SCENES))
    parser.add_argument("--fewer", type=int, default=1)
    parser.add_argument("--size", type=float, default=2.0, help="of the laws, in their usual sizes")
    parser.add_argument("--write", action="store_true", help="put the table into docs/explain.md")
    given = parser.parse_args()
    if given.write and given.parts != ",".join(_ON_THE_PAGE):
        parser.error(f"--write puts {' and '.join(_ON_THE_PAGE)} into the page, and no other parts")
    seeds = HELD_OUT if given.held_out else DEVELOPMENT
    rows: dict[str, list[tuple[bool, bool]]] = defaultdict(list)
    with library_threads_off():
        cells = [asked(name, seed) for name in given.scenes.split(",") for seed in seeds]
        for part in given.parts.split(","):
            make, count = PARTS[part]
            for k in range(count // given.fewer):
                a = cells[k % len(cells)]
                rng = np.random.default_rng([a.cell.seed, k, list(PARTS).index(part), 18])
                world, hidden = make(a, rng, k)
                world = grown(world, given.size)
                linear, begun = seen(a, world, rng), time.process_time()
                found = explain(linear)
                good, truth = False, float("nan")
                if part in LAWS:
                    truth = share_left(linear.restricted(()), true_column(a, world))
                    good = found.found and found.heldout_share <= _NEAR**2 * truth
                name = hidden[0] if part in LAWS else part
                rows[name].append((found.found, good))
                took = time.process_time() - begun
                told = f"left {found.heldout_share:.2f}, by the truth {truth:.2f}"
                print(
                    f"{a.cell.scene} {a.cell.seed} {name}: {found.found} {found.why} {told} ({took:.1f} s)", flush=True
                )
    printed = _table(rows)
    print(printed)
    if given.write:
        text = _PAGE.read_text(encoding="utf-8")
        before, rest = text.split(_MARKS[0])
        _PAGE.write_text(f"{before}{_MARKS[0]}\n{printed}\n{_MARKS[1]}{rest.split(_MARKS[1])[1]}", encoding="utf-8")


def _table(rows: dict[str, list[tuple[bool, bool]]]) -> str:
    """A line per hidden law: how often a formula was found, and how often one as good as the truth."""
    lines = ["| hidden | draws | a formula | as good as the truth |", "|---|---:|---:|---:|"]
    for name in ("nothing", "memory", *_BY_NAME):
        own = rows[name]
        if own:
            said, good = (sum(x) for x in zip(*own, strict=True))
            near = _share(good, len(own)) if name in _BY_NAME else "–"
            lines.append(f"| {name} | {len(own)} | {_share(said, len(own))} | {near} |")
    return "\n".join(lines)


def _share(hits: int, of: int) -> str:
    low, high = binomtest(hits, of).proportion_ci(method="wilson")
    return f"{hits} ({low:.2f}–{high:.2f})"


if __name__ == "__main__":
    main()
