"""Honest arms that are bad, and flanges that only turn: what a session of labelled points is refused for, and how far
the hand-eye is off.

Kinematics, errors and sightings are written down here; of the library only the session, its check and the run are used.

MEASURED: measured sessions of the shared data, before and after `add --suggested`; of half the poses of the IRB 120,
what its arm leaves in the other half. Idle: no parameter differs from zero by two sigmas, for what that is worth.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from bench.harness import SHARED_DATA, Row, Table, grouped, markdown, share
from stitch import NoResultError, run
from stitch.api.stepwise import suggest
from stitch.model.model_toml import arm_model
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.output.result_document import model_of
from stitch.screening.deep_check import deep_check
from stitch.session.reading.session_folder import load_session
from stitch.session.session import Mount, Scanner, SessionData, Sighting, View

NOISE = 0.05  # mm, of a coordinate that the sensor shows
THREE_SIGMA = chi2.ppf(0.9973, 6)
# Axes of the joints ("x" slides), and where each stands from the one before, mm; what nobody knows of the arm: offsets
# of joints (rad, of slides mm), turns (rad) and shifts (mm) of links, scatter of its poses (rad, mm).
WORLDS: dict[str, tuple[str, list[tuple[float, float, float]], tuple[float, float, float, float, float]]] = {
    "cable arm": ("zyyzyz", [(0, 0, 300), (0, 0, 50), (0, 0, 350), (90, 0, 0), (230, 0, 0), (0, 0, 60)],
                  (2e-3, 1e-3, 0.5, 4e-3, 1.7)),
    "humanoid": ("yxzyzyx", [(0, 180, 0), (0, 30, 0), *[(0, 0, -120)] * 3, (0, 0, -100), (0, 0, -30)],
                 (8e-3, 3e-3, 1.0, 3e-3, 0.5)),
    "seven axes": ("zyzyzyz", [(0, 0, 340), (0, 0, 0), (0, 0, 400), (0, 0, 0), (0, 0, 400), (0, 0, 0), (0, 0, 126)],
                   (1e-3, 5e-4, 0.3, 1e-4, 0.08)),
    "uncalibrated": ("zyyxyx", [(0, 0, 400), (150, 0, 0), (0, 0, 600), (300, 0, 100), (300, 0, 0), (100, 0, 0)],
                     (3e-3, 2e-3, 2.0, 3e-5, 0.03)),
    "SCARA": ("zzZz", [(0, 0, 400), (325, 0, 0), (275, 0, 0), (0, 0, -100)], (3e-3, 1e-3, 0.5, 5e-5, 0.02)),
    "gantry": ("XYZzy", [(0, 0, 0), (0, 0, 0), (0, 0, 900), (0, 0, -50), (0, 0, -80)], (1e-3, 2e-3, 0.5, 5e-5, 0.3)),
}  # fmt: skip
TIMES = (0.0, 0.5, 2.0, 8.0)
_FAINT = 2.0
_BALLS = np.array([[60.0, 10.0, 30.0], [-40.0, 55.0, 25.0], [-20.0, -60.0, 40.0], [10.0, 5.0, 95.0]])


def pose(rotation_vector: Array, shift: Array) -> Array:
    """Return (4, 4)."""
    return frames.make(Rotation.from_rotvec(rotation_vector).as_matrix(), shift)


def labelled_session(poses: list[Array], seen: list[Array], mount: Mount) -> SessionData:
    """Return the session of flanges (4, 4) and of what each view shows (K, 3)."""
    names = tuple(f"t{k}" for k in range(len(seen[0])))
    of_views = (Sighting(names, points, np.full(len(points), NOISE)) for points in seen)
    views = [
        View(f"v{i}", None, T, None, None, None, {}, s) for i, (T, s) in enumerate(zip(poses, of_views, strict=True))
    ]
    scanner = Scanner(None, NOISE, None, np.array([0, 0, 1.0]))
    return SessionData(Path("arm"), "arm", "mm", mount, scanner, None, None, None, None, tuple(views))


def seen_by(
    true: list[Array], X: Array, places: Array, mount: Mount, rng: np.random.Generator, noise: float = NOISE
) -> list[Array]:
    """Return the targets (K, 3) in the sensor's frame, a view each."""
    to_sensor = [np.linalg.inv((T if mount == "eye_in_hand" else np.linalg.inv(T)) @ X) for T in true]
    return [places @ T[:3, :3].T + T[:3, 3] + noise * rng.normal(size=places.shape) for T in to_sensor]


def turning_session(job: Row) -> tuple[SessionData, Array]:
    """A flange that turns at one place, or within some mm of it, and the true hand-eye (4, 4)."""
    rng = np.random.default_rng([66, job["seed"], job["targets"], int(job["within"])])
    X = pose(Rotation.random(rng=rng).as_rotvec(), rng.normal(size=3) * (40 if job["mount"] == "eye_in_hand" else 800))
    board = np.stack(np.meshgrid(np.arange(11), np.arange(8), [0.0]), -1).reshape(-1, 3) * 20 - [100, 70, 0]
    if job["targets"] < 40:
        board = rng.uniform(-150, 150, (job["targets"], 3))
    board = board[: job["targets"]]
    places = board + np.array([700, 50, 100]) if job["mount"] == "eye_in_hand" else board + np.array([20, -30, 90])
    flange, true = [], []
    for _ in range(19):
        tilt = rng.normal(size=3)
        shift = rng.normal(size=3)
        shift *= job["within"] * rng.uniform() / np.linalg.norm(shift)
        T = pose(tilt * rng.uniform(0.2, 0.7) / np.linalg.norm(tilt), np.array([700, 50, 500]) + shift) @ pose(
            [0, np.pi, 0], 0
        )
        flange.append(T)
        true.append(T @ pose(5e-5 * rng.normal(size=3), 0.03 * rng.normal(size=3)))
    return labelled_session(flange, seen_by(true, X, places, job["mount"], rng), job["mount"]), X


def turning(job: Row) -> Row:
    """Whether the hand-eye lies within three sigmas of the truth."""
    session, X = turning_session(job)
    try:
        fit = run(session)
    except NoResultError as error:
        return {"ended": str(error)[:200], "open": "do not show the hand-eye" in str(error)}
    off = np.linalg.inv(fit.T_mount) @ X
    xi = np.append(Rotation.from_matrix(off[:3, :3]).as_rotvec(), off[:3, 3])
    distance = float(xi @ np.linalg.solve(fit.hand_eye.covariance, xi))
    return {"ended": "", "open": bool(fit.unobservable), "sigmas2": distance, "mm": float(np.linalg.norm(xi[3:]))}


def turning_summary(rows: list[Row]) -> list[str]:
    """A line a number of targets and a room of positions, both mounts together."""
    lines = []
    for (targets, within), group in grouped(rows, "targets", "within").items():
        inside = share(r["open"] or r.get("sigmas2", np.inf) < THREE_SIGMA for r in group)
        worst = max((r["mm"] for r in group if "mm" in r), default=np.nan)
        told = sum(r["open"] for r in group), sum(bool(r["ended"]) for r in group)
        lines.append((targets, within, inside, *told, f"{worst:.2f}"))
    return markdown(
        "targets | positions within, mm | within three sigmas, or open | said to be open | refused | farthest off, mm",
        lines,
    )


def _chain(axes: str, q: Array, links: Array, off: Array) -> Array:
    T = np.eye(4)
    for axis, angle, link, wrong in zip(axes, q, links, off, strict=True):
        along = np.eye(3)["xyz".index(axis.lower())]
        T = T @ pose(np.zeros(3), link) @ pose(wrong[:3], wrong[3:])
        T = T @ (pose(np.zeros(3), angle * along) if axis.isupper() else pose(angle * along, np.zeros(3)))
    return T


def bad_arm(job: Row) -> Row:
    """One of the worlds, with the base moved from one view on by some times the arm's scatter: what is said of it."""
    rng = np.random.default_rng([67, job["seed"], list(WORLDS).index(job["world"]), int(10 * job["times"])])
    axes, links, (offset, turn, shift, angle, length) = WORLDS[job["world"]]
    views, mount = int(rng.integers(10, 61)), ("eye_to_hand", "eye_in_hand")[int(rng.integers(2))]
    slides = np.array([axis.isupper() for axis in axes])
    off = np.concatenate([turn * rng.normal(size=(len(axes), 3)), shift * rng.normal(size=(len(axes), 3))], axis=1)
    wrong = rng.normal(size=len(axes)) * np.where(slides, 0.5, offset)
    X = pose(Rotation.random(rng=rng).as_rotvec(), rng.normal(size=3) * (60 if mount == "eye_in_hand" else 1500))
    joints = rng.uniform(-1.1, 1.1, (views, len(axes))) * np.where(slides, 250, 1)
    nominal = [_chain(axes, q, np.array(links, float), 0 * off) for q in joints]
    true = [
        _chain(axes, q + wrong, np.array(links, float), off)
        @ pose(angle * rng.normal(size=3), length * rng.normal(size=3))
        for q in joints
    ]
    scatter = _scatter(nominal, true)
    places = _BALLS if mount == "eye_to_hand" else _BALLS + np.mean([T[:3, 3] for T in nominal], axis=0) + [0, 0, 300]
    start = int(rng.integers(views // 3, 2 * views // 3 + 1)) if job["times"] else views
    way = rng.normal(size=3)
    knock = pose(rng.normal(size=3) * job["times"] * scatter / 2000, job["times"] * scatter * way / np.linalg.norm(way))
    true = [*true[:start], *(knock @ T for T in true[start:])]
    found = deep_check(labelled_session(nominal, seen_by(true, X, places, mount, rng), mount))
    moved = [v.views[0] for v in found if v.kind == "reclamped"]
    right = bool(moved) and abs(int(moved[0][1:]) - start) <= 1 and len(found) == 1
    return {
        "views": views,
        "scatter": scatter,
        "found": [p.line([])[:120] for p in found],
        "moved": right,
        "wrongly": bool(found) and not right,
    }


def _scatter(nominal: list[Array], true: list[Array]) -> float:
    """How far the flange is off, rms (mm), under the rigid motion of the base that suits best."""
    there, stated = (np.array([T[:3, 3] for T in poses]) for poses in (true, nominal))
    _, rest = Rotation.align_vectors(there - there.mean(axis=0), stated - stated.mean(axis=0))
    return float(rest / np.sqrt(len(there)))


def bad_summary(rows: list[Row]) -> list[str]:
    """A line a world and a size of the knock."""
    lines = []
    for (world, times), group in grouped(rows, "world", "times").items():
        scatter = np.median([r["scatter"] for r in group])
        lines.append(
            (world, f"{scatter:.2g}", times, share(r["moved"] for r in group), share(r["wrongly"] for r in group))
        )
    return markdown("arm | off, rms mm | base moved by, times that | named with its view | said wrongly", lines)


def turning_jobs(seeds: range, **_: Any) -> Iterator[Row]:
    """Each number of targets, mount and room."""
    cells = [
        (k, within, mount)
        for k in (3, 10, 40, 88)
        for within in (0, 1, 10, 50)
        for mount in ("eye_in_hand", "eye_to_hand")
    ]
    yield from ({"targets": k, "within": w, "mount": m, "seed": s} for k, w, m in cells for s in seeds)


def bad_jobs(seeds: range, **_: Any) -> Iterator[Row]:
    """Each world and size of the knock."""
    yield from ({"world": w, "times": t, "seed": s} for w in WORLDS for t in TIMES for s in seeds)


TURNING = Table(turning_jobs, turning, turning_summary, range(100, 120), page="points", block="turning")
BAD_ARMS = Table(bad_jobs, bad_arm, bad_summary, range(100, 120), page="points", block="bad-arms")


def measured_jobs(seeds: range, **_: Any) -> Iterator[Row]:
    """The sets, of the IRB 120 also the even poses and the odd ones."""
    names = [f"reghec/{name}" for name in ("cone", "david", "gripperopen", "rubik", "sphere")]
    names += ["irb120-tracker", "irb120-tracker, even", "irb120-tracker, odd", "ur10-tmac-C", "ur10-tmac-A"]
    yield from ({"set": name} for name in names)


def measured(job: Row) -> Row:
    """What `add --suggested` makes of one set, and of the other half of its poses."""
    folder, _, half = job["set"].partition(", ")
    session = load_session(SHARED_DATA / folder)
    parts = [_every_second(session, first) for first in ((0, 1) if half == "even" else (1, 0))]
    state = run(parts[0] if half else session)
    found, *_ = suggest(state, 5)
    final = found or state
    fitted = [(t, p) for t in final.terms for p in t.parameters if p.fitted and not p.grid and not t.is_geometry]
    row = {
        "before": state.heldout_or_fit_rms,
        "after": final.heldout_or_fit_rms,
        "effects": list(final.effects),
        "idle": [t.name for t in final.terms if t.sigmas_from_zero < _FAINT],
        "large": sorted({f"{t.name} {p.name}" for t, p in fitted if p.beyond_belief(p.value, p.sigma)}),
    }
    arm = arm_model(model_of(final))
    if half:
        row |= {"nominal": run(parts[1]).residual_rms, "other": run(parts[1], arm=arm).residual_rms}
    return row


def _every_second(session: SessionData, first: int) -> SessionData:
    """Return the sightings of every second view; the others say from where the arm came."""
    views = (v if k % 2 == first else replace(v, sighting=None) for k, v in enumerate(session.views))
    return replace(session, views=tuple(views))


def measured_summary(rows: list[Row]) -> list[str]:
    """A line a set."""
    lines = []
    for r in rows:
        other = f"{r['nominal']:.3f} → {r['other']:.3f}" if "other" in r else ""
        effects, idle, large = (", ".join(r[key]) or "–" for key in ("effects", "idle", "large"))
        lines.append((r["set"], f"{r['before']:.3f}", f"{r['after']:.3f}", effects, idle, large, other))
    head = "set | left out, nominal, mm | with what is suggested | added | idle | ten usual sizes and more, uncertain"
    return markdown(f"{head} | other half: nominal → with its arm", lines)


MEASURED = Table(measured_jobs, measured, measured_summary, range(1), page="points", block="measured")
