"""Labelled points: how often does something get a name that is not its own, and what does `add --suggested` make of it?

NAMES: an arm with four reflectors before a tracker; every law of data_synth's unnamed ones, poses with memory, joints
that scatter, nothing, and effects of the library, each alone and beside an unnamed law of the same size: of these alone
one name is right. Setting `size` is in units of the laws' own sizes, 0.15 mrad of a joint or 0.05 mm.

SUGGESTED: sessions of ten kinds through `add --suggested`, an ABB IRB 120 before a tracker: a ball, three reflectors, a
6D probe; the sensor's kind stated and not; points in the robot's base; sweeps of single joints; an arm driven by
cables; a part that slips; joints that count otherwise in either direction. Wrong: the first single name is none of the
errors that are there. Zero: an effect of the final model that is not there, and no parameter of which is three sigmas
off zero. Weak: one that is there, and whose parameters are only known together. Again: the closing diagnosis names what
was dropped.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bench.harness import Row, Table, grouped, markdown, share, with_all
from data_synth.arms import ARMS
from data_synth.fixtures.labelled_arm import joints_of, labelled_cell
from data_synth.kinematics import flange, gravity_torques
from data_synth.laws.unnamed import UNNAMED
from data_synth.moment import Plan
from data_synth.ordinary_arm import draw_arm, with_memory
from stitch.api.pipeline import diagnose, run
from stitch.api.stepwise import suggest
from stitch.diagnosis.candidates import candidates_of
from stitch.diagnosis.evidence import gather_evidence
from stitch.diagnosis.score import scatter_limit
from stitch.model.model import Model
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.observations.targets.target_model import target_model
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of
from stitch.session.reading.robot_description import robot_from_dh
from stitch.session.robot import forward
from stitch.session.session import Scanner, SessionData, Sighting, View

NOTHING, MEMORY, SCATTER = "nothing hidden", "memory", "joints that scatter"
# What is hidden by name, none of it by the library's code: offset of one joint, of all, gravity, a gear that runs out.
LIBRARY = {"one offset": "joint_offset", "offsets": "joint_offset", "gravity": "joint_compliance"}
LIBRARY |= {"eccentric gear": "gear_eccentricity"}
BESIDE = " beside dress_pack"
# These cells are given no torques, without which no spring stiffens.
UNNAMED_HERE = tuple(law for law in UNNAMED if law != "stiffening")
KINDS = (NOTHING, MEMORY, *UNNAMED_HERE, *LIBRARY, *(kind + BESIDE for kind in LIBRARY), SCATTER)
# What a joint is off by, rad; gravity turns joint 2 by so much at a metre's reach.
_SIZE = 1.5e-4
_SCATTER = 2e-5  # of every joint from view to view, rad
_VIEWS, _OFFSET, _SIGMAS = 48, 6e-4, 3.0
_PLACES = np.array([[60.0, 10.0, 30.0], [-40.0, 55.0, 25.0], [-20.0, -60.0, 40.0]])
_PROBE_TURN = Rotation.from_rotvec([0.4, -0.2, 0.9]).as_matrix()


def name_jobs(seeds: range, views: int, size: float) -> Iterator[Row]:
    """Every kind of error, a cell a seed."""
    for kind in KINDS:
        yield from ({"kind": kind, "seed": seed, "views": views, "size": size} for seed in seeds)


def name_trial(job: Row) -> Row:
    """What is concluded of one cell with an error of some kind in it."""
    kind, size, seed, views = job["kind"], job["size"], job["seed"], job["views"]
    joints = joints_of(np.random.default_rng(seed), views)
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    alone = kind.removesuffix(BESIDE)
    unnamed = kind if alone not in LIBRARY else "dress_pack" if alone != kind else NOTHING
    errors = _errors(unnamed, size, joints, rng)
    session, T_mount, _ = labelled_cell(seed, views=views, errors=errors, **_of_library(alone, size, rng))
    linear = target_model(measurement_of(session, prepare_capture(session)), Model(T_mount), None)
    evidence = gather_evidence(linear, candidates_of(linear)[0], scatter_limit(session))
    return {"verdict": evidence.verdict, "named": [r.name for r in evidence.named]}


def _errors(kind: str, size: float, joints: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Errors of the joints (V, n) and of the flange (V, 6); memory is AR(1), 0.9, of 40 µm and 40 µrad."""
    of_joints, of_flange = np.zeros_like(joints), np.zeros((len(joints), 6))
    if kind == NOTHING:
        return of_joints, of_flange
    if kind == MEMORY:
        return of_joints, with_memory(len(joints), 0.9, rng) * np.repeat([40e-6, 0.04], 3) * size
    if kind == SCATTER:
        return _SCATTER * size * rng.standard_normal(joints.shape), of_flange
    plan = Plan(joints, 0 * joints, 0 * joints, next(iter(ARMS.values())), useful=tuple(range(joints.shape[1])))
    errors = size * UNNAMED[kind](plan, rng)
    # Six joints, six numbers of a flange: the laws of time move the flange.
    return (of_joints, errors) if kind in ("thermal_cycle", "gust") else (errors, of_flange)


def _of_library(kind: str, size: float, rng: np.random.Generator) -> dict[str, Any]:
    """What the cell is given of an effect of the library."""
    joint, phase = int(rng.integers(1, 5)), rng.uniform(0, 2 * np.pi)
    if kind == "offsets":
        return {"offset": size * _SIZE * rng.standard_normal(6)}
    if kind == "one offset":
        return {"offset": size * _SIZE * np.eye(6)[joint]}
    if kind == "gravity":
        return {"sag": size * _SIZE / 1000}
    gear = size * _SIZE * np.sqrt(2) * np.eye(6)[joint]
    return {"gears": lambda q: gear * np.sin(q + phase)} if kind == "eccentric gear" else {}


def name_summary(rows: list[Row]) -> list[str]:
    """A line a kind of error."""
    lines = []
    for kind, group in grouped(rows, "kind").items():
        true = LIBRARY.get(kind.removesuffix(BESIDE))
        single = [row["named"][0] if row["verdict"] == "missing_effect" else None for row in group]
        right = share(name == true for name in single) if true else ""
        wrong = share(name is not None and name != true for name in single)
        group_or_not = [
            share(row["verdict"] == verdict for row in group) for verdict in ("cannot_tell", "unknown_effect")
        ]
        names = Counter(name for name in single if name)
        lines.append([kind, right, wrong, *group_or_not, ", ".join(names) or "–"])
    return markdown("hidden | right name | wrong name | a group | unknown | names given", lines)


NAMES = Table(
    name_jobs, name_trial, name_summary, range(3), "points", "names", settings={"views": 120, "size": 1.0}
)  # fmt: skip


@dataclass(frozen=True)
class Kind:
    """What is measured, and which names are right."""

    right: frozenset[str]
    targets: int = 3
    probe: bool = False
    stated: bool = True  # the sensor's kind
    at_base: bool = False
    sweeps: bool = False
    soft: float = 0.0  # rad/(N m) of every joint
    play: float = 0.0  # rad, by the direction from which joints come
    slip: float = 0.0  # mm, from the middle of the session on


_OFFSETS = frozenset({"joint_offset"})
SESSIONS = {
    "ball": Kind(_OFFSETS, targets=1, stated=False),
    "ball, kind stated": Kind(_OFFSETS, targets=1),
    "three reflectors": Kind(_OFFSETS, stated=False),
    "three reflectors, nothing hidden": Kind(frozenset(), stated=False),
    "6D probe": Kind(_OFFSETS, probe=True, stated=False),
    "points in the base": Kind(_OFFSETS, stated=False, at_base=True),
    "sweeps of single joints": Kind(_OFFSETS, stated=False, sweeps=True),
    "cable arm": Kind(_OFFSETS | {"joint_compliance", "backlash"}, soft=3e-5, play=1e-3),
    "slip by time": Kind(_OFFSETS | {"part_slip"}, slip=0.4),
    "by direction": Kind(_OFFSETS | {"backlash"}, play=6e-4),
}


def session_of_kind(kind: Kind, seed: int) -> SessionData:
    """Return one session of its own arm."""
    # An arm of this seed drew its errors, and the half of its ranges, before its joints.
    draws, arm = np.random.default_rng(4 * seed + 1), ARMS["ABB IRB 120"]
    draw_arm(arm.joints, 1.0, draws)
    draws.random(3)
    low, high = np.maximum(arm.lower, -2.0), np.minimum(arm.upper, 2.0)
    q = draws.uniform(low, high, (_VIEWS, len(low)))
    if kind.sweeps:
        q = np.tile(draws.uniform(low, high, (1, len(low))), (_VIEWS, 1))
        for joint, rows in enumerate(np.array_split(np.arange(_VIEWS), 6)):
            q[rows, joint] = np.linspace(low[joint], high[joint], len(rows))
    rng = np.random.default_rng([seed, 9])
    moved = np.vstack([np.zeros(6), np.sign(np.diff(q, axis=0))])
    wrong = _OFFSET * rng.standard_normal(6) * bool(kind.right)
    true = q + wrong + kind.soft * gravity_torques(arm, q) - kind.play * moved
    T = flange(arm, true) @ frames.exp(np.repeat([2e-5, 0.02], 3) * rng.normal(size=(_VIEWS, 6)))
    X = frames.make(Rotation.random(rng=rng).as_matrix(), 1500 * rng.normal(size=3))
    X = np.eye(4) if kind.at_base else X
    T_sensor_flange = frames.inverse(X) @ T
    dh = zip(arm.a, np.degrees(arm.alpha), arm.d, np.degrees(arm.theta), strict=True)
    table = [dict(zip(("a", "alpha_deg", "d", "theta_deg"), map(float, row), strict=True)) for row in dh]
    robot = robot_from_dh("arm", "standard", table, None, np.array([0, 0, -9.81]), "mm")
    reported = [forward(robot, angles) for angles in q]
    sightings = [_sighting(kind, i, T_sensor_flange[i], rng) for i in range(_VIEWS)]
    views = tuple(
        View(f"v{i}", None, reported[i], q[i], moved[i], 10.0 * i, {}, sightings[i]) for i in range(_VIEWS)
    )  # fmt: skip
    scanner = Scanner(None, 0.01, None, np.array([0, 0, 1.0]), "tracker" if kind.stated else None)
    return SessionData(Path("arm"), "arm", "mm", "eye_to_hand", scanner, robot, None, None, None, views)


def _sighting(kind: Kind, view: int, T_sensor_flange: Array, rng: np.random.Generator) -> Sighting:
    """What the sensor shows in one view."""
    places = _PLACES[: kind.targets] + kind.slip * (view >= _VIEWS // 2) * np.array([1.0, 0.0, 0.0])
    points = frames.transform(T_sensor_flange, places) + 0.01 * rng.normal(size=places.shape)
    if kind.probe:
        R = T_sensor_flange[:3, :3] @ _PROBE_TURN @ Rotation.from_rotvec(3e-5 * rng.normal(size=3)).as_matrix()
        return Sighting(("probe",), points[:1], np.full(1, 0.01), R, 3e-5)
    return Sighting(tuple(f"t{k}" for k in range(len(places))), points, np.full(len(places), 0.01))


def suggested_jobs(seeds: range) -> Iterator[Row]:
    """A session of every kind for each seed."""
    for seed in seeds:
        yield from ({"kind": kind, "seed": seed} for kind in SESSIONS)


def suggested_trial(job: Row) -> Row:
    """What is named first, what the final model holds, and what of it should not be there."""
    kind = SESSIONS[job["kind"]]
    state = run(session_of_kind(kind, job["seed"]))
    first = diagnose(state)
    result, _, last = suggest(state, 5)
    final = result or state
    small = {term.name for term in final.terms if term.sigmas_from_zero < _SIGMAS}
    return {
        "first": [first.verdict, *first.effects],
        "final": list(final.effects),
        "last": last.verdict,
        "wrong": first.verdict == "missing_effect" and first.effects[0] not in kind.right,
        "zero": sorted(small - kind.right),
        "weak": sorted(small & kind.right),
        "again": [effect for effect in last.effects if effect in final.tried],
    }


def suggested_summary(rows: list[Row]) -> list[str]:
    """Counts by kind."""
    marks = ("wrong", "zero", "weak", "again")
    groups = with_all(grouped(rows, "kind"))
    lines = ([kind, len(group), *(sum(bool(r[m]) for r in group) for m in marks)] for kind, group in groups.items())
    return markdown("kind | sessions | first single name wrong | at zero | weak | named again", lines)


SUGGESTED = Table(suggested_jobs, suggested_trial, suggested_summary, range(700, 706))
