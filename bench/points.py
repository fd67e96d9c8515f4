"""Labelled points: is what is named there?

SWEEPS: an arm of which single joints are swept, as much wrong as arms are, and one effect at twice its detectable size.
LOADS: one effect under three loads, each session alone and all together. DAYS: what the arm of one day leaves on the
next. In all of them three reflectors on an ABB IRB 120 stand before a tracker.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from bench.harness import Row, Table, grouped, markdown, share, with_all
from data_synth.arms import ARMS, Arm
from data_synth.kinematics import gravity_torques
from data_synth.ordinary_arm import OrdinaryArm, draw_arm
from stitch import NoResultError
from stitch.api.pipeline import run
from stitch.api.stepwise import suggest
from stitch.diagnosis.candidates import Candidate, Form, candidates_of
from stitch.diagnosis.diagnose import diagnose_state, linear_model_of
from stitch.diagnosis.evidence import gather_evidence
from stitch.diagnosis.score import scatter_limit
from stitch.diagnosis.sensitivity import detectable_sizes, imitated_share
from stitch.diagnosis.thresholds import ALIAS_CORRELATION
from stitch.diagnosis.together import decide_together
from stitch.model.model_toml import arm_model
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.least_squares import significantly_smaller
from stitch.output.result_document import model_of
from stitch.plugins.metrology.calibrate.other_sessions import keep_what_holds
from stitch.run_data import RunData
from stitch.session.reading.robot_description import robot_from_dh
from stitch.session.robot import forward
from stitch.session.session import Scanner, SessionData, Sighting, View

NOTHING = "nothing hidden"
_PLACES = np.array([[60.0, 10.0, 30.0], [-40.0, 55.0, 25.0], [-20.0, -60.0, 40.0]])
# What an ordinary arm itself has: of such a one these are no wrong names.
_ORDINARY = ("joint_offset", "link_geometry", "gear_eccentricity")
_SWEPT = {"one joint": 1, "two joints": 2, "all joints": 6}
_ARM_SIZES = (0.0, 0.3, 1.0)
_STEPS, _AT_SWEEP = 6, 2.0  # views up and back again, and multiples of the detectable size
_SLIPS_AT = 48  # view of 144
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
    number = int(joint[-1]) - 1 if joint[-1:].isdigit() else 0
    one = value * (np.ones(6) if parameter == "all" else np.eye(6)[number])
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
        slip[_SLIPS_AT:, ("rx", "ry", "rz", "tx", "ty", "tz").index(parameter)] = value
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

    It shows what no other effect imitates by more than nine tenths: a jump, also by jumps at that view.
    """
    linear = linear_model_of(run(clean))
    candidates = candidates_of(linear)[0]
    candidate = next(c for c in candidates if c.name == name)
    sizes = detectable_sizes(linear, candidate, sum(not c.empirical for c in candidates))
    form, jumps = _beginning(candidate), candidate.forms[0].term.gridded.any()
    others = [_beginning(c) for c in candidates if c.name != name and (jumps or not c.forms[0].term.gridded.any())]
    whites = [linear.residual(other.columns) * other.sizes for other in others]
    shown = []
    for p, column in zip(form.free, linear.residual(form.columns).T, strict=True):
        if _AT_SWEEP * sizes[p.name] < p.limit and max(imitated_share(column, X) for X in whites) < ALIAS_CORRELATION:
            shown.append(p.name)
    chosen = shown[int(rng.integers(len(shown)))]
    return name, chosen, float(_AT_SWEEP * sizes[chosen] * rng.choice([-1, 1]))


def _beginning(candidate: Candidate) -> Form:
    """Return the form that begins where part_slip does here, or the first of what begins nowhere."""
    return min(
        candidate.forms, key=lambda f: next((abs(p.value - _SLIPS_AT) for p in f.term.parameters if p.discrete), 0)
    )


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
    value = float(size * rng.choice([1, 1.5]) * rng.choice([-1, 1]) ** (letter != "c"))
    hidden = (job["hidden"], f"{letter}{joint}", value)
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
