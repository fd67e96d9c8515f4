"""Do names hold, and do unknowns stay unknown? Worlds that no model holds, judged blind.

Every cell is simulated and run once; what its views show in other worlds is then drawn. Sizes of effects are multiples
of what an arm that only scatters would show at the least in that cell. Seeds are of two kinds: those of development, 0
and 1, and held-out ones, to be run once for each version of the diagnosis; used up: 848 to 963. `--set before=true`
asks as if poses scattered independently from view to view; `--set fewer=N` takes the first N-th of the trials.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from bench.drawn_cells import SCENES, LinearCell, World, linear_cell, seen, true_column, with_overlaps_of
from bench.harness import Row, Table, grouped, markdown, share
from bench.small_cells import LIBRARY, drawn, smallest
from data_synth import nature
from data_synth.laws.unnamed import IN_TIME, UNNAMED
from data_synth.ordinary_arm import draw_arm, with_memory
from stitch.diagnosis.evidence import gather_evidence
from stitch.diagnosis.score import ScatterLimit
from stitch.diagnosis.sensitivity import least_noncentrality
from stitch.diagnosis.thresholds import IMPLAUSIBLE, ODDS
from stitch.diagnosis.unmodelled_time_effects import find_repeating_errors
from stitch.diagnosis.verdict import Evidence
from stitch.effects import EFFECTS
from stitch.observations.linear_model import LinearModel

USUAL = ScatterLimit(*IMPLAUSIBLE)
MULTIPLES = (1, 2, 3, 4, 6)
# Worlds with several effects, asked again after each that is named.
AGAIN, ASKED_AGAIN = ("beside", "two", "three"), 4
MUST_SHOW = ("effect", *AGAIN, *(f"unnamed_{n}x" for n in MULTIPLES))
OF_THE_ARM = ("joint_offset", "link_geometry", "gear_eccentricity")
# Usual sizes of a law, 0.15 mrad or 0.05 mm rms: what errs by more is broken.
_MOST = 10.0
# A world, and what of it may be named: of a cell, for the k-th draw of a part.
Drawn = tuple[World, tuple[str, ...]]
Part = Callable[[LinearCell, np.random.Generator, int], Drawn]


def nothing(cell: LinearCell, rng: np.random.Generator, k: int) -> Drawn:
    """Scatter, and effects far below what can be seen."""
    return World(_laws(cell, {}, rng)), ()


def memory(cell: LinearCell, rng: np.random.Generator, k: int) -> Drawn:
    """Autoregressive pose errors, 0.9 from view to view, of 40 µm and 40 µrad."""
    return World(_laws(cell, {}, rng), scatter=2 * with_memory(len(cell.moments), 0.9, rng)), ("time",)


def joint_scatter(cell: LinearCell, rng: np.random.Generator, k: int) -> Drawn:
    """Every joint scatters by 15 µrad from view to view, and the flange by half of what it does elsewhere."""
    views, joints = len(cell.moments), cell.plan.joints.shape[1]
    scatter = 0.5 * rng.standard_normal((views, 6))
    return World(_laws(cell, {}, rng), joint_errors=15e-6 * rng.standard_normal((views, joints)), scatter=scatter), ()


def unnamed(cell: LinearCell, rng: np.random.Generator, k: int) -> Drawn:
    """A law outside every dictionary, couplings as often as three others; and the joint that follows it, or time."""
    law = _in_turn(["coupling", "coupling", *(n for n in UNNAMED if n != "coupling")], k)
    time = np.array([moment.time for moment in cell.moments])
    if law in IN_TIME:
        errors = UNNAMED[law](cell.plan, rng, time / np.median(np.diff(time)))
        return World(_laws(cell, {}, rng), flange_errors=errors), (law,)
    errors = UNNAMED[law](cell.plan, rng)
    followed = (f"joint {k + 1}" for k in np.flatnonzero(np.ptp(errors, axis=0)))
    return World(_laws(cell, {}, rng), joint_errors=errors), (law, *followed)


def at_multiple(cell: LinearCell, rng: np.random.Generator, k: int, make: Part, multiple: float) -> Drawn:
    """A law at a multiple of the size that one test for this very law would find; nothing where no arm errs so."""
    world, hidden = make(cell, rng, k)
    size = multiple * _least(cell, world)
    if size > _MOST:
        return World(_laws(cell, {}, rng)), ()
    joint_errors, flange_errors = size * np.asarray(world.joint_errors), size * np.asarray(world.flange_errors)
    return replace(world, joint_errors=joint_errors, flange_errors=flange_errors), hidden


def effect(cell: LinearCell, rng: np.random.Generator, k: int) -> Drawn:
    """One effect of the library at twice its smallest detectable size."""
    return _at(cell, [_possible(cell, k)], 2.0, rng)


def beside(cell: LinearCell, rng: np.random.Generator, k: int) -> Drawn:
    """One effect at three times that size, beside an ordinary arm of half the usual size."""
    world, hidden = _at(cell, [_possible(cell, k)], 3.0, rng)
    return replace(world, arm=draw_arm(cell.plan.arm.joints, 0.5, rng)), hidden


def arm(cell: LinearCell, rng: np.random.Generator, k: int) -> Drawn:
    """An ordinary arm of 0.3, 0.5 or 1 times the usual size: no joint errs above all others."""
    size = (0.3, 0.5, 1.0)[k // 12 % 3]
    return World(_laws(cell, {}, rng), arm=draw_arm(cell.plan.arm.joints, size, rng)), ()


def several(cell: LinearCell, rng: np.random.Generator, k: int, count: int) -> Drawn:
    """So many different effects at four times that size, the first of them in turn."""
    chosen = [_possible(cell, k)]
    while len(chosen) < count:
        further = _possible(cell, int(rng.integers(len(LIBRARY))))
        if further not in chosen:
            chosen.append(further)
    return _at(cell, chosen, 4.0, rng)


# By name: how a world of the part is drawn, and how often. The order is part of the seeds.
PARTS: dict[str, tuple[Part, int]] = {
    "nothing": (nothing, 100),
    "memory": (memory, 100),
    "unnamed": (unnamed, 120),
    "effect": (effect, 126),
    "beside": (beside, 42),
    "two": (partial(several, count=2), 42),
    "three": (partial(several, count=3), 42),
    **{f"unnamed_{n}x": (partial(at_multiple, make=unnamed, multiple=float(n)), 60) for n in MULTIPLES},
    "arm": (arm, 36),
    "joint_scatter": (joint_scatter, 100),
}


def _laws(cell: LinearCell, hidden: dict[str, float], rng: np.random.Generator) -> nature.Nature:
    return nature.draw(hidden, 1.0, cell.plan, rng)[0]


def _least(cell: LinearCell, world: World) -> float:
    """Factor on the errors of a world at which one test for them, of as many as there are effects, finds them."""
    plain = cell.linear.restricted(())
    column = plain.residual(plain.reduce(true_column(cell, world)[:, None]))
    freedom = plain.satterthwaite.degrees_of_freedom(plain.in_blocks(column))
    return float(np.sqrt(least_noncentrality(column, 1.0, len(EFFECTS), freedom, {1.0: 1.0})) / np.linalg.norm(column))


def _possible(cell: LinearCell, k: int) -> str:
    """The k-th effect that this cell can have and show."""
    return _in_turn([name for name in LIBRARY if any(c.name == name for c in cell.candidates)], k)


def _in_turn(names: Sequence[str], k: int) -> str:
    """All names in turn, each turn one place on, so that every cell gets every name."""
    return names[(k + k // len(names)) % len(names)]


def _at(cell: LinearCell, laws: Sequence[str], multiple: float, rng: np.random.Generator) -> Drawn:
    chance = int(rng.integers(1 << 30))
    plain = cell.linear.restricted(())
    true = drawn(cell.name, cell.plan, cell.measurement, laws, chance)
    sizes = {law: smallest(plain, law, true[law]) for law in laws}
    hidden = {law: multiple * size for law, size in sizes.items() if size is not None}
    return World(_laws(cell, hidden, np.random.default_rng([chance, 2]))), tuple(hidden)


def jobs(seeds: range, before: bool, fewer: int) -> Iterator[Row]:
    """All draws of all parts, over the cells in turn."""
    cells = [(seed, name) for seed in seeds for name in SCENES]
    for part, (_, count) in PARTS.items():
        for k in range(count // fewer):
            seed, name = cells[k % len(cells)]
            yield {"part": part, "scene": name, "seed": seed, "draw": k, "before": before}


def trial(job: Row) -> Row:
    """Draw a world and ask for its evidence; "verdict" is None where these views do not show it at any size."""
    part, k, cell = job["part"], job["draw"], linear_cell(job["scene"], job["seed"])
    rng = np.random.default_rng([cell.seed, k, list(PARTS).index(part), 17])
    world, hidden = PARTS[part][0](cell, rng, k)
    if part in MUST_SHOW and not hidden:
        return {"verdict": None}
    linear = seen(cell, world, rng)
    linear = linear.restricted(()) if job["before"] else linear
    evidence = gather_evidence(linear, cell.candidates, USUAL)
    named = [r.name for r in evidence.named] + ([evidence.second.name] if evidence.second else [])
    then, group = _named_after(cell, world, linear, evidence) if part in AGAIN else ([], [])
    repeating = find_repeating_errors(linear) if evidence.verdict == "unknown_effect" else ()
    return {
        "hidden": hidden,
        "also": [] if world.arm is None else OF_THE_ARM,  # what else is there: the errors of an ordinary arm
        "verdict": evidence.verdict,
        "named": named,
        "then": then,  # named when asked again with what was named added
        "group": group,  # of which one is there at the end, if it ends so
        "follows": ", ".join(u.words for u in repeating),  # what is said to repeat without a name
        "certain": bool(evidence.log_odds_over_nothing > ODDS),  # False: the name is less than 20 to 1 over chance
    }


def _named_after(
    cell: LinearCell, world: World, linear: LinearModel, evidence: Evidence
) -> tuple[list[str], list[str]]:
    """What is named next, and next again, when the effect that was named is added, as `stitch add` would; and the
    group that cannot be told apart, if it ends with one."""
    then, candidates = list[str](), cell.candidates
    for _ in range(ASKED_AGAIN):
        if evidence.verdict != "missing_effect":
            break
        name, form = evidence.named[0].name, evidence.named[0].score.form
        world = replace(world, laws=world.laws.without(name))
        linear = with_overlaps_of(cell, world, linear).conditioned_on(form.columns, form.sizes)
        candidates = [c for c in candidates if c.name != name]
        evidence = gather_evidence(linear, candidates, USUAL)
        then += [evidence.named[0].name] if evidence.verdict == "missing_effect" else []
    return then, [r.name for r in evidence.named] if evidence.verdict == "cannot_tell" else []


def _single(row: Row) -> bool:
    return row["verdict"] == "missing_effect"


def _right(row: Row) -> bool:
    """What is hidden, or one of it, is named or in the group."""
    return any(name in row["hidden"] for name in row["named"])


def _wrong(row: Row) -> bool:
    """Nothing of what is named is there."""
    return not any(name in (*row["hidden"], *row["also"]) for name in row["named"])


def _joint(row: Row) -> bool:
    """One joint is said to follow a law without a name."""
    return "above all" in row["follows"]


def _right_joint(row: Row) -> bool:
    return _joint(row) and any(f"{name} " in row["follows"] for name in row["hidden"])


def _right_trend(row: Row) -> bool:
    """What it follows is said: that joint, or several, or of what follows no joint the time."""
    if "joints" in row["hidden"]:
        return "joint" in row["follows"]
    of_joint = any(name.startswith("joint ") for name in row["hidden"])
    return _right_joint(row) if of_joint else bool(row["follows"]) and "joint" not in row["follows"]


def _unnamed_yet(row: Row) -> set[str]:
    return set(row["hidden"]) - {*row["named"], *row["then"]}


def _whole_or_group(row: Row) -> bool:
    """All that is hidden is named in the end, or the last of it in a group of which one is there."""
    left = _unnamed_yet(row)
    return bool(row["hidden"]) and (not left or (len(left) == 1 and left <= set(row["group"])))


COLUMNS: dict[str, Callable[[Row], bool]] = {
    "wrong name": lambda r: _single(r) and _wrong(r),
    "wrong name said to be certain": lambda r: _single(r) and _wrong(r) and r["certain"],
    "wrong group": lambda r: r["verdict"] == "cannot_tell" and _wrong(r),
    "right name": lambda r: _single(r) and _right(r),
    "right name said to be certain": lambda r: _single(r) and _right(r) and r["certain"],
    "right name or group": _right,
    "all of it, asked again": lambda r: bool(r["hidden"]) and not _unnamed_yet(r),
    "all of it, or the last in a group": _whole_or_group,
    "wrong when asked again": lambda r: any(name not in (*r["hidden"], *r["also"]) for name in r["then"]),
    "unknown": lambda r: r["verdict"] == "unknown_effect",
    "adequate": lambda r: r["verdict"] == "adequate",
    "right joint above all": _right_joint,
    "wrong joint": lambda r: _joint(r) and not _right_joint(r),
    "right joint or time": _right_trend,
}


def summary(rows: list[Row]) -> list[str]:
    """A line a part: of every statement how often it holds."""
    parts = grouped([row for row in rows if row["verdict"] is not None], "part")
    lines = ([part, *(share(map(hit, group)) for hit in COLUMNS.values())] for part, group in parts.items())
    return markdown(" | ".join(["world", *COLUMNS]), lines)


TABLE = Table(jobs, trial, summary, range(2), settings={"before": False, "fewer": 1})
