"""Mistakes put into good sessions, and what the deep check, data snooping and a run find there, and in sessions without
any.

GOOD: sessions without a mistake, some with an effect that a model may lack, some whose joints err anew in every view
(`--only "joints scatter"`). MISTAKES: each mistake of `mistakes` in every cell, of which `--set every=N` takes every
N-th in a cell, another in the next. Seeds 0 to 99 were used while the checks were
written, 1000 and above are run once.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bench.harness import Row, Table, grouped, markdown, with_all
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import simulated, with_part
from data_synth.scene import load_scene
from data_synth.simulate import Measured
from stitch.api.pipeline import run
from stitch.errors import StitchError
from stitch.fit.correct import icp_hand_eye
from stitch.model.model import Model
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.observations.surfaces.view_poses import unconstrained_poses
from stitch.screening.deep_check import deep_check
from stitch.screening.plausibility import apply_displacement_limits
from stitch.screening.snooping import Snooping, snoop_views
from stitch.screening.view_model import UsualEffects
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of
from stitch.session.robot import forward
from stitch.session.session import Cloud, SessionData

PARTS: dict[str, dict[str, Any]] = {
    "blade": {},
    "curved_drill_plate": {"length": 150.0, "width": 120.0, "pitch": 36.0, "radius": 150.0},
    "sphere_plate": {},
}
MOUNTS = {"eye_to_hand": "blade", "eye_in_hand": "blade-table"}
VIEWS, RAYS = 14, 120
OTHER_MOUNT = {"eye_to_hand": "eye_in_hand", "eye_in_hand": "eye_to_hand"}
Change = Callable[[SessionData], SessionData]
TEN_DEGREES = np.radians(10) * np.eye(6)[2]  # of the third joint
# Effects that a model may lack while a session is good: they must not cost it a view.
HIDDEN: tuple[dict[str, float], ...] = (
    {},
    {},
    {"joint_compliance": 2.0},
    {"scanner_thermal_scale": 0.5},
    {"joint_offset": 2.0},
    {"backlash": 3.0},
    {"link_geometry": 2.0, "gear_eccentricity": 2.0},
)
_JOINT_SCATTER = 30e-6  # rad
_START_GATE = 6.0  # mm: the hand-eye starts near its end
# Too small a mistake for these cells to tell: nothing may be said of it.
_BELOW = "shift 0.2 mm"


@lru_cache(maxsize=2)
def measured_cell(
    part: str, mount: str, seed: int, hidden: tuple[tuple[str, float], ...] = (), joint_scatter: float = 0.0
) -> Measured:
    """Return one cell; its joints scatter by so many rad from view to view."""
    scene = load_scene(MOUNTS[mount])
    scene = replace(scene, scanner=replace(scene.scanner, columns=RAYS, rows=RAYS), joint_repeatability=joint_scatter)
    if part != "blade":
        scene = with_part(scene, part, **PARTS[part])
    return simulated(scene, dict(hidden), seed, VIEWS)


@dataclass(frozen=True)
class Mistake:
    """A mistake: what it does to a session, its accepted kinds, and the views of which one must be named."""

    apply: Change
    kinds: tuple[str, ...]
    views: tuple[int, ...] = ()  # empty: the whole session


def poses_of(session: SessionData) -> Array:
    """(V, 4, 4)."""
    return np.array([view.T_base_flange for view in session.views])


def with_poses(session: SessionData, T: Array) -> SessionData:
    """The session with other poses and no joints."""
    views = zip(session.views, T, strict=True)
    return replace(session, views=tuple(replace(view, T_base_flange=pose, joints=None) for view, pose in views))


def with_clouds(session: SessionData, clouds: dict[int, Array]) -> SessionData:
    """The session with other points in some views."""
    views = enumerate(session.views)
    return replace(session, views=tuple(replace(w, cloud=Cloud(clouds[v])) if v in clouds else w for v, w in views))


def shown(session: SessionData, v: int) -> Array:
    """(N, 3) points of one view."""
    cloud = session.views[v].cloud
    assert cloud is not None
    return cloud.points


def displaced(twists: dict[int, Array]) -> Change:
    """Poses of some views with a right twist of the flange (rad, mm)."""

    def apply(session: SessionData) -> SessionData:
        T = poses_of(session)
        for v, twist in twists.items():
            T[v] = T[v] @ frames.exp(twist)
        return with_poses(session, T)

    return apply


def moved_clouds(order: dict[int, int]) -> Change:
    """The cloud of view `order[v]` in the row of v."""
    return lambda session: with_clouds(session, {v: shown(session, w) for v, w in order.items()})


def turned(change: Callable[[Rotation], Rotation]) -> Change:
    """Rotations of all poses rewritten."""

    return posed(lambda T: frames.make(change(Rotation.from_matrix(T[:, :3, :3])).as_matrix(), T[:, :3, 3]))


def _torn(points: Array, shift: Array) -> Array:
    """Half of a scan moved: the part was knocked while it was scanned."""
    later = points[:, 0] > np.median(points[:, 0])
    return points + later[:, None] * shift


def posed(change: Callable[[Array], Array]) -> Change:
    """Poses (V, 4, 4) changed, or in another order."""
    return lambda session: with_poses(session, change(poses_of(session)))


def _clouds(change: Callable[[Array], Array], views: Sequence[int] | None = None) -> Change:
    def apply(session: SessionData) -> SessionData:
        those = range(len(session.views)) if views is None else views
        return with_clouds(session, {v: change(shown(session, v)) for v in those})

    return apply


def _joints(change: Callable[[SessionData], Array], v: int) -> Change:
    def apply(session: SessionData) -> SessionData:
        assert session.robot is not None
        views = list(session.views)
        q = change(session)
        views[v] = replace(views[v], joints=q, T_base_flange=forward(session.robot, q))
        return replace(session, views=tuple(views))

    return apply


def _reclamped(start: int, twist: Array) -> Change:
    def apply(session: SessionData) -> SessionData:
        T, K = poses_of(session), frames.exp(twist)
        # The part moves on the flange, or the flange's poses are off by a motion of the base frame.
        T[start:] = T[start:] @ K if session.mount == "eye_to_hand" else K @ T[start:]
        return with_poses(session, T)

    return apply


def in_base_frame(T_reference_scanner: Array) -> Mistake:
    """All clouds in the reference frame already."""

    def apply(session: SessionData) -> SessionData:
        return with_clouds(
            session, {v: frames.transform(T, shown(session, v)) for v, T in enumerate(T_reference_scanner)}
        )

    return Mistake(apply, ("mount",))


def mistakes(views: int, rng: np.random.Generator) -> dict[str, Mistake]:
    """The table: name to mistake."""
    a, b, c = (int(v) for v in rng.permutation(views)[:3])
    u = rng.standard_normal(3)
    u /= np.linalg.norm(u)
    none = np.zeros(3)

    def shift(d: float) -> Array:
        return np.r_[none, d * u]

    plane = np.c_[rng.uniform(-40, 40, (2500, 2)), np.zeros(2500)]
    wavy = plane + np.c_[np.zeros((2500, 2)), 420 + 9 * np.sin(plane[:, 0] / 7) + 0.02 * rng.standard_normal(2500)]
    one = ("displaced",)
    pose = ("displaced", "duplicate_pose", "joint_row")
    next_row = max(a - 1, 0) if a else 1
    table = {f"shift {d} mm": Mistake(displaced({a: shift(d)}), one, (a,)) for d in (0.2, 1.0, 5.0, 60.0)}
    table |= {
        "turn 2 deg": Mistake(displaced({a: np.r_[np.radians(2) * u, none]}), one, (a,)),
        "two shifted 5 mm": Mistake(displaced({a: shift(5.0), b: shift(-5.0)}), one, (a, b)),
        "three shifted 1 mm": Mistake(displaced({a: shift(1.0), b: shift(-1.0), c: shift(1.0)}), one, (a, b, c)),
        "two exchanged": Mistake(moved_clouds({a: b, b: a}), ("exchanged",), (a, b)),
        "three exchanged": Mistake(moved_clouds({a: b, b: c, c: a}), ("exchanged",), (a, b, c)),
        "shifted by 1": Mistake(posed(lambda T: np.roll(T, 1, axis=0)), ("shifted",)),
        "shifted by -2": Mistake(posed(lambda T: np.roll(T, -2, axis=0)), ("shifted",)),
        "reversed": Mistake(posed(lambda T: T[::-1]), ("reversed",)),
        "inverse": Mistake(posed(frames.inverse), ("inverse", "mount")),
        "mount": Mistake(lambda s: replace(s, mount=OTHER_MOUNT[s.mount]), ("mount", "inverse")),
        "euler ZYX as xyz": Mistake(turned(lambda R: Rotation.from_euler("xyz", R.as_euler("ZYX"))), ("euler",)),
        "euler XYZ as ZYX": Mistake(turned(lambda R: Rotation.from_euler("ZYX", R.as_euler("XYZ"))), ("euler",)),
        "euler xyz as XYZ": Mistake(turned(lambda R: Rotation.from_euler("XYZ", R.as_euler("xyz"))), ("euler",)),
        "rotation vector as xyz": Mistake(turned(lambda R: Rotation.from_euler("xyz", R.as_rotvec())), ("euler",)),
        "radians as degrees": Mistake(turned(lambda R: Rotation.from_rotvec(np.radians(R.as_rotvec()))), ("degrees",)),
        "quaternion w first": Mistake(
            turned(lambda R: Rotation.from_quat(R.as_quat()[:, [3, 0, 1, 2]])), ("quaternion",)
        ),
        "quaternion conjugate": Mistake(turned(lambda R: R.inv()), ("quaternion",)),
        "poses in inches": Mistake(posed(lambda T: frames.make(T[:, :3, :3], T[:, :3, 3] / 25.4)), ("unit",)),
        "poses in m": Mistake(posed(lambda T: frames.make(T[:, :3, :3], T[:, :3, 3] / 1000)), ("unit",)),
        "clouds scaled 1.0254": Mistake(_clouds(lambda p: p * 1.0254), ("scale",)),
        "clouds mirrored": Mistake(_clouds(lambda p: p * [-1, 1, 1]), ("mirrored",)),
        "one scaled 1.0254": Mistake(_clouds(lambda p: p * 1.0254, [a]), ("scale",), (a,)),
        "one in inches": Mistake(_clouds(lambda p: p / 25.4, [a]), ("unit",), (a,)),
        "one mirrored": Mistake(_clouds(lambda p: p * [-1, 1, 1], [a]), ("mirrored",), (a,)),
        "other part": Mistake(_clouds(lambda p: wavy, [a]), ("foreign",), (a,)),
        "three points": Mistake(_clouds(lambda p: p[:: len(p) // 2][:3], [a]), ("foreign",), (a,)),
        "a line": Mistake(_clouds(lambda p: np.linspace(p[0], p[-1], 400), [a]), ("foreign",), (a,)),
        "one torn 1 mm": Mistake(_clouds(lambda p: _torn(p, u), [a]), one, (a,)),
        "one torn 5 mm": Mistake(_clouds(lambda p: _torn(p, 5 * u), [a]), one, (a,)),
        "copy of a scan": Mistake(moved_clouds({a: b}), ("duplicate_scan",), (a,)),
        "copy of a pose": Mistake(
            posed(lambda T: np.concatenate([T[:a], T[b : b + 1], T[a + 1 :]])), ("duplicate_pose", "joint_row"), (a,)
        ),
        "neighbour's joints": Mistake(_joints(lambda s: np.array(s.views[next_row].joints), a), pose[1:], (a,)),
        "digit of a joint": Mistake(_joints(lambda s: s.views[a].joints + TEN_DEGREES, a), pose, (a,)),
        "re-clamped half way": Mistake(_reclamped(views // 2, np.r_[0.1, 0.08, -0.07, 4, 4, 3.5]), ("reclamped",)),
        "re-clamped late": Mistake(_reclamped(views - 4, np.r_[0.03, -0.02, 0.01, 1.0, -2.0, 1.0]), ("reclamped",)),
    }  # fmt: skip
    return table


NOTHING = Mistake(lambda session: session, ())


def cells(seeds: range) -> Iterator[Row]:
    """Every part on every mount."""
    for seed in seeds:
        for part in PARTS:
            yield from ({"part": part, "mount": mount, "seed": seed} for mount in MOUNTS)


def good_jobs(seeds: range) -> Iterator[Row]:
    """Every cell with one of the effects in turn, and with joints that scatter."""
    for cell in cells(seeds):
        yield {**cell, "case": "+".join(HIDDEN[cell["seed"] % len(HIDDEN)]) or "nothing hidden"}
        yield {**cell, "case": "joints scatter"}


def good_trial(job: Row) -> Row:
    """What is left out wrongly."""
    scatter = _JOINT_SCATTER if job["case"] == "joints scatter" else 0.0
    hidden = {} if scatter else HIDDEN[job["seed"] % len(HIDDEN)]
    measured = measured_cell(job["part"], job["mount"], job["seed"], tuple(hidden.items()), scatter)
    session = session_of(measured)
    tests = snooped(session, measured.T_mount)
    return {
        "tested_out": list(tests.left_out),
        # A step that an effect may be is left to the diagnosis: what a run leaves out is what costs anybody anything.
        "left_out": [item.view for item in run(session).left_out] if tests.left_out else [],
        "steps": [step.start for step in tests.steps],
        "suspected": [suspect.view for suspect in tests.suspected],
        "groups": len(tests.disconnected),
    }


def snooped(session: SessionData, T_mount: Array) -> Snooping:
    """Return what a run would see: hand-eye corrected, views freed, tests."""
    capture = prepare_capture(session)
    T_mount, overlaps, _ = icp_hand_eye([capture], T_mount, [_START_GATE])
    gate = overlaps[0].gate
    views = unconstrained_poses(capture, capture.poses(T_mount), gate)
    usual = UsualEffects(measurement_of(session, capture), Model(T_mount))
    return apply_displacement_limits(session, snoop_views(capture, T_mount, views, usual))


def good_summary(rows: list[Row]) -> list[str]:
    """A line a case: in how many sessions something was left out or suspected."""
    lines = []
    for case, group in with_all(dict(sorted(grouped(rows, "case").items()))).items():
        counts = [sum(bool(row[what]) for row in group) for what in ("tested_out", "left_out", "suspected")]
        lines.append([case, len(group), *counts])
    head = "sessions without a mistake | sessions | a test leaves out | a run leaves out | a view suspected"
    return markdown(head, lines)


GOOD = Table(good_jobs, good_trial, good_summary, range(1))


def mistake_jobs(seeds: range, every: int) -> Iterator[Row]:
    """The mistakes in every cell."""
    names = ["nothing", *mistakes(VIEWS, np.random.default_rng(0)), "clouds in base frame"]
    for k, cell in enumerate(cells(seeds)):
        yield from ({**cell, "case": case} for n, case in enumerate(names) if (n + k) % every == 0)


def mistake_trial(job: Row) -> Row:
    """What the deep check says of a cell with one mistake."""
    measured = measured_cell(job["part"], job["mount"], job["seed"])
    session = session_of(measured)
    if job["case"] == "clouds in base frame":
        return judged(session, in_base_frame(prepare_capture(session).poses(measured.T_mount)))
    table = {"nothing": NOTHING, **mistakes(VIEWS, np.random.default_rng([job["seed"], 8]))}
    return judged(session, table[job["case"]])


def judged(good: SessionData, mistake: Mistake) -> Row:
    """Return what the deep check says of a session in which a mistake is made."""
    session = mistake.apply(good)
    try:
        problems = [(p.kind, list(p.views), p.fix) for p in deep_check(session)]
    except StitchError as error:
        problems = [("refused", [], str(error))]
    culprits = {session.views[v].name for v in mistake.views}
    named = any(kind in mistake.kinds and (not culprits or culprits & set(views)) for kind, views, _ in problems)
    touched = {view for _, views, _ in problems for view in views}
    return {"said": problems, "silent": not problems, "named": named, "culprit": culprits <= touched}


def mistake_summary(rows: list[Row]) -> list[str]:
    """A line a mistake."""
    cases = {case: group for case, group in grouped(rows, "case").items() if case != "nothing"}
    large_enough = [row for row in rows if row["case"] not in ("nothing", _BELOW)]
    lines = []
    for case, group in {**cases, "all but those too small to be told": large_enough}.items():
        counts = [sum(bool(row[what]) for row in group) for what in ("silent", "culprit", "named")]
        lines.append([case, len(group), *counts])
    return markdown("mistake | cells | silent | culprit among those named | kind of mistake named", lines)


MISTAKES = Table(mistake_jobs, mistake_trial, mistake_summary, range(1), settings={"every": 1})
