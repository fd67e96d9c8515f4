"""Labelled points of many poses and laws of no library: how often does something get a name that is not its own?

Usage: python bench/points_names.py [--views N] [--size S] [--seeds FIRST LAST] [--write]

An arm with four reflectors before a tracker; every law of data_synth's unnamed ones, poses with memory, joints that
scatter, nothing, and effects of the library, each alone and beside an unnamed law of the same size: of these alone one
name is right.
--size is in units of the laws' own sizes, 0.15 mrad of a joint or 0.05 mm. --write puts the table into docs/points.md.
"""

import argparse
import re
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from blind_trials import pin
from scipy.stats import binomtest

from data_synth.arms import ARMS
from data_synth.fixtures.labelled_arm import joints_of, labelled_cell
from data_synth.laws.unnamed import UNNAMED
from data_synth.moment import Plan
from data_synth.ordinary_arm import with_memory
from stitch.diagnosis.candidates import candidates_of
from stitch.diagnosis.evidence import gather_evidence
from stitch.diagnosis.score import scatter_limit
from stitch.diagnosis.verdict import Evidence
from stitch.model.model import Model
from stitch.numerics.frames import Array
from stitch.observations.targets.target_model import target_model
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of

PAGE = Path(__file__).resolve().parents[1] / "docs" / "points.md"
MARKS = ("<!-- names: begin -->", "<!-- names: end -->")
NOTHING, MEMORY, SCATTER = "nothing hidden", "memory", "joints that scatter"
# What is hidden by name, none of it by the library's code: offset of one joint, of all, gravity, a gear that runs out.
LIBRARY = {"one offset": "joint_offset", "offsets": "joint_offset", "gravity": "joint_compliance"}
LIBRARY |= {"eccentric gear": "gear_eccentricity"}
BESIDE = " beside dress_pack"
# These cells are given no torques, without which no spring stiffens.
OUTSIDE = tuple(law for law in UNNAMED if law != "stiffening")
KINDS = (NOTHING, MEMORY, *OUTSIDE, *LIBRARY, *(kind + BESIDE for kind in LIBRARY), SCATTER)
# What a joint is off by, rad; gravity turns joint 2 by so much at a metre's reach.
_SIZE = 1.5e-4
_SCATTER = 2e-5  # of every joint from view to view, rad


def errors_of(kind: str, size: float, joints: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Errors of the joints (V, n) and of the flange (V, 6); memory is AR(1), 0.9, of 40 µm and 40 µrad."""
    off, moved = np.zeros_like(joints), np.zeros((len(joints), 6))
    if kind == MEMORY:
        moved = with_memory(len(joints), 0.9, rng) * np.repeat([40e-6, 0.04], 3) * size
    elif kind == SCATTER:
        off = _SCATTER * size * rng.standard_normal(joints.shape)
    elif kind != NOTHING:
        plan = Plan(joints, 0 * joints, 0 * joints, next(iter(ARMS.values())), useful=tuple(range(joints.shape[1])))
        found = size * UNNAMED[kind](plan, rng)
        # Six joints, six numbers of a flange: the laws of time move the flange.
        off, moved = (off, found) if kind in ("thermal_cycle", "gust") else (found, moved)
    return off, moved


def known(kind: str, size: float, rng: np.random.Generator) -> dict[str, Any]:
    """What the cell is given of an effect of the library."""
    joint, phase = int(rng.integers(1, 5)), rng.uniform(0, 2 * np.pi)
    if kind == "offsets":
        return {"offset": size * _SIZE * rng.standard_normal(6)}
    if kind == "one offset":
        return {"offset": size * _SIZE * np.eye(6)[joint]}
    if kind == "gravity":
        return {"sag": size * _SIZE / 1000}
    own = size * _SIZE * np.sqrt(2) * np.eye(6)[joint]
    return {"gears": lambda q: own * np.sin(q + phase)} if kind == "eccentric gear" else {}


def said(kind: str, size: float, seed: int, views: int) -> Evidence:
    """What is concluded of one cell with an error of some kind in it."""
    joints, rng = joints_of(np.random.default_rng(seed), views), np.random.default_rng([seed, KINDS.index(kind)])
    own = kind.removesuffix(BESIDE)
    unnamed = kind if own not in LIBRARY else "dress_pack" if own != kind else NOTHING
    errors = errors_of(unnamed, size, joints, rng)
    session, T_mount, _ = labelled_cell(seed, views=views, errors=errors, **known(own, size, rng))
    linear = target_model(measurement_of(session, prepare_capture(session)), Model(T_mount), None)
    return gather_evidence(linear, candidates_of(linear)[0], scatter_limit(session))


def share(count: int, total: int) -> str:
    """With its 95 % Wilson interval."""
    low, high = binomtest(count, total).proportion_ci(0.95, method="wilson")
    return f"{count} of {total} ({low:.2f} … {high:.2f})"


def main() -> None:
    """Print the table, and every name that was given."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--views", type=int, default=120)
    parser.add_argument("--size", type=float, default=1.0)
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 3))
    parser.add_argument("--kinds", nargs="+", default=KINDS, choices=KINDS)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    pin(0)
    rows = ["| hidden | right name | wrong name | a group | unknown | names given |", "|---|---|---|---|---|---|"]
    begun = time.process_time()
    for kind in options.kinds:
        verdicts, names = Counter[str](), Counter[str]()
        for seed in range(*options.seeds):
            found = said(kind, options.size, seed, options.views)
            verdicts[found.verdict] += 1
            names.update(r.name for r in found.named if found.verdict == "missing_effect")
        right = names[LIBRARY.get(kind.removesuffix(BESIDE), "")]
        told = [right, names.total() - right, verdicts["cannot_tell"], verdicts["unknown_effect"]]
        total = len(range(*options.seeds))
        cells = [share(k, total) for k in told]
        cells[0] = cells[0] if kind.removesuffix(BESIDE) in LIBRARY else ""
        rows.append(f"| {kind} | {' | '.join(cells)} | {', '.join(names) or '–'} |")
        print(rows[-1], f"{time.process_time() - begun:.0f} s of processor time", flush=True)
    if options.write:
        table = "\n".join((MARKS[0], *rows, MARKS[1]))
        page = re.sub(f"{MARKS[0]}.*?{MARKS[1]}", lambda _: table, PAGE.read_text(), flags=re.S)
        PAGE.write_text(page)


if __name__ == "__main__":
    main()
