"""Do names hold, and do unknowns stay unknown? Worlds that no model holds, judged blind.

Every cell is simulated and run once; what its views show in other worlds is then drawn. Sizes of effects are multiples
of what an arm that only scatters would show at the least in that cell. Seeds are of two kinds: those of development, 0
and 1, and held-out ones, to be run once for each version of the diagnosis; used up: 848 to 963. `--set before=true`
asks as if poses scattered independently from view to view; `--set fewer=N` takes the first N-th of the trials. True
poses and points follow data_synth's own laws, the noise is that of the normal equations.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np

from bench.blind import LIBRARY, drawn, smallest
from bench.harness import Row, Table, grouped, markdown, share
from data_synth import kinematics, nature
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import SMALL_SCENES, plan_for, small_scene
from data_synth.laws.unnamed import IN_TIME, UNNAMED
from data_synth.moment import Moment, Plan
from data_synth.nature import Nature
from data_synth.ordinary_arm import OrdinaryArm, draw_arm, with_memory
from data_synth.scanner import Cloud
from data_synth.scene import Scene, load_scene
from data_synth.simulate import moments_of, on_rail, simulate
from stitch.diagnosis.candidates import Candidate, candidates_of
from stitch.diagnosis.evidence import gather_evidence
from stitch.diagnosis.score import ScatterLimit
from stitch.diagnosis.sensitivity import least_noncentrality
from stitch.diagnosis.thresholds import IMPLAUSIBLE, ODDS
from stitch.diagnosis.unmodelled_time_effects import find_repeating_errors
from stitch.diagnosis.verdict import Evidence
from stitch.effects import EFFECTS
from stitch.fit.correct import COARSE_SAMPLES
from stitch.model.model import Model
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.reml import fit_variances
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.hand_eye_fit import capture_repeatability
from stitch.observations.surfaces.matching import Match, sample_points
from stitch.observations.surfaces.normal_equations import collect_overlaps, gram, next_gate, robust_scale
from stitch.observations.surfaces.surface_model import SurfaceObservation, surface_model
from stitch.observations.surfaces.view_poses import UnconstrainedPoses, unconstrained_poses, visible_step
from stitch.session.capture import part_size, prepare_capture
from stitch.session.measurement import Measurement, measurement_of, with_part_origin

USUAL = ScatterLimit(*IMPLAUSIBLE)
MULTIPLES = (1, 2, 3, 4, 6)
# Worlds with several effects, asked again after each that is named.
AGAIN, ASKED_AGAIN = ("beside", "two", "three"), 4
MUST_SHOW = ("effect", *AGAIN, *(f"unnamed_{n}x" for n in MULTIPLES))
OF_THE_ARM = ("joint_offset", "link_geometry", "gear_eccentricity")
# Usual sizes of a law, 0.15 mrad or 0.05 mm rms: what errs by more is broken.
_MOST = 10.0
SCATTER = np.repeat([20e-6, 0.02], 3)  # of the flange, rad and mm
# First distance between partners, as a share of the part: poses scatter by far less.
GATE = 0.05
# Weights follow the distances; after these steps both stand still.
_STEPS = 8


@dataclass(frozen=True)
class LinearCell:
    """One simulated session, its views freed about the true hand-eye."""

    name: str  # of the scene
    seed: int
    plan: Plan
    rail: Array  # (V,)
    T_mount: Array  # (4, 4) true
    measurement: Measurement
    views: UnconstrainedPoses
    noise_factor: float
    # What is asked of it; the same for every draw, but for the numbers that are seen.
    scene: Scene
    moments: list[Moment]
    linear: LinearModel
    candidates: list[Candidate]


@dataclass(frozen=True)
class World:
    """What is true in one draw of a cell."""

    laws: Nature
    arm: OrdinaryArm | None = None
    joint_errors: Array | float = 0.0  # (V, n) rad
    flange_errors: Array | float = 0.0  # (V, 6) rad, mm, in the flange's frame
    scatter: Array | float = 1.0  # (V, 6) in units of 20 µm and 20 µrad; 1.0: independent from view to view


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
    cells = [(seed, name) for seed in seeds for name in SMALL_SCENES]
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


@lru_cache(maxsize=16)
def linear_cell(name: str, seed: int) -> LinearCell:
    """Simulate a session with nothing wrong but scatter, free its views, linearise about the true hand-eye."""
    plan, rail = plan_for(load_scene(name), seed)
    scene = small_scene(name)
    measured = simulate(scene, {}, seed, planned=(plan, rail))
    session, T_mount = session_of(measured), measured.T_mount
    measurement = with_part_origin(measurement_of(session, prepare_capture(session)), T_mount)
    capture = measurement.capture
    poses = capture.poses(T_mount)
    samples = [sample_points(scan, COARSE_SAMPLES) for scan in capture.scans]
    coarse = collect_overlaps(capture, poses, GATE * part_size([capture]), samples)
    views = unconstrained_poses(capture, poses, next_gate(coarse, capture))
    noise_factor = capture_repeatability(capture, views, T_mount).noise_factor
    linear = surface_model(measurement, Model(T_mount), capture, views)
    moments = moments_of(scene, plan, measurement.views.time, measurement.views.covariates)
    candidates = candidates_of(linear)[0]
    made = (name, seed, plan, rail, T_mount, measurement, views, noise_factor)
    return LinearCell(*made, scene=scene, moments=moments, linear=linear, candidates=candidates)


def shown(cell: LinearCell, T_reference_scanner: Array, rng: np.random.Generator) -> UnconstrainedPoses:
    """Return what the overlaps would show of true poses (V, 4, 4), with the noise of their normal equations."""
    g = cell.views.overlaps.gram
    to_centre = frames.make(np.eye(3), -g.centre)
    model = cell.measurement.capture.poses(cell.T_mount)
    twists = frames.log(to_centre @ T_reference_scanner @ frames.inverse(to_centre @ model))
    visible = g.visible
    noise = np.sqrt(cell.noise_factor * g.variance / visible.values) * rng.standard_normal(len(visible.values))
    # The common motion is what no overlap shows.
    twists = twists - twists.mean(axis=0) + (visible.scale * (visible.vectors @ noise)).reshape(-1, 6)
    return replace(cell.views, twists=twists)


def seen(cell: LinearCell, world: World, rng: np.random.Generator) -> LinearModel:
    """Return the linear model of what the overlaps would show of this world."""
    views = shown(cell, true_poses(cell, world, rng), rng)
    views = with_moved_points(views, cell.measurement, cell.scene, world.laws, cell.moments)
    assert isinstance(cell.linear.observation, SurfaceObservation)
    reduced = cell.linear.observation.reduced_poses
    z = reduced.reduction @ views.twists.ravel()
    mixed = replace(cell.linear.mixed, z=z[None])
    observation = replace(cell.linear.observation, reduced_poses=replace(reduced, z=z), unconstrained=views)
    return replace(cell.linear, observation=observation, mixed=mixed, null=fit_variances(mixed, both_starts=True))


def with_overlaps_of(cell: LinearCell, world: World, linear: LinearModel) -> LinearModel:
    """Return the model with the same twists, but overlaps in which only the laws of this world have moved points."""
    assert isinstance(linear.observation, SurfaceObservation)
    moved = with_moved_points(cell.views, cell.measurement, cell.scene, world.laws, cell.moments)
    views = replace(linear.observation.unconstrained, overlaps=moved.overlaps)
    return replace(linear, observation=replace(linear.observation, unconstrained=views))


def true_poses(cell: LinearCell, world: World, rng: np.random.Generator) -> Array:
    """Return (V, 4, 4) of the scanner where the part is held to stand still, reference frame."""
    laws, T_reference_part = world.laws, cell.scene.T_reference_part
    views = len(cell.moments)
    scatter = world.scatter * rng.standard_normal((views, 6)) if isinstance(world.scatter, float) else world.scatter
    off = frames.exp(scatter * SCATTER + world.flange_errors)
    joint_errors = np.broadcast_to(world.joint_errors, cell.plan.joints.shape)
    out = []
    for v, moment in enumerate(cell.moments):
        q = laws.act("joints", moment, moment.joints) + joint_errors[v]
        arm = laws.act("arm", moment, moment.arm)
        T = kinematics.flange(arm, q) if world.arm is None else world.arm.flange(arm, q[None])[0]
        T = on_rail(laws.act("base", moment, T), cell.rail[v]) @ off[v]
        mount = laws.act("mount", moment, cell.T_mount)
        moved = T_reference_part @ frames.inverse(laws.act("part", moment, T_reference_part))
        out.append(moved @ (frames.inverse(T) if cell.measurement.eye_to_hand else T) @ mount)
    return np.array(out)


def true_column(cell: LinearCell, world: World) -> Array:
    """Return (6V,) twists of the views that the law alone makes."""
    still = np.random.default_rng(0)
    bare = replace(world, joint_errors=0.0, flange_errors=0.0, scatter=np.zeros((len(cell.moments), 6)))
    with_law = true_poses(cell, replace(world, scatter=bare.scatter), still)
    without = true_poses(cell, bare, still)
    to_centre = frames.make(np.eye(3), -cell.views.overlaps.gram.centre)
    return frames.log(to_centre @ with_law @ frames.inverse(to_centre @ without)).ravel()


def with_moved_points(
    views: UnconstrainedPoses, measurement: Measurement, scene: Scene, laws: Nature, moments: list[Moment]
) -> UnconstrainedPoses:
    """Return views that were freed with the points as they are, freed anew after the laws have moved the points.

    The pairs stay: laws of the sizes that are asked move points by less than the noise.
    """
    if not any(map(laws.touches, ("points", "surface"))):
        return views
    moved = [
        frames.rotate(T, _moved(v, views, measurement, scene, laws, moments[v])) for v, T in enumerate(views.poses)
    ]
    matches = [_with(m, moved[m.v][m.index_v] - moved[m.w][m.index_w]) for m in views.overlaps.matches]
    g, twists = views.overlaps.gram, views.twists
    g = gram(matches, g.views, g.centre, robust_scale(matches))
    for _ in range(_STEPS):
        step = visible_step(g)
        twists = twists + step
        matches = [_with(m, _carried(m, step, g.centre)) for m in matches]
        g = gram(matches, g.views, g.centre, robust_scale(matches))
    return replace(views, twists=twists, overlaps=replace(views.overlaps, matches=matches, gram=g))


def _with(m: Match, further: Array) -> Match:
    """The correspondences with points of the first view further (M, 3) from those of the second."""
    return replace(m, residual=m.residual + np.einsum("ij,ij->i", further, m.normal))


def _carried(m: Match, twists: Array, centre: Array) -> Array:
    """(M, 3) how far twists (V, 6) about a centre carry the first view from the second."""
    turn, shift = np.split(twists[m.v] - twists[m.w], 2)
    return np.cross(turn, m.middle - centre) + shift


def _moved(
    v: int, views: UnconstrainedPoses, measurement: Measurement, scene: Scene, laws: Nature, moment: Moment
) -> Array:
    """(N, 3) how far the laws move the points of view v, scanner frame; 0 for points without a partner."""
    scan, view = measurement.capture.scans[v], measurement.scan_views[v]
    partners = [m.index_v if m.v == v else m.index_w for m in views.overlaps.matches if v in (m.v, m.w)]
    at = np.unique(np.concatenate([np.zeros(0, np.int64), *partners]))
    points, out = scan.points[at], np.zeros_like(scan.points)
    T = frames.inverse(scene.T_reference_part) @ views.poses[v]
    on_part = laws.act("surface", moment, frames.transform(T, points))
    bright = np.full(len(at), 0.5) if view.intensity is None else 0.5 + 0.18 * view.intensity[at]
    cloud = Cloud(frames.transform(frames.inverse(T), on_part), bright, view.cosine[at])
    out[at] = laws.act("points", moment, cloud).points - points
    return out


TABLE = Table(jobs, trial, summary, range(2), settings={"before": False, "fewer": 1})
