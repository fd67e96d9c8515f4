"""A mount, a scanner or a part that errs by laws of no library: clouds simulated, run and diagnosed.

DROOP: cells of three scenes with the scanner on the arm, a beam (`data_synth/laws/brackets.py`) at amplitudes 1 and 2,
its true effect added, the hand-eye against the truth. MOUNT: ten other laws of a mount in two scenes each, at amplitude
2: a trend over the views times one twist of the flange; then with the law itself offered beside the library, as a user
would write it. SCANNER: laws of a scanner or a part; seeds below 9100 were used while the code was written.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from bench.harness import Row, Table, grouped, markdown, share
from bench.integrity import MOUNTS, PARTS, measured_cell
from bench.small_cells import scene_of
from data_synth import kinematics
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import Measured, simulated
from data_synth.laws.brackets import end_twist
from data_synth.moment import Moment, Plan
from data_synth.nature import LAWS, Law, Parameters
from stitch.api.pipeline import change, diagnose, run
from stitch.diagnosis.diagnose import diagnose_state
from stitch.diagnosis.diagnosis import Diagnosis
from stitch.diagnosis.thresholds import ODDS
from stitch.effects import EFFECTS, effect, twist
from stitch.errors import StitchError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.run_data import RunData
from stitch.session.measurement import Views

SCENES = ("blade-table", "drill-plate", "spheres")
AMPLITUDES = (1.0, 2.0)
TRUE = "true_law"
# Looking down: there a drooping mount counts as straight.
_DOWN = np.array([0.0, 0.0, 1.0])
# Of the largest displacement from the mean of all views, at amplitude 1: rad, mm.
_TURN, _SHIFT = 2.5e-4, 0.05
_TWIST = ("rx", "ry", "rz", "tx", "ty", "tz")

# What a law of a mount follows, (V,), for a plan.
Trend = Callable[[Plan, np.random.Generator], Array]


def bracket_hysteresis(plan: Plan, rng: np.random.Generator) -> Array:
    """A screwed joint slips on friction: what it bends lags behind gravity."""
    g = _gravity(plan, rng)
    width, behind, at = 0.6 * float(g.std()), [], g[0]
    for x in g:
        at = min(max(at, x - width), x + width)
        behind.append(at)
    return g - np.array(behind)


def two_seats(plan: Plan, rng: np.random.Generator) -> Array:
    """A loose screw: the scanner falls onto one seat or the other."""
    g = _gravity(plan, rng)
    return np.sign(g - np.quantile(g, rng.uniform(0.35, 0.65)))


def cubic_droop(plan: Plan, rng: np.random.Generator) -> Array:
    """A rubber mount that hardly yields at first: the cube of the load about its mean."""
    g = _gravity(plan, rng)
    return (g - g.mean()) ** 3


def rebound_stop(plan: Plan, rng: np.random.Generator) -> Array:
    """A plate that rests on a stop: it bends on one side alone."""
    g = _gravity(plan, rng)
    return np.maximum(g - np.quantile(g, 0.6), 0.0)


def cable_pull(plan: Plan, rng: np.random.Generator) -> Array:
    """The cable pulls at the scanner once the wrist has turned beyond its slack."""
    q = plan.joints[:, -1] - np.median(plan.joints[:, -1])
    return np.sign(q) * np.maximum(np.abs(q) - np.quantile(np.abs(q), 0.4), 0.0)


def hose_weight(plan: Plan, rng: np.random.Generator) -> Array:
    """A hose hangs from the scanner, the longer the farther it is out."""
    return np.linalg.norm(kinematics.flange(plan.arm, plan.joints)[:, :3, 3], axis=1) ** 2


def travelling_slip(plan: Plan, rng: np.random.Generator) -> Array:
    """A magnetic foot creeps with every move, the more the farther it goes."""
    moved = np.abs(np.diff(plan.joints, axis=0, prepend=plan.joints[:1])).sum(axis=1)
    return np.cumsum(moved**2)


def swinging(plan: Plan, rng: np.random.Generator) -> Array:
    """The scanner still swings when it measures, by the size of the last move, in any phase."""
    moved = np.linalg.norm(np.diff(plan.joints, axis=0, prepend=plan.joints[:1]), axis=1)
    return moved * np.cos(rng.uniform(0, 2 * np.pi, len(moved)))


def fan_cycle(plan: Plan, rng: np.random.Generator) -> Array:
    """The bracket warms and cools as the hall's heating switches, four to six times."""
    at = np.arange(len(plan.joints)) / len(plan.joints)
    return np.sin(2 * np.pi * rng.uniform(4, 6) * at + rng.uniform(0, 2 * np.pi))


def snapping(plan: Plan, rng: np.random.Generator) -> Array:
    """A sheet of metal that snaps to and fro, at any view."""
    return np.where(np.cumsum(rng.random(len(plan.joints)) < 0.25) % 2, 1.0, -1.0)


def _gravity(plan: Plan, rng: np.random.Generator) -> Array:
    """(V,) component of gravity along a direction of the flange in which it changes."""
    down = np.einsum("vji,j->vi", kinematics.flange(plan.arm, plan.joints)[:, :3, :3], [0.0, 0.0, -1.0])
    axes = np.linalg.svd(down - down.mean(axis=0), full_matrices=False)[2]
    return down @ (axes[:2].T @ rng.standard_normal(2))


TRENDS: dict[str, Trend] = {
    law.__name__: law
    for law in (
        *(bracket_hysteresis, two_seats, cubic_droop, rebound_stop, cable_pull),
        *(hose_weight, travelling_slip, swinging, fan_cycle, snapping),
    )
}


def _law_of(trend: Trend) -> Law:
    """The law as nature knows laws, so that cells can be simulated with it."""

    def draw(amplitude: float, plan: Plan, rng: np.random.Generator) -> Parameters:
        turn, shift = (x / np.linalg.norm(x) for x in rng.standard_normal((2, 3)))
        values = trend(plan, rng)
        values = values - values.mean()
        values = values / np.abs(values).max()
        xi = amplitude * np.concatenate([_TURN * turn, _SHIFT * shift])
        names = (*_TWIST, *(f"view_{v}" for v in range(len(values))))
        return dict(zip(names, map(float, (*xi, *values)), strict=True))

    def act(p: Parameters, moment: Moment, T: Array) -> Array:
        return frames.exp(np.array([p[name] for name in _TWIST]) * p[f"view_{moment.index}"]) @ T

    return Law("mount", draw, act)


def droop_jobs(seeds: range) -> Iterator[Row]:
    """A cell a seed."""
    for k, seed in enumerate(seeds):
        yield {"scene": SCENES[k % len(SCENES)], "seed": seed, "amplitude": AMPLITUDES[k // len(SCENES) % 2]}


def droop_trial(job: Row) -> Row:
    """What is named, and the largest error of the hand-eye of a flange that looks down, in its sigmas."""
    measured = simulated(scene_of(job["scene"]), {"mount_droop": job["amplitude"]}, job["seed"])
    state = run(session_of(measured))
    diagnosis = diagnose(state)
    kind = "group" if "mount_droop" in diagnosis.effects else "wrong" if diagnosis.effects else diagnosis.verdict
    kind = "named" if diagnosis.effects == ("mount_droop",) else kind
    added = change(state, ["mount_droop"])
    true = frames.exp(end_twist(measured.hidden["mount_droop"], _DOWN)) @ measured.T_mount
    error = frames.log(frames.inverse(added.T_mount) @ true)
    sigmas = np.abs(error) / np.sqrt(np.diag(added.mount_covariance))
    return {"kind": kind, "said": _said(diagnosis), "sigmas": float(sigmas.max())}


def droop_summary(rows: list[Row]) -> list[str]:
    """A line an amplitude."""
    lines = []
    for amplitude, group in grouped(rows, "amplitude").items():
        kinds = Counter(row["kind"] for row in group)
        named = ", ".join(f"{kind} {count}" for kind, count in kinds.items())
        lines.append([f"{amplitude:g}", len(group), named, share(row["sigmas"] <= 3 for row in group)])
    return markdown("amplitude | cells | named | hand-eye within 3 sigma", lines)


def _said(diagnosis: Diagnosis) -> str:
    perhaps = "" if diagnosis.log_odds_over_nothing > ODDS else " (perhaps)"
    return f"{diagnosis.verdict} {' '.join(diagnosis.effects)}{perhaps}"


DROOP = Table(droop_jobs, droop_trial, droop_summary, range(20))


def mount_jobs(seeds: range) -> Iterator[Row]:
    """Every law in two scenes; a seed a cell, from the first one on."""
    for k, law in enumerate([*TRENDS] * 2):
        yield {"law": law, "scene": SCENES[(k + k // len(TRENDS)) % len(SCENES)], "seed": seeds[0] + k}


def mount_trial(job: Row) -> Row:
    """What is said without and with the law itself among the candidates."""
    law = job["law"]
    LAWS[law] = _law_of(TRENDS[law])
    measured = simulated(scene_of(job["scene"]), {law: 2.0}, job["seed"])
    state = run(session_of(measured))
    diagnosis = diagnose(state)
    places = {EFFECTS[name].place for name in diagnosis.effects if name in EFFECTS}
    certain = diagnosis.verdict == "missing_effect" and diagnosis.log_odds_over_nothing > ODDS
    kind = "at the mount" if places == {"mount"} else "a wrong name, certain" if certain else "a wrong name"
    values = np.array([value for name, value in measured.hidden[law].items() if name not in _TWIST])
    offered = _with_the_law(state, values)
    left = {c.name: c.cross_validation.heldout for c in offered.candidates if c.cross_validation}
    best = min(left, key=lambda name: left[name])
    worse = bool(offered.effects) and all(left[name] > left[best] for name in offered.effects if name in left)
    return {
        "kind": kind if diagnosis.effects else diagnosis.verdict,
        "said": _said(diagnosis),
        "offered": "alone" if offered.effects == (TRUE,) else "in a group" if TRUE in offered.effects else "not",
        "said_then": _said(offered),
        "worse": worse,
        "left": dict(sorted(left.items(), key=lambda item: item[1])[:3]),
    }


def _with_the_law(state: RunData, trend: Array) -> Diagnosis:
    """The diagnosis with the law as a user's effect beside the library."""

    def true_law(views: Views, xi: Array) -> Array:
        """M·exp(ξ·c), c the trend"""
        # Views that are yet to be taken go on as the last one.
        return views.at_scanner(np.outer(trend[np.minimum(views.number, len(trend) - 1)], xi))

    effect("mount", xi=twist("", 3e-4, 0.1))(true_law)
    try:
        return diagnose(state)
    finally:
        del EFFECTS[TRUE]


def mount_summary(rows: list[Row]) -> list[str]:
    """How often what was said."""
    counts = Counter(row["kind"] for row in rows)
    counts.update(f"the law offered: named {row['offered']}" for row in rows)
    counts["the law offered: a worse one named"] = sum(row["worse"] for row in rows)
    return markdown(f"of {len(rows)} cells | count", counts.items())


MOUNT = Table(mount_jobs, mount_trial, mount_summary, range(1))

# Of the points (N, 3) of one view, scanner frame, the view's number and the cell.
PointLaw = Callable[[Array, int, Measured], Array]


def along(error: Callable[[Array, Array, Array], Array], growing: bool = False) -> PointLaw:
    """Along the ray by a function (mm) of the place in the field, −1 … 1 both ways, and of the range (mm); from
    nothing to that over the session, or in every view."""

    def law(points: Array, v: int, cell: Measured) -> Array:
        range_mm = np.linalg.norm(points, axis=1)
        error_mm = error(*_field(points), range_mm) * (_elapsed(v, cell) if growing else 1)
        return points + points / range_mm[:, None] * error_mm[:, None]

    return law


def everywhere(matrix: list[list[float]]) -> PointLaw:
    """The scanner's axes by a matrix, less the identity."""
    return lambda points, v, cell: points + points @ np.array(matrix, float).T


def read_line_by_line(points: Array, v: int, cell: Measured) -> Array:
    """The arm still moves by 0.15 mm, elsewhere in every view, while the scanner reads from one edge to the other."""
    way = np.random.default_rng([v, len(points)]).standard_normal(3)
    return points + 0.15 * _field(points)[1][:, None] * way / np.linalg.norm(way)


def bending(points: Array, v: int, cell: Measured) -> Array:
    """The part bends by 0.2 mm at its ends over the session, as a clamp gives way."""
    T = cell.T_reference_scanner[v]
    at = points @ T[:3, :3].T + T[:3, 3]
    along_x = (at[:, 0] - np.median(at[:, 0])) / (0.5 * np.ptp(cell.mesh.vertices[:, 0]))
    return points + 0.2 * _elapsed(v, cell) * (along_x**2)[:, None] * T[2, :3]


def _elapsed(v: int, cell: Measured) -> float:
    """Share of the session."""
    return float((cell.times[v] - cell.times[0]) / np.ptp(cell.times))


def _field(points: Array) -> Array:
    """(2, N) place in the field."""
    field = points[:, :2] / points[:, 2:]
    return (field / np.quantile(np.abs(field), 0.98)).T


POINT_LAWS: dict[str, PointLaw] = {
    "nothing": lambda points, v, cell: points,
    "z longer by 0.3 %": everywhere([[0, 0, 0], [0, 0, 0], [0, 0, 0.003]]),
    "x longer by 0.3 %": everywhere([[0.003, 0, 0], [0, 0, 0], [0, 0, 0]]),
    "x and y askew by 3 mrad": everywhere([[0, 0.003, 0], [0, 0, 0], [0, 0, 0]]),
    "focus tilted, 80 µm": along(lambda a, b, r: 0.08 * a * b),
    "coma, 60 µm": along(lambda a, b, r: 0.06 * a**3),
    "seam in the field, ±60 µm": along(lambda a, b, r: 0.06 * np.sign(a)),
    "ripple over the field, 40 µm": along(lambda a, b, r: 0.04 * np.sin(5 * np.pi * a)),
    "ripple over the range, 40 µm": along(lambda a, b, r: 0.04 * np.sin(2 * np.pi * r / 12)),
    "one corner off, 150 µm": along(lambda a, b, r: 0.15 * np.exp(-((a - 0.6) ** 2 + (b - 0.5) ** 2) / 0.08)),
    "focus tilts by 150 µm over the session": along(lambda a, b, r: 0.15 * a * b, growing=True),
    "read line by line, 150 µm": read_line_by_line,
    "the part bends by 0.2 mm": bending,
}


def scanner_jobs(seeds: range) -> Iterator[Row]:
    """Every law in every cell."""
    for seed in seeds:
        for part in PARTS:
            for mount in MOUNTS:
                yield from ({"part": part, "mount": mount, "seed": seed, "law": law} for law in POINT_LAWS)


def scanner_trial(job: Row) -> Row:
    """Verdict and names for one cell."""
    cell = measured_cell(job["part"], job["mount"], job["seed"])
    law = POINT_LAWS[job["law"]]
    clouds = [replace(c, points=law(c.points, v, cell)) for v, c in enumerate(cell.clouds)]
    try:
        diagnosis = diagnose_state(run(session_of(replace(cell, clouds=clouds))))
    except StitchError as error:
        return {"verdict": "refused", "names": [], "field": False, "changing": False, "said": str(error)}
    changing = diagnosis.scanner_error is not None and diagnosis.scanner_error.by_view
    of_scans = diagnosis.follows_field or diagnosis.scanner_error is not None
    return {
        "verdict": diagnosis.verdict,
        "names": list(diagnosis.effects),
        "field": bool(of_scans),
        "changing": bool(changing),
        "rms": diagnosis.residual_rms,
        "noise": diagnosis.noise_floor,
    }


def scanner_summary(rows: list[Row]) -> list[str]:
    """By law: what was said."""
    lines = []
    for law, group in grouped(rows, "law").items():
        verdicts = Counter(row["verdict"] for row in group)
        counts = [verdicts["adequate"], verdicts["unknown_effect"]]
        counts += [sum(row[key] for row in group) for key in ("field", "changing")]
        counts += [verdicts[name] for name in ("missing_effect", "cannot_tell", "refused")]
        lines.append([law, len(group), *counts])
    head = "the scanner errs by | cells | adequate | unknown | … the scans said | … every view by itself | one name"
    return markdown(f"{head} | a group | refused", lines)


SCANNER = Table(scanner_jobs, scanner_trial, scanner_summary, range(9100, 9102))
