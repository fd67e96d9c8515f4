"""Can the diagnosis be trusted? Hidden effects on simulated cells, judged blind; a session for each trial.

Sizes are multiples of the smallest detectable size of each effect in each cell, which is computed from the same cell
with nothing hidden. Parts: effects, empty, aliases, outside, pairs. Hours on two cores; in any order, so that whatever
has been run so far is a fair sample.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import chain
from zlib import crc32

import numpy as np

from bench.harness import ROOT, Row, Table, grouped, markdown, share
from data_synth import kinematics, nature
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import SMALL_SCENES, plan_for, small_scene
from data_synth.moment import Plan
from data_synth.scene import Scene, load_scene
from data_synth.simulate import Measured, simulate
from stitch.api.pipeline import change, diagnose, run
from stitch.api.stepwise import suggest
from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.diagnose import linear_model_of
from stitch.diagnosis.diagnosis import Diagnosis
from stitch.diagnosis.regime import regime_of
from stitch.diagnosis.score import form_weights
from stitch.diagnosis.sensitivity import least_noncentrality
from stitch.effects import EFFECTS
from stitch.effects.contract import missing_need
from stitch.effects.user_file import load
from stitch.errors import StitchError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.observations.linear_model import LinearModel
from stitch.run_data import RunData
from stitch.session.measurement import Measurement

# The beams of brackets are written in other numbers than the library's.
LIBRARY = tuple(name for name in nature.LAWS if name in EFFECTS and not name.endswith(("_droop", "_bend")))
# Laws without a counterpart in the library, and what a user would write for them.
OUTSIDE = {"third_harmonic": "third_harmonic", "covariate_bias": "humidity_bias"}
# Noise that the model does not have, each about as large as the scanner's own.
HARD = {
    "correlated field": {"field_error": 0.02},
    "heavy tails": {"tail": 3.0},
    "edge bias": {"edge_bias": 0.05},
    "three times the repeatability": {"repeatability": 3.0},
}
HARD["all four"] = {key: value for kind in HARD.values() for key, value in kind.items()}
LAST_JOINT = "the last joint alone"
_USER = ROOT / "examples" / "effects"
_USUAL_SPREAD = 0.18  # of the brightness, in which nature counts it
MULTIPLES = (2.0, 1.0, 4.0, 0.5)
# What follows one of these shows as well as that covariate's trend over the day, which is drawn too.
OF_COVARIATES = (*OUTSIDE, "part_growth", "robot_thermal_growth", "scanner_thermal_scale")


def jobs(seeds: range) -> list[Row]:
    """All trials of all parts in a drawn order; a cell a scene and seed for effects and what is outside the library."""
    cells = [{"scene": scene, "seed": seed} for seed in seeds for scene in SMALL_SCENES]
    todo = list(chain(_effect_jobs(cells), _empty_jobs(), _alias_jobs(), _outside_jobs(cells), _pair_jobs()))
    return [todo[i] for i in np.random.default_rng(0).permutation(len(todo))]


def _effect_jobs(cells: list[Row]) -> Iterator[Row]:
    for cell in cells:
        for effect in LIBRARY:
            yield from ({"part": "effects", **cell, "effect": effect, "multiple": m} for m in MULTIPLES)


def _empty_jobs() -> Iterator[Row]:
    for i in range(100):
        scene = SMALL_SCENES[i % len(SMALL_SCENES)]
        yield {"part": "empty", "scene": scene, "seed": 1000 + i, "noise": ""}
        if i % 2:
            yield {"part": "empty", "scene": scene, "seed": 2000 + i, "noise": list(HARD)[i // 2 % len(HARD)]}


def _alias_jobs() -> Iterator[Row]:
    for i in range(20):
        cell = {"part": "aliases", "scene": "blade", "seed": 3000 + i, "amplitude": (1.0, 2.0)[i % 2]}
        yield {**cell, "effect": "joint_offset", "how": "", "useful": [0]}
        yield {**cell, "effect": "joint_offset", "how": LAST_JOINT}


def _outside_jobs(cells: list[Row]) -> Iterator[Row]:
    for k in range(3):
        for cell in cells:
            for m in (2.0, 4.0):
                seed = 4000 + 10 * k + cell["seed"]
                yield from ({"part": "outside", **cell, "seed": seed, "effect": e, "multiple": m} for e in OUTSIDE)


def _pair_jobs() -> Iterator[Row]:
    rng = np.random.default_rng(5)
    for i in range(30):
        two = [str(e) for e in rng.choice(LIBRARY, 2, replace=False)]
        cell = {"scene": SMALL_SCENES[i % len(SMALL_SCENES)], "seed": 5000 + i // 10}
        yield {"part": "pairs", **cell, "effects": two, "multiple": 4.0}


def trial(job: Row) -> Row:
    """Hide what the job says, run, diagnose; a part's own row."""
    parts = {"effects": _effect, "empty": _empty, "aliases": _alias, "outside": _outside, "pairs": _pair}
    try:
        return parts[job["part"]](job)
    except StitchError as error:
        return {"verdict": f"no result: {error}", "named": [], "follows": []}


@lru_cache(maxsize=8)
def _cell_without(scene: str, seed: int, chance: int | None) -> tuple[Plan, LinearModel]:
    """The cell of a scene and a seed, with nothing hidden; `chance` as in `measure`."""
    measured = measure(scene, seed, {}, chance=chance)
    return measured.plan, linear_model_of(run(session_of(measured)))


def _chance(job: Row) -> int:
    """A seed of the job's own: trials in one cell must not share their noise."""
    return 10_000 + crc32(json.dumps(job, sort_keys=True).encode()) % 1_000_000


def _sizes(job: Row, laws: list[str]) -> dict[str, float] | None:
    """Amplitudes of the laws at the job's multiple of their smallest detectable size."""
    needs_chance = any(law in OF_COVARIATES for law in laws)
    plan, linear = _cell_without(job["scene"], job["seed"], _chance(job) if needs_chance else None)
    true = drawn(job["scene"], plan, linear.measurement, laws, _chance(job))
    out = {}
    for law in laws:
        effect = user_effect(law) if law in OUTSIDE else law
        size = smallest(linear, effect, true[law])
        if law in OUTSIDE:
            del EFFECTS[effect]
        if size is None:
            return None
        out[law] = size * job["multiple"]
    return out


def _diagnosed(job: Row, hidden: dict[str, float], how: str = "") -> tuple[Measured, RunData, Diagnosis, Row]:
    measured = measure(job["scene"], job["seed"], hidden, how, tuple(job.get("useful", ())), _chance(job))
    state = run(session_of(measured))
    diagnosis = diagnose(state)
    row = {
        "hidden": {name: measured.hidden[name] for name in hidden},
        "verdict": diagnosis.verdict,
        "named": list(diagnosis.effects),
        "p": min((s.ranked.adjusted for s in diagnosis.candidates if s.name in diagnosis.effects), default=1.0),
        "follows": [d.covariate for d in diagnosis.depends_on[:3] if d.p_value < 0.05],
        "scatter": [diagnosis.rotation * 1e6, diagnosis.translation * 1e3],
        "top": [(s.name, round(s.ranked.score.log_bayes_factor, 2)) for s in diagnosis.candidates[:3]],
        "hand_eye_chi_square": hand_eye_chi_square(measured, state),
    }
    return measured, state, diagnosis, row


def _effect(job: Row) -> Row:
    """One effect of the library; where it is named alone and clear, it is added too."""
    hidden = _sizes(job, [job["effect"]])
    if hidden is None:
        return {"verdict": "not shown"}
    measured, state, diagnosis, row = _diagnosed(job, hidden)
    if job["multiple"] >= 2 and job["effect"] in diagnosis.effects:
        row["added"] = _added(measured, state, change(state, [job["effect"]]), job["effect"])
        if job["multiple"] == 4:
            row["added"]["knowing"] = run(session_of(measured), effects=[job["effect"]]).heldout_rms
    return row


def _added(measured: Measured, before: RunData, after: RunData, effect: str) -> Row:
    """What the change brought: held-out residual, hand-eye against the truth, amplitudes in sigmas."""
    true = in_session_units(measured)[effect]
    fitted = {p.name: p for p in after.terms[0].parameters if not p.grid and p.name in true and p.fitted}
    return {
        "heldout": [before.heldout_rms, after.heldout_rms],
        "hand_eye": [hand_eye_error(measured, before.T_mount), hand_eye_error(measured, after.T_mount)],
        "hand_eye_sigma": hand_eye_sigma(measured, after.mount_covariance),
        "hand_eye_chi_square": hand_eye_chi_square(measured, after),
        "z": {name: (p.value - true[name]) / p.sigma for name, p in fitted.items()},
    }


def _empty(job: Row) -> Row:
    """Nothing hidden."""
    return _diagnosed(job, {}, job["noise"])[3]


def _alias(job: Row) -> Row:
    """What these views cannot tell from the hand-eye, at a size of nature's own."""
    return _diagnosed(job, {job["effect"]: job["amplitude"]}, job["how"])[3]


def _outside(job: Row) -> Row:
    """A law without a name in the library; then its user writes it down."""
    hidden = _sizes(job, [job["effect"]])
    if hidden is None:
        return {"verdict": "not shown"}
    _, state, diagnosis, row = _diagnosed(job, hidden)
    if diagnosis.verdict == "unknown_effect":
        name = user_effect(job["effect"])
        try:
            again = diagnose(state)
            added = change(state, [name])
        finally:
            del EFFECTS[name]
        floor = run(session_of(measure(job["scene"], job["seed"], {}, chance=_chance(job))))
        row["user"] = {"named": list(again.effects), "heldout": [added.heldout_rms, floor.heldout_rms]}
    return row


def _pair(job: Row) -> Row:
    """Two effects at once."""
    hidden = _sizes(job, job["effects"])
    if hidden is None:
        return {"verdict": "not shown"}
    measured = measure(job["scene"], job["seed"], hidden, chance=_chance(job))
    result, _, last = suggest(run(session_of(measured)), 4)
    return {"verdict": last.verdict, "named": list(last.effects), "found": [] if result is None else result.effects}


def summary(rows: list[Row]) -> list[str]:
    """The tables of all parts that have rows."""
    parts = grouped([row for row in rows if row["verdict"] != "not shown"], "part")
    tables = {"effects": _effects_table, "empty": _empty_table, "aliases": _aliases_table, "outside": _outside_table}
    tables["pairs"] = _pairs_table
    return [line for part, table in tables.items() if part in parts for line in [*table(parts[part]), ""]]


def _detected(row: Row) -> bool:
    return bool(row["verdict"] != "adequate")


def _right(row: Row) -> bool:
    return row["effect"] in row["named"]


def _effects_table(rows: list[Row]) -> list[str]:
    lines = ["### Effects of the library at multiples of their smallest detectable size", ""]
    sizes = []
    for m, group in sorted(grouped(rows, "multiple").items()):
        wrong = share(r["verdict"] == "missing_effect" and not _right(r) for r in group)
        right = share(_right(r) for r in group if _detected(r))
        sizes.append([f"{m:g}×", share(map(_detected, group)), right, wrong])
    head = "size | detected | right one named, or in the named group, when detected | confident wrong name"
    lines += [*markdown(head, sizes), ""]
    effects = []
    for name, group in sorted(grouped(rows, "effect").items()):
        large = [r for r in group if r["multiple"] >= 2]
        noticed = [r for r in large if _detected(r)]
        others = sorted({"+".join(r["named"]) or r["verdict"] for r in noticed if not _right(r)})
        sizes = [[r for r in group if r["multiple"] == 0.5], [r for r in group if r["multiple"] == 1], large]
        counts = [f"{sum(map(_detected, of_size))}/{len(of_size)}" for of_size in sizes]
        effects.append([name, *counts, f"{sum(map(_right, noticed))}/{len(noticed)}", ", ".join(others)])
    head = "effect | at 0.5× | at 1× | at 2× and 4× | right when detected there | otherwise called"
    return [*lines, *markdown(head, effects), "", *_added_table([r["added"] for r in rows if "added" in r])]


def _added_table(rows: list[Row]) -> list[str]:
    if not rows:
        return []
    z = np.array([value for r in rows for value in r["z"].values()])
    before, after = np.array([r["hand_eye"] for r in rows]).T
    sigma = np.array([r["hand_eye_sigma"] for r in rows])
    known = [abs(r["heldout"][1] / r["knowing"] - 1) < 0.05 for r in rows if "knowing" in r]
    middle = np.subtract(*np.percentile(z, [84.13, 15.87])) / 2
    figures = {
        "held-out residual falls": share(r["heldout"][1] < r["heldout"][0] for r in rows),
        "held-out residual within 5 % of a run that knew the effect": share(known),
        "amplitudes within 2 sigma": share(np.abs(z) < 2),
        "SD of (found − true)/sigma": f"{np.sqrt(np.mean(z**2)):.2f}, of its middle {middle:.2f}, n = {len(z)}",
        "hand-eye nearer to the truth": share(after < before),
        "hand-eye farther from it, by more than its sigma": share(after - before > sigma),
        "hand-eye: χ²/6 of its error, mean": _chi_square(rows),
        "hand-eye error, median, before → after": f"{np.median(before):.3f} → {np.median(after):.3f} mm",
    }
    return ["### After adding the right effect", "", *markdown("what | figure", figures.items())]


def _chi_square(rows: list[Row]) -> str:
    squares = [r["hand_eye_chi_square"] / 6 for r in rows if "hand_eye_chi_square" in r]
    return f"{np.mean(squares):.2f}" if squares else "–"


def _empty_table(rows: list[Row]) -> list[str]:
    usual, harder = [r for r in rows if not r["noise"]], [r for r in rows if r["noise"]]
    groups = {"usual noise": usual, **grouped(harder, "noise"), "all of the harder ones": harder}
    groups |= {f"usual noise, {scene}": group for scene, group in grouped(usual, "scene").items()}
    lines = ([name, share(map(_detected, group)), _chi_square(group)] for name, group in groups.items() if group)
    return ["### Nothing hidden", "", *markdown("cells | wrong alarms | hand-eye: χ²/6 of its error, mean", lines)]


def _aliases_table(rows: list[Row]) -> list[str]:
    lines = []
    for how, group in grouped(rows, "how").items():
        called = sorted({r["verdict"] + (f" ({'+'.join(r['named'])})" if r["named"] else "") for r in group})
        name = f"joint_offset, {how}" if how else "offset of joint 1 alone"
        lines.append([name, share(r["verdict"] != "missing_effect" for r in group), ", ".join(called)])
    return ["### Exact aliases of the hand-eye", "", *markdown("hidden | never a single name | called", lines)]


def _outside_table(rows: list[Row]) -> list[str]:
    lines = []
    groups = dict(sorted(grouped(rows, "effect", "multiple").items()))
    groups |= {("all", m): group for m, group in sorted(grouped(rows, "multiple").items())}
    for (name, multiple), group in groups.items():
        user = [r["user"] for r in group if "user" in r]
        verdicts = [r["verdict"] for r in group]
        shares = [
            share(v == "unknown_effect" for v in verdicts),
            share(v == "missing_effect" for v in verdicts),
            share(_follows(r) for r in group if r["verdict"] == "unknown_effect"),
            share(len(u["named"]) == 1 for u in user),
            share(u["heldout"][0] < 1.05 * u["heldout"][1] for u in user),
        ]
        lines.append([name, f"{multiple:g}×", *shares])
    head = (
        "hidden | size | unknown_effect | confident wrong name | right covariate among the first three | the user's "
        "own effect is named then | held-out residual within 5 % of the floor after adding it"
    )
    return ["### Effects outside the library", "", *markdown(head, lines)]


def _follows(row: Row) -> bool:
    """The right covariate: the angle of the joint, humidity."""
    if row["effect"] == "third_harmonic":
        joint = next(iter(row["hidden"]["third_harmonic"])).removeprefix("A")
        return any(f.startswith((f"j{joint}", f"joint {joint}")) for f in row["follows"])
    return any("humidity" in f for f in row["follows"])


def _pairs_table(rows: list[Row]) -> list[str]:
    figures: dict[str, Callable[[Row], bool]] = {
        "both found": lambda r: set(r["effects"]) <= set(r["found"]),
        "at least one found": lambda r: bool(set(r["effects"]) & set(r["found"])),
        "something else added": lambda r: bool(set(r["found"]) - set(r["effects"])),
    }
    lines = ([name, share(map(hit, rows))] for name, hit in figures.items())
    return ["### Two effects at once, `stitch add RUN --suggested`", "", *markdown("what | share", lines)]


def harder(scene: Scene, hard: str, useful: tuple[int, ...]) -> Scene:
    """Return a scene with harder noise, and with joints whose errors nature may draw."""
    changes = dict(HARD[hard]) if hard else {}
    factor = changes.pop("repeatability", 1.0)
    repeatability = (scene.repeatability[0] * factor, scene.repeatability[1] * factor)
    scanner = replace(scene.scanner, **changes)
    return replace(scene, scanner=scanner, repeatability=repeatability, useful=useful or scene.useful)


def measure(
    name: str, seed: int, hidden: dict[str, float], how: str = "", useful: tuple[int, ...] = (),
    chance: int | None = None,
) -> Measured:  # fmt: skip
    """Return one session of the views planned for a seed; `how` names hard noise or LAST_JOINT.

    Args:
        chance: seed of what nature and the instruments draw, if it is not that of the plan.
    """
    alone = how == LAST_JOINT
    plan, rail = plan_for(load_scene(name), seed)
    if alone:
        plan, rail = _last_joint_only(plan, rail)
    planned = (replace(plan, useful=useful or plan.useful), rail)
    scene = harder(small_scene(name), "" if alone else how, useful)
    return simulate(scene, hidden, seed if chance is None else chance, planned=planned)


def _last_joint_only(plan: Plan, rail: Array) -> tuple[Plan, Array]:
    """The first view's joints, and the last joint turning on by 360° in all."""
    joints = np.repeat(plan.joints[:1], len(plan.joints), axis=0)
    joints[:, -1] += np.linspace(0, 2 * np.pi, len(joints), endpoint=False)
    torque = kinematics.gravity_torques(plan.arm, joints)
    return replace(plan, joints=joints, torque=torque), np.full_like(rail, rail[0])


def drawn(
    name: str, plan: Plan, measurement: Measurement, laws: Sequence[str], chance: int
) -> dict[str, dict[str, float]]:
    """Return what nature draws for these laws, in this order, at amplitude 1 in this very cell, as a model counts
    it."""
    out = nature.draw(dict.fromkeys(laws, 1.0), 0.0, plan, np.random.default_rng([chance, 2]))[1]
    if "part_growth" in out:
        # About another origin than the part's own, growth is a motion too.
        off = measurement.scan_views[0].origin - load_scene(name).T_reference_part[:3, 3]
        out["part_growth"] |= dict(zip(("cx", "cy", "cz"), out["part_growth"]["g"] * off, strict=True))
    return out


def user_effect(law: str) -> str:
    """Load the example that describes a law outside the library; return its effect's name."""
    return load(_USER / f"{OUTSIDE[law]}.py")[0]


def smallest(linear: LinearModel, effect: str, true: dict[str, float]) -> float | None:
    """Return the factor on the parameters `true` that is detectable at the least; None where cell or belief cannot
    hold it."""
    if missing_need(linear.measurement, EFFECTS[effect]) or not true:
        return None
    candidate = candidate_of(linear, EFFECTS[effect])
    if candidate is None:
        return None
    linear = linear.restricted(linear.causes - {effect})
    values = np.array([true.get(p.name, 0.0) for p in candidate.parameters])
    fitted = np.array([not p.grid for p in candidate.parameters])
    sizes = []
    for form, weight in zip(candidate.forms, form_weights(candidate), strict=True):
        # Forms that hold all of the truth, at the value of the grid that is nearest to it.
        off = np.abs(form.term.values - values)[~fitted].sum()
        if not values[fitted & ~form.keep].any():
            white = linear.residual(form.columns)
            freedom = linear.satterthwaite.degrees_of_freedom(linear.in_blocks(white))
            scales = regime_of(linear).scales
            least = least_noncentrality(white * form.sizes, float(weight), len(EFFECTS), freedom, scales)
            sizes.append((off, np.sqrt(least) / max(float(np.linalg.norm(white @ values[form.keep])), 1e-12)))
    nearest = min(off for off, _ in sizes)
    amplitude = float(min(size for off, size in sizes if off == nearest))
    # Four times that must still be of a size that somebody would believe.
    limits = np.array([p.limit for p in candidate.parameters])
    return amplitude if (np.abs(values) * 4 * amplitude < limits)[fitted].all() else None


def in_session_units(measured: Measured) -> dict[str, dict[str, float]]:
    """Return what is hidden, brightness counted as a session counts it: in its own standard deviations."""
    hidden = {name: dict(values) for name, values in measured.hidden.items()}
    if "intensity_bias" in hidden:
        spread = float(np.concatenate([cloud.intensity for cloud in measured.clouds]).std())
        hidden["intensity_bias"]["k"] *= spread / _USUAL_SPREAD
    return hidden


def hand_eye_error(measured: Measured, T_mount: Array) -> float:
    """Return the rms displacement (mm) of points of the field, half of it wide, by the error of the hand-eye."""
    field = _field(measured)
    moved = frames.transform(T_mount, field) - frames.transform(measured.T_mount, field)
    return float(np.sqrt((moved**2).sum(axis=1).mean()))


def hand_eye_sigma(measured: Measured, covariance: Array) -> float:
    """Return the same as a covariance (6, 6) of the right perturbation predicts it."""
    jacobians = [np.hstack([-frames.skew(p), np.eye(3)]) for p in _field(measured)]
    return float(np.sqrt(np.mean([np.trace(J @ covariance @ J.T) for J in jacobians])))


def _field(measured: Measured) -> Array:
    scanner = measured.scene.scanner
    half = scanner.standoff * np.tan(np.radians(scanner.field_of_view / 4))
    return np.array([[x, y, scanner.standoff] for x in (-half, half) for y in (-half, half)])


def hand_eye_chi_square(measured: Measured, state: RunData) -> float:
    """Return the error of the hand-eye against its covariance; 6 on the average where that is right."""
    xi = frames.log(frames.inverse(state.T_mount) @ measured.T_mount)
    return float(xi @ np.linalg.solve(state.mount_covariance, xi))


TABLE = Table(jobs, trial, summary, range(2), page="how-often-right", block="tables")
