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
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bench.harness import Row, Table, grouped, markdown, share, with_all
from data_synth.arms import ARMS, Arm
from data_synth.fixtures.labelled_arm import joints_of, labelled_cell
from data_synth.kinematics import flange, gravity_torques
from data_synth.laws.unnamed import UNNAMED
from data_synth.moment import Plan
from data_synth.ordinary_arm import OrdinaryArm, draw_arm, with_memory
from stitch import NoResultError
from stitch.api.pipeline import diagnose, run
from stitch.api.stepwise import suggest
from stitch.diagnosis.candidates import candidates_of
from stitch.diagnosis.diagnose import diagnose_state, linear_model_of
from stitch.diagnosis.evidence import gather_evidence
from stitch.diagnosis.score import scatter_limit
from stitch.diagnosis.sensitivity import detectable_sizes, imitated_share
from stitch.diagnosis.thresholds import ALIAS_CORRELATION
from stitch.diagnosis.together import decide_together
from stitch.model.model import Model
from stitch.model.model_toml import arm_model
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.least_squares import significantly_smaller
from stitch.observations.targets.target_model import target_model
from stitch.output.result_document import model_of
from stitch.plugins.metrology.calibrate.other_sessions import keep_what_holds
from stitch.run_data import RunData
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


# What an ordinary arm itself has: of such a one these are no wrong names.
_ORDINARY = ("joint_offset", "link_geometry", "gear_eccentricity")
_SWEPT = {"one joint": 1, "two joints": 2, "all joints": 6}
_ARM_SIZES = (0.0, 0.3, 1.0)
_STEPS, _AT_SWEEP = 6, 2.0  # views up and back again, and multiples of the detectable size
HIDDEN = ("joint_offset", "link_geometry", "joint_compliance", "gear_eccentricity", "gear_harmonic", "backlash")
HIDDEN += ("settling", "part_slip")
# Three sessions of one arm: kg at its flange, where they hang, and what joint 2 or 3 errs by, rad/(N m) and rad.
_LOADS, _LOAD_AT = (0.5, 1.5, 3.0), (0.0, 0.0, 60.0)
_SOFT, _ECCENTRIC = 1.5e-5, 3e-4


def swept_joints(arm: Arm, swept: int, rng: np.random.Generator) -> Array:
    """Return (V, 6) rad: so many joints in turn, each up and back again, several times from other postures; those that
    are not swept stand still."""
    low, high = np.maximum(arm.lower, -np.pi), np.minimum(arm.upper, np.pi)
    chosen = rng.permutation(6)[:swept]
    still = rng.uniform(low, high)
    rows = []
    for joint in np.tile(chosen, 12 // swept):
        posture = still.copy()
        posture[chosen] = rng.uniform(low, high)[chosen]
        ends = np.sort(rng.uniform(low[joint], high[joint], 2)) if swept == 1 else (low[joint], high[joint])
        way = np.linspace(*ends, _STEPS)
        for angle in (*way, *(way[::-1] + 0.02)):
            rows.append(np.where(np.arange(6) == joint, angle, posture))
    return np.array(rows)


def swept_session(
    joints: Array,
    errors: OrdinaryArm | float,
    rng: np.random.Generator,
    hidden: tuple[str, str, float] | None = None,
    load: float | None = None,
) -> SessionData:
    """Return three reflectors on an arm of so much of the usual errors, with one parameter of an effect.

    Args:
        errors: the arm's, or how much of the usual ones.
        hidden: name of the effect, of its parameter, and its value.
        load: kg at the flange, stated; gravity then bends a joint by its whole torque.
    """
    arm = ARMS["ABB IRB 120"]
    errors = errors if isinstance(errors, OrdinaryArm) else draw_arm(6, errors, rng)
    name, parameter, value = hidden or ("", "", 0.0)
    views = len(joints)
    moved = np.vstack([np.zeros(6), np.sign(np.diff(joints, axis=0))])
    before = np.vstack([joints[:1], joints[:-1]])
    joint, _, link = parameter.partition("_")
    one = (
        value * np.ones(6)
        if parameter == "all"
        else value * np.eye(6)[int(joint[-1]) - 1 if joint[-1:].isdigit() else 0]
    )
    hung = replace(arm, mass=np.eye(6)[int(link or 1) - 1], com=np.zeros((6, 3)))
    hung = (
        arm if parameter == "all" else hung if load is None else replace(arm, payload_mass=load, payload_com=_LOAD_AT)
    )
    wave = {"A": np.sin, "B": np.cos}.get(parameter[:1], np.sin)
    of_joints = {
        "joint_offset": one,
        "joint_compliance": one * gravity_torques(hung, joints),
        "gear_eccentricity": one * wave(joints),
        "gear_harmonic": one * wave(2 * joints),
        "backlash": -one * moved,
        "settling": one * (joints - before),
    }.get(name, 0.0)
    rows = {"da": "a", "dd": "d", "dalpha": "alpha"}
    if name == "link_geometry":
        row = rows[parameter.rstrip("0123456789")]
        errors = replace(errors, **{row: getattr(errors, row) + one})
    T = errors.flange(arm, joints + of_joints) @ frames.exp(np.repeat([2e-5, 0.02], 3) * rng.normal(size=(views, 6)))
    X = frames.make(Rotation.random(rng=rng).as_matrix(), 1500 * rng.normal(size=3))
    dh = zip(arm.a, np.degrees(arm.alpha), arm.d, np.degrees(arm.theta), strict=True)
    table = [dict(zip(("a", "alpha_deg", "d", "theta_deg"), map(float, row), strict=True)) for row in dh]
    payload = None if load is None else {"mass": load, "com": list(_LOAD_AT)}
    robot = robot_from_dh("arm", "standard", table, payload, np.array([0, 0, -9.81]), "mm")
    slip = np.zeros((views, 6))
    if name == "part_slip":
        slip[views // 3 :, ("rx", "ry", "rz", "tx", "ty", "tz").index(parameter)] = value
    seen = []
    for v in range(views):
        points = frames.transform(frames.inverse(X) @ T[v] @ frames.exp(slip[v]), _PLACES)
        points = points + 0.01 * rng.normal(size=points.shape)
        seen.append(Sighting(("t0", "t1", "t2"), points, np.full(3, 0.01)))
    of_views = tuple(
        View(f"v{v}", None, forward(robot, joints[v]), joints[v], moved[v], 10.0 * v, {}, seen[v]) for v in range(views)
    )
    scanner = Scanner(None, 0.01, None, np.array([0, 0, 1.0]), "tracker")
    return SessionData(Path("arm"), "arm", "mm", "eye_to_hand", scanner, robot, None, None, None, of_views)


def sweep_jobs(seeds: range) -> Iterator[Row]:
    """Nothing hidden, three seeds in a row with arms of three sizes; and a parameter of each effect."""
    for seed in seeds:
        for swept in _SWEPT:
            yield from ({"hidden": NOTHING, "swept": swept, "size": size, "seed": seed} for size in _ARM_SIZES)
        yield from ({"hidden": name, "swept": "all joints", "size": 0.0, "seed": seed} for name in HIDDEN)


def sweep_trial(job: Row) -> Row:
    """What is said of one world, and whether it is certain."""
    hidden = None
    kinds = (NOTHING, *HIDDEN)
    seeds = [job["seed"], list(_SWEPT).index(job["swept"]), int(10 * job["size"]), kinds.index(job["hidden"])]
    rng = np.random.default_rng(seeds)
    joints = swept_joints(ARMS["ABB IRB 120"], _SWEPT[job["swept"]], rng)
    if job["hidden"] != NOTHING:
        hidden = _at_twice_detectable(
            swept_session(joints, 0.0, np.random.default_rng([*seeds, 1])), job["hidden"], rng
        )
    try:
        found = diagnose_state(run(swept_session(joints, job["size"], np.random.default_rng([*seeds, 1]), hidden)))
    except NoResultError as error:
        return {"verdict": "refused", "named": [], "certain": False, "told": str(error)[:200]}
    named = list(found.effects)
    return {"hidden_as": hidden, "verdict": found.verdict, "named": named, "certain": bool(named) and found.certain}


def _at_twice_detectable(clean: SessionData, name: str, rng: np.random.Generator) -> tuple[str, str, float]:
    """Return an effect, one of its parameters that the sweep shows, and twice its detectable size.

    It shows what no other effect imitates by more than nine tenths, those aside that begin at some view.
    """
    linear = linear_model_of(run(clean))
    candidates = candidates_of(linear)[0]
    candidate = next(c for c in candidates if c.name == name)
    sizes = detectable_sizes(linear, candidate, sum(not c.empirical for c in candidates))
    others = [c.forms[0] for c in candidates if c.name != name and not c.forms[0].term.gridded.any()]
    whites = [linear.residual(form.columns) * form.sizes for form in others]
    shown = []
    for p, column in zip(candidate.forms[0].free, linear.residual(candidate.forms[0].columns).T, strict=True):
        if _AT_SWEEP * sizes[p.name] < p.limit and max(imitated_share(column, X) for X in whites) < ALIAS_CORRELATION:
            shown.append(p.name)
    chosen = shown[int(rng.integers(len(shown)))]
    return name, chosen, float(_AT_SWEEP * sizes[chosen] * rng.choice([-1, 1]))


def sweep_summary(rows: list[Row]) -> list[str]:
    """A line a sweep where nothing is hidden, all of them, and a line an effect."""
    nothing = [r for r in rows if r["hidden"] == NOTHING]
    lines = []
    for group in with_all(grouped(nothing, "swept", "size"), "all").values():
        swept = "all" if len(group) == len(nothing) else f"{group[0]['swept']}, arm of {group[0]['size']}"
        certain = [r["certain"] and r["verdict"] == "missing_effect" for r in group]
        wrong = [c and not (r["size"] and r["named"][0] in _ORDINARY) for c, r in zip(certain, group, strict=True)]
        names = Counter(" or ".join(r["named"]) for r in group if r["certain"])
        told = ", ".join(f"{name} {count}" for name, count in names.items())
        lines.append((NOTHING, swept, share(wrong), "", "", told or "–"))
    for name, group in grouped([r for r in rows if r["hidden"] != NOTHING], "hidden").items():
        right = [r["named"] == [name] for r in group]
        alone = share(r["named"] == [name] and r["verdict"] == "missing_effect" for r in group)
        wrong = [r["verdict"] == "missing_effect" and r["named"] != [name] for r in group]
        others = Counter(" or ".join(r["named"]) or r["verdict"] for r in group if r["named"] != [name])
        lines.append((name, "all joints", share(wrong), share(right), alone, ", ".join(others) or "–"))
    head = "hidden | sweep | certain and wrong, or a wrong single name | right name | without a rival | other answers"
    return markdown(head, lines)


SWEEPS = Table(sweep_jobs, sweep_trial, sweep_summary, range(100, 120), "points", "sweeps")


def load_jobs(seeds: range) -> Iterator[Row]:
    """An arm that gives way, and one whose gear runs out of true."""
    yield from ({"hidden": name, "seed": seed} for seed in seeds for name in ("joint_compliance", "gear_eccentricity"))


def load_trial(job: Row) -> Row:
    """What three sessions with other loads say, each alone and together: one sweep of joints 2 and 3."""
    rng = np.random.default_rng([66, job["seed"], job["hidden"] == "gear_eccentricity"])
    joint = int(rng.integers(2, 4))
    size = _SOFT if job["hidden"] == "joint_compliance" else _ECCENTRIC
    letter = "c" if job["hidden"] == "joint_compliance" else "AB"[int(rng.integers(2))]
    hidden = (
        job["hidden"],
        f"{letter}{joint}",
        float(size * rng.choice([1, 1.5]) * rng.choice([-1, 1]) ** (letter != "c")),
    )
    alone, linears = [], []
    arm = ARMS["ABB IRB 120"]
    still = rng.uniform(-0.5, 0.5, 6)
    for load in _LOADS:
        joints = np.tile(still, (30, 1))
        joints[:, 1:3] = rng.uniform(arm.lower, arm.upper, (30, 6))[:, 1:3]
        state = run(swept_session(joints, 0.0, rng, hidden, load))
        linears.append(linear_model_of(state))
        found = gather_evidence(linears[-1], candidates_of(linears[-1])[0], scatter_limit(state.session))
        alone.append([found.verdict, *(r.name for r in found.named)])
    together = decide_together(linears)
    odds = {c.name: round(c.log_posterior, 1) for c in together.candidates[:3]}
    answer = [together.verdict, *together.effects]
    return {
        "hidden_as": hidden,
        "alone": alone,
        "together": answer,
        "odds": odds,
        "otherwise": together.otherwise,
        "odds_otherwise": together.log_odds_otherwise,
    }


def load_summary(rows: list[Row]) -> list[str]:
    """A line an effect."""
    lines = []
    for name, group in grouped(rows, "hidden").items():
        right = share(r["together"] == ["missing_effect", name] for r in group)
        wrong = share(r["together"][0] == "missing_effect" and r["together"][1] != name for r in group)
        alone = [answer for r in group for answer in r["alone"]]
        open_alone = share(answer[0] == "cannot_tell" and name in answer for answer in alone)
        right_alone = share(answer == ["missing_effect", name] for answer in alone)
        wrong_alone = share(answer[0] == "missing_effect" and answer[1] != name for answer in alone)
        lines.append((name, right, wrong, open_alone, right_alone, wrong_alone))
    return markdown("hidden | together: right | wrong | alone: cannot tell, with the truth | right | wrong", lines)


LOADS = Table(load_jobs, load_trial, load_summary, range(100, 120), "points", "loads")


def day_jobs(seeds: range) -> Iterator[Row]:
    """An arm a seed."""
    yield from ({"seed": seed} for seed in seeds)


def day_trial(job: Row) -> Row:
    """What the arm of one day leaves on the next, of what the nominal arm leaves there."""
    rng = np.random.default_rng([67, job["seed"]])
    arm = ARMS["ABB IRB 120"]
    errors = draw_arm(6, 1.0, rng)
    days = [day_session(arm, errors, views, rng) for views in (60, 40, 40)]
    first = run(days[0])
    found = suggest(first, 8)[0] or first
    held = keep_what_holds(found, days[1:2]).run
    exported = {"alone": (found, days[1]), "on the second": (held, days[2])}
    return {name: _left_on(state, day) for name, (state, day) in exported.items()} | {"effects": list(held.effects)}


def day_session(arm: Arm, errors: OrdinaryArm, views: int, rng: np.random.Generator) -> SessionData:
    """Return one day of an arm: base, tool and the half of its ranges are new."""
    low, high = np.maximum(arm.lower, -2.0), np.minimum(arm.upper, 2.0)
    middle = (low + high) / 2
    upper = rng.integers(2, size=6).astype(bool)
    halved = np.arange(6) < 3
    low, high = np.where(halved & upper, middle, low), np.where(halved & ~upper, middle, high)
    q = rng.uniform(low, high, (views, 6))
    return swept_session(q, errors, rng, ("joint_compliance", "all", 2e-6))


def _left_on(state: RunData, day: SessionData) -> Row:
    """Return the share of the nominal arm's rms that an arm leaves, and whether it is worse beyond chance."""
    kept = arm_model(model_of(state))
    nominal = run(day).view_rms ** 2
    left = nominal if kept is None else run(day, arm=kept).view_rms ** 2
    return {
        "share": float(np.sqrt(np.nanmean(left) / np.nanmean(nominal))),
        "worse": bool(significantly_smaller(nominal, left, 0.05)),
    }


def day_summary(rows: list[Row]) -> list[str]:
    """A line for each way to prove an arm."""
    lines = []
    for name in ("alone", "on the second"):
        shares = [r[name]["share"] for r in rows]
        worse = share(r[name]["worse"] for r in rows)
        lines.append((name, worse, f"{np.median(shares):.2f}", f"{max(shares):.2f}"))
    return markdown("proved | worse than the nominal arm | of what that leaves: median | most", lines)


DAYS = Table(day_jobs, day_trial, day_summary, range(100, 120), "points", "days")
