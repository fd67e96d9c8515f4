"""Twenty laws at every place, of nobody's library, in a world of its own: what is named, and is the place right?

Cells of balls and of clouds (`laws_world.py`), at the usual size of each law and three times it. A name is right where
it says what truly happened; a law, where its place or one of its group is the true one.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from bench.harness import Row, Table, grouped, markdown, share
from bench.laws_world import Array, World, draw_world, measured
from stitch.api.session import Session
from stitch.api.verbs import diagnose, run
from stitch.diagnosis.diagnose import linear_model_of
from stitch.diagnosis.score import beyond_expected, expected_scatter, scatter_limit
from stitch.diagnosis.systematic_laws import law_of

SIZES = (1.0, 3.0)
VIEWS = {"balls": 28, "clouds": 18}
# What is left of a cell where nothing is wrong: median of ten.
EXPECTED_UM = {"balls": 36.0, "clouds": 22.0}
# What a diagnosis calls the two ends of the arm, and names that say what happens there; a base moves with the one that
# stands.
_WORDS = {
    "eye_in_hand": {"part": "the part or the base", "mount": "the scanner or its mount"},
    "eye_to_hand": {"part": "the part on the flange", "mount": "the scanner's stand or the base"},
}
_NAMES = {
    ("part", "view"): ("part_slip",),
    ("part", "time"): (),
    ("mount", "view"): ("mount_step",),
    ("mount", "time"): ("mount_drift", "mount_warmup", "mount_creep"),
}
_KINDS = {name: side for (side, _), names in _NAMES.items() for name in names}
_FOLLOWS = {"view": "view order", "time": "time_s", "angle": "_deg", "approach": "_approach", "moment": "moment"}
# Largest turn (rad) and shift (mm) of a law of usual size.
TURN, SHIFT = 2e-4, 0.06


@dataclass(frozen=True)
class Law:
    """One law: where it acts, words of what it follows, and names of a library that say the same."""

    place: str  # base, tool, stand, joint, scanner
    follows: str
    names: tuple[str, ...]
    act: Callable[[World, np.random.Generator, float], int | None]  # which joint it struck, from 1


def _unit(values: Array) -> Array:
    """Values (V,) from 0 at first, their largest 1."""
    values = np.asarray(values, float) - values[0]
    return values / max(np.abs(values).max(), 1e-12)


def _twist(rng: np.random.Generator, single: bool = False) -> Array:
    """(6,) of the usual size: any, or about or along one axis alone."""
    if single:
        k = rng.integers(6)
        return np.eye(6)[k] * (TURN if k < 3 else SHIFT)
    turn, shift = rng.standard_normal((2, 3))
    return np.append(TURN * turn / np.linalg.norm(turn), SHIFT * shift / np.linalg.norm(shift))


def _later(world: World, rng: np.random.Generator) -> Array:
    n = len(world.joints)
    return (np.arange(n) >= rng.integers(n // 4, 3 * n // 4)).astype(float)


def _at(place: str, shape: Callable[[World, np.random.Generator], Array], single: bool = False) -> Callable[..., None]:
    def act(world: World, rng: np.random.Generator, size: float) -> None:
        getattr(world, place)[:] += size * np.outer(shape(world, rng), _twist(rng, single))

    return act


def _joint(joints: tuple[int, ...], shape: Callable[[World, np.random.Generator, int], Array]) -> Callable[..., int]:
    def act(world: World, rng: np.random.Generator, size: float) -> int:
        k = int(rng.choice(joints))
        world.wrong[:, k] += size * TURN * shape(world, rng, k)
        return k + 1

    return act


def _tilt_by_moment(world: World, rng: np.random.Generator, size: float) -> None:
    about = world.moment - world.moment[0]
    world.base[:, :2] += size * TURN * about[:, :2] / np.abs(about[:, :2]).max()


def _cable(world: World, rng: np.random.Generator) -> Array:
    q = world.joints[:, 4] - np.median(world.joints[:, 4])
    return _unit(np.sign(q) * np.maximum(np.abs(q) - np.quantile(np.abs(q), 0.3), 0))


def _zoom(world: World, rng: np.random.Generator, size: float) -> None:
    warm = _unit(world.columns["ambient_c"])
    world.seen = lambda points, view: points * (1 + size * 4e-4 * warm[view])


def _longer(world: World, rng: np.random.Generator, size: float) -> None:
    later = _later(world, rng)

    def seen(points: Array, view: int) -> Array:
        ray = points / np.linalg.norm(points, axis=1, keepdims=True)
        return points + size * 0.08 * later[view] * ray

    world.seen = seen


def _column(name: str) -> Callable[..., Array]:
    return lambda world, *_: _unit(world.columns[name])


def _time(world: World, *_: object) -> Array:
    return _unit(world.seconds)


def _settling(world: World, *_: object) -> Array:
    return _unit(np.log1p((world.seconds - world.seconds[0]) / 200))


LAWS = {
    "base tilts with the moment": Law("base", "moment", ("base_compliance",), _tilt_by_moment),
    "base follows ambient": Law("base", "ambient_c", (), _at("base", _column("ambient_c"), True)),
    "base knocked": Law("base", "view", (), _at("base", _later)),
    "base sinks": Law("base", "time", (), _at("base", _settling, True)),
    "base follows load": Law("base", "spindle_load", (), _at("base", _column("spindle_load"))),
    "joint follows ambient": Law(
        "joint", "ambient_c", ("joint_thermal",), _joint((1, 2, 3), lambda w, g, k: _unit(w.columns["ambient_c"]))
    ),
    "joint loses counts": Law("joint", "view", ("joint_step",), _joint((1, 2, 3, 4), lambda w, g, k: _later(w, g))),
    "motor warms": Law(
        "joint", "time", (), _joint((1, 2, 3), lambda w, g, k: 1 - np.exp(-(w.seconds - w.seconds[0]) / 500))
    ),
    "joint dragged by another": Law("joint", "approach", (), _joint((1, 2, 4), lambda w, g, k: w.moves[:, k - 1])),
    "joint follows ambient squared": Law(
        "joint", "ambient_c", ("joint_thermal",), _joint((1, 2), lambda w, g, k: _unit(w.columns["ambient_c"]) ** 2)
    ),
    "joint follows air": Law("joint", "air_bar", (), _joint((1, 2, 3, 4), lambda w, g, k: _unit(w.columns["air_bar"]))),
    "joint pulled by cable": Law("joint", "angle", (), _joint((3,), lambda w, g, k: _cable(w, g))),
    "tool follows ambient": Law("tool", "ambient_c", (), _at("tool", _column("ambient_c"))),
    "tool knocked": Law("tool", "view", (), _at("tool", _later)),
    "cable at the wrist": Law("tool", "angle", (), _at("tool", _cable, True)),
    "loose tool seat": Law("tool", "approach", (), _at("tool", lambda w, g: w.moves[:, 5], True)),
    "stand slips one way": Law("stand", "view", (), _at("stand", _later, True)),
    "stand follows coolant": Law("stand", "coolant_on", (), _at("stand", _column("coolant_on"), True)),
    "scanner zooms with ambient": Law("scanner", "ambient_c", ("scanner_thermal_scale",), _zoom),
    "scanner longer from a view on": Law("scanner", "view", (), _longer),
}


def cell(law: str, kind: str, size: float, seed: int) -> tuple[Session, dict[str, object]]:
    """Return a session, and what is true of it."""
    rng = np.random.default_rng([seed, list(LAWS).index(law), kind == "clouds"])
    mount = ("eye_in_hand", "eye_to_hand")[rng.integers(2)]
    world, hand, middle = draw_world(mount, VIEWS[kind], rng)
    joint = LAWS[law].act(world, rng, size)
    return Session.from_arrays(**measured(world, hand, middle, kind == "clouds", rng)), {"mount": mount, "joint": joint}


def trial(job: Row) -> Row:
    """Run and diagnose one cell."""
    session, truth = cell(job["law"], job["kind"], job["size"], job["seed"])
    result = run(session)
    found = diagnose(result)
    told = [law_of(r) for r in found.laws]
    return truth | {
        "verdict": found.verdict,
        "effects": list(found.effects),
        "certain": bool(found.certain),
        "laws": [[law.place.name, law.driver.name] for law in told],
        "sentence": found.sentence,
        "rms_um": 1e3 * result.residual_rms,
        "noise_um": 1e3 * found.noise_floor,
        "scatter_um": 1e3 * found.translation,
    }


def judged(row: Row) -> Row:
    """Return of a row what is right of it."""
    law = LAWS[row["law"]]
    side = _side(law.place, row["mount"])
    place = f"joint {row['joint']}" if law.place == "joint" else _WORDS[row["mount"]][side]
    names = set(row["effects"])
    # A base that moves alike is said beside the name of what it looks like.
    right_names = {*law.names, *_NAMES.get((side, law.follows), ())}
    if law.place == "base" and "base" not in row["sentence"]:
        right_names = set(law.names)
    laws = [tuple(pair) for pair in row["laws"]]
    single = row["verdict"] == "missing_effect"
    right_name = single and bool(names & right_names)
    wrong_name = single and not right_name
    places = {where for where, _ in laws} | {_WORDS[row["mount"]].get(_KINDS.get(name, "")) for name in names}
    told = re.findall(r"((?:joint \d(?: or )?)+) above all", row["sentence"])
    places |= {f"joint {k}" for words in told for k in re.findall(r"\d", words)}
    follows = _FOLLOWS.get(law.follows, law.follows)
    right_law = not names and len(laws) == 1 and place in laws[0][0] and follows in laws[0][1]
    base = law.place == "base" and any("base" in str(where) for where in places)
    here = right_name or base or any(place in str(where) for where in places) or bool(names & right_names)
    too_much = row["rms_um"] > 2 * EXPECTED_UM[row["kind"]]
    return {
        "wrong name, certain": wrong_name and row["certain"],
        "wrong name, perhaps": wrong_name and not row["certain"],
        "wrong group": row["verdict"] == "cannot_tell" and not here,
        "law at a wrong place": bool(laws) and not names and not here,
        "adequate beside twice the scatter": row["verdict"] == "adequate" and too_much,
        "group of more than three": len(names) + len(laws) > 3,
        "place right, or in the group": here,
        "name or law certain and right": (right_name and row["certain"]) or right_law,
    }


def _side(place: str, mount: str) -> str:
    """Return which of the two ends of the arm a place moves with: of the part, or of the scanner's mount."""
    in_hand = mount == "eye_in_hand"
    return {"scanner": "mount", "joint": ""}.get(place) or ("mount" if (place == "tool") == in_hand else "part")


def jobs(seeds: range) -> Iterator[Row]:
    """Every law at both sizes for each seed, of every four cells one in clouds."""
    for seed in seeds:
        for k, (law, size) in enumerate(product(LAWS, SIZES)):
            kind = "clouds" if (k + seed) % 4 == 0 else "balls"
            yield {"law": law, "kind": kind, "size": size, "seed": 100 * seed + k}


def summary(rows: list[Row]) -> list[str]:
    """Return the shares of what is right and wrong, by size."""
    lines = []
    for size, group in grouped(rows, "size").items():
        found = [judged(row) for row in group]
        lines += [[f"{size:g}", what, share(x[what] for x in found)] for what in found[0]]
    return markdown("size | what | cells", lines)


TABLE = Table(jobs, trial, summary, range(1))


def scatter_jobs(seeds: range) -> Iterator[Row]:
    """Every law at both sizes for each seed, and as many worlds in which nothing is wrong."""
    for job in jobs(seeds):
        yield job
        yield job | {"size": 0.0}


def scatter_trial(job: Row) -> Row:
    """Return whether more is left than the scatter of an ordinary arm explains, whatever a diagnosis says of it."""
    result = run(cell(job["law"], job["kind"], job["size"], job["seed"])[0])
    linear = linear_model_of(result)
    more = beyond_expected(linear, expected_scatter(linear, scatter_limit(result.session)))
    return {"more": more, "times": 1e3 * result.residual_rms / EXPECTED_UM[job["kind"]]}


def scatter_summary(rows: list[Row]) -> list[str]:
    """Return how often more is left than expected, by what is left."""
    groups = {
        "nothing is wrong": [row for row in rows if not row["size"]],
        "a law, up to twice what is left without one": [r for r in rows if r["size"] and r["times"] <= 2],
        "a law, more than twice": [row for row in rows if row["size"] and row["times"] > 2],
    }
    lines = [[name, share(row["more"] for row in group)] for name, group in groups.items()]
    return markdown("in the cell | not adequate by its scatter alone", lines)


SCATTER = Table(scatter_jobs, scatter_trial, scatter_summary, range(6800, 6802), "diagnosis", "expected-scatter")
