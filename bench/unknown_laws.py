"""Do names hold, and do unknowns stay unknown? Worlds that no model holds, judged blind; and an oracle beside.

Every cell is simulated and run once; what its views show in other worlds is then drawn. Sizes of effects are multiples
of what an arm that only scatters would show at the least in that cell. Seeds are of two kinds: those of development, 0
and 1, and held-out ones, to be run once for each version of the diagnosis; used up: 848 to 963. `--set before=true`
asks as if poses scattered independently from view to view; `--set fewer=N` takes the first N-th of the trials.

How much larger must an effect be for the diagnosis than for an oracle that knows which it is, and all variances? The
oracle makes one test at the level of an alarm: χ² over all numbers of the true effect, beside an unknown hand-eye,
under the scatter and noise that the draws really have. Each draw is of an effect at a multiple of what the oracle
detects in eight draws of ten; counted is what is not called adequate. Some 40 minutes.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.optimize import brentq, isotonic_regression
from scipy.stats import chi2, ncx2

from bench.drawn_cells import SCATTER, LinearCell, World, linear_cell, seen, true_column, with_overlaps_of
from bench.harness import Row, Table, grouped, markdown, share
from bench.small_cells import LIBRARY, SCENES, drawn, smallest
from data_synth import nature
from data_synth.laws.blind_first import FOREIGN, FOREIGN_IN_TIME, FOREIGN_OF_FLANGE
from data_synth.laws.blind_second import FURTHER, FURTHER_IN_TIME, FURTHER_OF_FLANGE
from data_synth.laws.blind_third import LATER, LATER_IN_TIME, LATER_OF_FLANGE
from data_synth.laws.unnamed import IN_TIME, UNNAMED
from data_synth.ordinary_arm import draw_arm, with_memory
from stitch.diagnosis.candidates import Candidate, Form, candidate_of
from stitch.diagnosis.evidence import gather_evidence
from stitch.diagnosis.score import ScatterLimit
from stitch.diagnosis.sensitivity import least_noncentrality
from stitch.diagnosis.thresholds import ALPHA_NAME, IMPLAUSIBLE, ODDS, POWER
from stitch.diagnosis.unmodelled_time_effects import find_repeating_errors
from stitch.diagnosis.verdict import Evidence
from stitch.effects import EFFECTS
from stitch.effects.contract import missing_need
from stitch.numerics.frames import Array
from stitch.numerics.reml import at_variances
from stitch.observations.linear_model import LinearModel

USUAL = ScatterLimit(*IMPLAUSIBLE)
MULTIPLES = (1, 2, 3, 4, 6)
# Worlds with several effects, asked again after each that is named.
AGAIN, ASKED_AGAIN = ("beside", "two", "three"), 4
MUST_SHOW = ("effect", *AGAIN, *(f"unnamed_{n}x" for n in MULTIPLES), "foreign_3x", "further_3x", "later_3x")
OF_THE_ARM = ("joint_offset", "link_geometry", "gear_eccentricity")
ORACLE_MULTIPLES = (1.0, 1.5, 2.0, 3.0)
# Usual sizes of a law, 0.15 mrad or 0.05 mm rms: what errs by more is broken.
_MOST = 10.0
# A number of an effect counts for the oracle if the views show it at its plausible size as more than a tenth of a
# sigma.
_SEEN = 0.1

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
    """A law outside every dictionary; couplings as often as three others."""
    law = _in_turn(["coupling", "coupling", *(n for n in UNNAMED if n != "coupling")], k)
    return _erring(cell, rng, law, UNNAMED[law], of_flange=law in IN_TIME)


def by_another_hand(
    cell: LinearCell,
    rng: np.random.Generator,
    k: int,
    laws: Mapping[str, Callable[..., Array]],
    of_flange: Sequence[str],
) -> Drawn:
    """A law of those that were written apart from all that looks for laws."""
    law = _in_turn(list(laws), k)
    return _erring(cell, rng, law, laws[law], of_flange=law in of_flange)


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


# The second eight were written after what the first showed was mended, the third after the second were measured.
FIRST_EIGHT = partial(by_another_hand, laws=FOREIGN, of_flange=FOREIGN_OF_FLANGE)
SECOND_EIGHT = partial(by_another_hand, laws=FURTHER, of_flange=FURTHER_OF_FLANGE)
THIRD_EIGHT = partial(by_another_hand, laws=LATER, of_flange=LATER_OF_FLANGE)
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
    "foreign": (FIRST_EIGHT, 64),
    "foreign_3x": (partial(at_multiple, make=FIRST_EIGHT, multiple=3.0), 64),
    "further": (SECOND_EIGHT, 64),
    "further_3x": (partial(at_multiple, make=SECOND_EIGHT, multiple=3.0), 64),
    "later": (THIRD_EIGHT, 64),
    "later_3x": (partial(at_multiple, make=THIRD_EIGHT, multiple=3.0), 64),
    "joint_scatter": (joint_scatter, 100),
}


def _erring(
    cell: LinearCell, rng: np.random.Generator, law: str, errors: Callable[..., Array], of_flange: bool
) -> Drawn:
    """A world with a law, and what of it may be told: the joint that follows it, or that it is of all of them."""
    time = np.array([moment.time for moment in cell.moments])
    in_time = law in (*IN_TIME, *FOREIGN_IN_TIME, *FURTHER_IN_TIME, *LATER_IN_TIME)
    times = (time / np.median(np.diff(time)),) if in_time else ()
    error = errors(cell.plan, rng, *times)
    world = World(_laws(cell, {}, rng), **{"flange_errors" if of_flange else "joint_errors": error})
    if of_flange:
        return world, (law,) if in_time else (law, "joints")
    return world, (law, *(f"joint {k + 1}" for k in np.flatnonzero(np.ptp(error, axis=0))))


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


def oracle_jobs(seeds: range, draws: int) -> Iterator[Row]:
    """Every effect at every multiple, over the cells in turn."""
    cells = [(seed, name) for seed in seeds for name in SCENES]
    for name in LIBRARY:
        for multiple in ORACLE_MULTIPLES:
            for k in range(draws):
                seed, scene = cells[k % len(cells)]
                yield {"effect": name, "multiple": multiple, "draw": k, "scene": scene, "seed": seed}


def oracle_trial(job: Row) -> Row:
    """Whether something is said to be missing in one draw; None where the cell cannot have or show the effect."""
    name, cell = job["effect"], linear_cell(job["scene"], job["seed"])
    # The same effect at every multiple.
    chance = [cell.seed, job["draw"], LIBRARY.index(name)]
    rng = np.random.default_rng([*chance, int(100 * job["multiple"])])
    chance_of_law = int(np.random.default_rng(chance).integers(1 << 30))
    true = drawn(cell.name, cell.plan, cell.measurement, [name], chance_of_law)[name]
    size = _oracle_size(cell, name, true) if true else None
    if size is None:
        return {"detected": None}
    laws = _laws(cell, {name: job["multiple"] * size}, np.random.default_rng([chance_of_law, 2]))
    evidence = gather_evidence(seen(cell, World(laws), rng), cell.candidates, USUAL)
    return {"detected": evidence.verdict != "adequate"}


def _oracle_size(cell: LinearCell, name: str, true: dict[str, float]) -> float | None:
    """Factor on the parameters `true` that the oracle detects in eight draws of ten; None where a cell cannot."""
    if missing_need(cell.measurement, EFFECTS[name]):
        return None
    candidate = candidate_of(cell.linear, EFFECTS[name])
    if candidate is None:
        return None
    form = nearest_form(candidate, true)
    values = np.array([true.get(p.name, 0.0) for p in candidate.parameters])
    variances = np.array([SCATTER[0] ** 2, SCATTER[3] ** 2, cell.noise_factor])
    mixed = replace(cell.linear.mixed, components=cell.linear.mixed.components[:3], further=None)
    known = replace(cell.linear, mixed=mixed, null=at_variances(mixed, variances), pose_errors=None)
    white = known.residual(form.columns)
    rank = int((np.linalg.svd(white * form.sizes, compute_uv=False) > _SEEN).sum())
    length = float(np.linalg.norm(white @ values[form.keep]))
    if rank == 0 or length == 0:
        return None
    limit = float(chi2.isf(ALPHA_NAME, rank))
    return float(np.sqrt(brentq(lambda shift: ncx2.sf(limit, rank, shift) - POWER, 1e-3, 1e3))) / length


def nearest_form(candidate: Candidate, true: dict[str, float]) -> Form:
    """Return the form of a candidate with all fitted parameters whose grid lies nearest to the true values."""
    values = np.array([true.get(p.name, 0.0) for p in candidate.parameters])
    fitted = np.array([not p.grid for p in candidate.parameters])
    whole = [form for form in candidate.forms if form.keep.sum() == fitted.sum()]
    return min(whole, key=lambda form: float(np.abs(form.term.values - values)[~fitted].sum()))


def oracle_summary(rows: list[Row]) -> list[str]:
    """A line an effect: shares found at every multiple, of how many draws, and the multiple at which eight of ten are;
    the median of those."""
    lines, ratios = [], []
    for name, group in grouped(rows, "effect").items():
        hits = [
            [r["detected"] for r in group if r["multiple"] == m and r["detected"] is not None] for m in ORACLE_MULTIPLES
        ]
        if not all(hits):
            continue
        shares = np.array([np.mean(flags) for flags in hits])
        rising = isotonic_regression(shares).x
        if rising[0] >= POWER:
            ratio, text = ORACLE_MULTIPLES[0], f"at most {ORACLE_MULTIPLES[0]:g}"
        elif rising[-1] >= POWER:
            ratio = float(np.interp(POWER, rising, ORACLE_MULTIPLES))
            text = f"{ratio:.1f}"
        else:
            ratio, text = np.inf, f"above {ORACLE_MULTIPLES[-1]:g}"
        ratios.append(ratio)
        lines.append([name, min(map(len, hits)), *(f"{s:.2f}" for s in shares), text])
    head = f"effect | draws | {' | '.join(f'{m:g}×' for m in ORACLE_MULTIPLES)} | ratio at 80 %"
    return [*markdown(head, lines), "", f"Median ratio {np.median(ratios):.2f}."]


ORACLE = Table(oracle_jobs, oracle_trial, oracle_summary, range(2), settings={"draws": 12})
