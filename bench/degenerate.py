"""Sessions of 2 to 6 views with little, nothing or the same in them, through every stage: what ends in a traceback.

`drawn(seed)` gives arrays as `Session.from_arrays` takes them, of clouds, of labelled points or of both. One draw in
two has nothing degenerate, or one trait alone; the others combine several. Development: 7000 to 7499.
"""

import contextlib
import tempfile
import traceback
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import stitch
from bench import harness
from bench.harness import Row
from data_synth import kinematics
from data_synth.arms import ARMS
from data_synth.write import robot_table
from stitch.numerics import frames
from stitch.numerics.frames import Array

Arguments = dict[str, Any]

MOTIONS = ("one_turn", "no_turn", "one_axis", "still", "two_places", "tiny", "copied_row", "nonsense", "part_still")
TARGETS = ("one", "two", "on_a_line", "in_a_plane", "at_one_place", "each_seen_once")
SURFACES = ("plane", "sphere", "cylinder", "line", "point", "few_points", "apart")
GAPS = ("empty_view", "no_sightings", "missing_cloud", "all_outliers", "no_noise", "copied_scan")
TRAITS = {
    "points": (*MOTIONS, *GAPS, *TARGETS),
    "clouds": (*MOTIONS, *GAPS, *SURFACES),
    "both": (*MOTIONS, *GAPS, *TARGETS, *SURFACES),
}
_HAND_EYE = frames.exp(np.array([0.3, -0.2, 1.1, 40.0, -25.0, 120.0]))
_FROM_PART = 350.0  # mm, from the scanner to the middle of the part
_POINTS = 400


def drawn(seed: int) -> Row:
    """Return what a seed stands for: kind of session, number of views, mount and traits."""
    rng = np.random.default_rng(seed)
    kind = str(rng.choice(["points", "clouds", "both"], p=[0.6, 0.25, 0.15]))
    count = int(rng.choice([0, 1, 2, 3], p=[0.35, 0.4, 0.2, 0.05]))
    return {
        "seed": seed,
        "kind": kind,
        "views": int(rng.choice([2, 3, 4, 5, 6], p=[0.08, 0.26, 0.24, 0.24, 0.18])),
        "mount": str(rng.choice(["eye_in_hand", "eye_to_hand"])),
        "robot": bool(rng.random() < 0.4),
        "stated": bool(rng.random() < 0.5),  # where the scanner sits, roughly
        "checked": bool(rng.random() < 0.7),  # whether the poses are what they are said to be
        "times": str(rng.choice(["none", "rising", "same"])),
        "traits": sorted(rng.choice(TRAITS[kind], count, replace=False).tolist()),
    }


def arguments(job: Row) -> Arguments:
    """Return the arguments of `Session.from_arrays` that a draw stands for."""
    rng = np.random.default_rng([job["seed"], 1])
    traits = set(job["traits"])
    T, q = _poses(job, rng)
    T_base_scanner = T @ _HAND_EYE if job["mount"] == "eye_in_hand" else frames.inverse(T) @ _HAND_EYE
    # The part stands before the first view; what the scanner sees follows.
    part = T_base_scanner[0] @ frames.make(np.eye(3), np.array([0.0, 0.0, _FROM_PART]))
    seen = frames.inverse(T_base_scanner) @ part
    if "nonsense" in traits:
        seen = seen @ frames.exp(rng.normal(size=(len(T), 6)) * [0.3, 0.3, 0.3, 30, 30, 30])
    if "part_still" in traits:
        seen = np.repeat(seen[:1], len(T), axis=0)
    noise = 0.0 if "no_noise" in traits else 0.02
    seen = seen @ frames.exp(noise * rng.normal(size=(len(T), 6)) * np.repeat([1e-3, 1.0], 3))
    clouds = None if job["kind"] == "points" else _clouds(traits, seen, noise, rng)
    sightings = None if job["kind"] == "clouds" else _sightings(traits, seen, noise, rng)
    if "copied_row" in traits or "copied_scan" in traits:
        last, first = len(T) - 1, rng.integers(len(T) - 1)
        for rows in (clouds, sightings):
            if rows is not None:
                rows[last] = rows[first]
        if "copied_row" in traits:
            T[last] = T[first]
            q[last] = q[first]
    given: Arguments = {"clouds": clouds, "poses": T, "mount": job["mount"], "points": sightings}
    given["check"] = job["checked"]
    if job["stated"]:
        given["scanner"] = {"pose": (_HAND_EYE @ frames.exp(np.repeat([0.03, 5.0], 3))).tolist()}
        if job["seed"] % 2:
            given["scanner"] |= {"standoff": _FROM_PART, "kind": "area"}
    if job["robot"]:
        given |= {"joints": q, "robot": robot_table(ARMS["UR10"])}
    if job["times"] != "none":
        given["times"] = np.zeros(len(T)) if job["times"] == "same" else 30.0 * np.arange(len(T))
    return given


def _poses(job: Row, rng: np.random.Generator) -> tuple[Array, Array]:
    """T_base_flange (V, 4, 4) mm and joint angles (V, 6) rad that agree."""
    count = job["views"]
    traits = set(job["traits"])
    middle = np.radians([20.0, -95.0, 100.0, -80.0, -75.0, 10.0])
    off = rng.uniform(-0.35, 0.35, (count, 6))
    if "one_turn" in traits:
        off[1:] = off[1]
    if "no_turn" in traits:
        off[:] = off[:1] + np.outer(np.arange(count), [0.0, 0.08, -0.13, 0.05, 0.0, 0.0])
    if "one_axis" in traits:
        off[:, :5] = off[0, :5]
    if "still" in traits:
        off[:] = off[0]
    if "two_places" in traits:
        off = off[np.arange(count) % 2]
    if "tiny" in traits:
        off = off[0] + 1e-6 * off
    q = middle + off
    return kinematics.flange(ARMS["UR10"], q), q


def _sightings(traits: set[str], seen: Array, noise: float, rng: np.random.Generator) -> list[Any]:
    """Places of named targets, one mapping a view."""
    places = rng.uniform(-60, 60, (5, 3))
    if "one" in traits:
        places = places[:1]
    if "two" in traits:
        places = places[:2]
    if "on_a_line" in traits:
        places[:, 1:] = places[0, 1:]
    if "in_a_plane" in traits:
        places[:, 2] = 0.0
    if "at_one_place" in traits:
        places[:] = places[0]
    rows: list[Any] = []
    for v, T in enumerate(seen):
        at = frames.transform(T, places) + noise * rng.normal(size=places.shape)
        if "all_outliers" in traits:
            at = at + rng.uniform(-200, 200, at.shape)
        names = [f"t{k}_{v}" if "each_seen_once" in traits else f"t{k}" for k in range(len(at))]
        rows.append(dict(zip(names, at, strict=True)))
    if "no_sightings" in traits:
        rows[rng.integers(len(rows))] = None
    if "empty_view" in traits:
        rows[rng.integers(len(rows))] = {}
    return rows


def _clouds(traits: set[str], seen: Array, noise: float, rng: np.random.Generator) -> list[Any]:
    """Scans (N, 3), one a view: samples of a surface that bends in two directions unless a trait says otherwise."""
    uv = rng.uniform(-60, 60, (_POINTS, 2))
    scans: list[Any] = []
    for v, T in enumerate(seen):
        own = uv + rng.uniform(-0.5, 0.5, uv.shape)
        at = np.column_stack([own, _height(traits, own)])
        if "cylinder" in traits:
            at = np.column_stack([40 * np.sin(own[:, 0] / 40), own[:, 1], 40 * np.cos(own[:, 0] / 40)])
        if "line" in traits:
            at[:, 1:] = 0.0
        if "point" in traits:
            at[:] = at[0]
        if "few_points" in traits:
            at = at[:3] if v == len(seen) - 1 else at[:40]
        if "apart" in traits:
            at = at + np.array([500.0 * v, 0.0, 0.0])
        points = frames.transform(T, at) + noise * rng.normal(size=at.shape)
        scans.append(rng.uniform(-200, 200, points.shape) if "all_outliers" in traits else points)
    if "missing_cloud" in traits:
        scans[rng.integers(len(scans))] = None
    if "empty_view" in traits:
        scans[rng.integers(len(scans))] = np.zeros((0, 3))
    return scans


def _height(traits: set[str], uv: Array) -> Array:
    """Heights (N,) above the plane of places (N, 2), mm."""
    x, y = uv.T
    if "plane" in traits:
        return np.zeros(len(uv))
    if "sphere" in traits:
        return np.sqrt(100.0**2 - x**2 - y**2) - 100.0
    return 12 * np.sin(x / 17) * np.cos(y / 23) + x * y / 300


def trial(job: Row) -> Row:
    """Run a draw through every stage; say how far it came, and each traceback that is no error of stitch."""
    outcome: Row = {"result": False, "refused": "", "crashes": []}
    given = arguments(job)
    session = _stage(outcome, "from_arrays", lambda: stitch.Session.from_arrays(**given))
    if given["clouds"] is not None:
        _stage(outcome, "live", lambda: _live(given))
    if session is None:
        return outcome
    with _scratch() as folder:
        if _stage(outcome, "save", lambda: session.save(folder / "s")) is not None:
            _stage(outcome, "load", lambda: stitch.load_session(folder / "s"))
        run = _stage(outcome, "run", lambda: stitch.run(session))
        if run is None:
            return outcome
        outcome["result"] = True
        _stage(outcome, "print", lambda: str(run) and repr(run.hand_eye) and run.residuals)
        _stage(outcome, "compare", lambda: str(stitch.compare(run)))
        _stage(outcome, "diagnose", lambda: str(stitch.diagnose(run)))
        _stage(outcome, "add", lambda: str(stitch.add(run, "joint_offset" if job["robot"] else "range_scale")))
        _stage(outcome, "plan", lambda: str(stitch.plan(session, views=1, size=120.0)))
        _stage(outcome, "save run", lambda: run.save(folder / "run"))
        _stage(outcome, "load run", lambda: str(stitch.load_run(folder / "run")))
    return outcome


def _live(given: Arguments) -> str:
    """One view after the other, those that are refused left out, then the end."""
    cell = {key: given[key] for key in ("robot", "scanner") if key in given}
    live = stitch.live(mount=given["mount"], **cell)
    for v, (cloud, pose) in enumerate(zip(given["clouds"], given["poses"], strict=True)):
        joints = {"joints": given["joints"][v]} if "joints" in given else {}
        with contextlib.suppress(stitch.StitchError):
            live.add_view(cloud, pose, **joints)
    live.next_pose()
    return str(live.finish())


def _stage(outcome: Row, name: str, do: Callable[[], Any]) -> Any:
    """What a stage gives; None where it ends in an error, which is kept if it is none of stitch."""
    try:
        return do()
    except stitch.StitchError as error:
        outcome["refused"] = outcome["refused"] or f"{name}: {error}"
    except Exception as error:
        inside = [frame for frame in traceback.extract_tb(error.__traceback__) if "/stitch/" in frame.filename]
        at = inside[-1] if inside else traceback.extract_tb(error.__traceback__)[-1]
        place = f"{at.filename.rpartition('/stitch/')[2]}:{at.lineno} {at.name}"
        outcome["crashes"].append(f"{name}: {type(error).__name__} in {place}: {str(error)[:120]}")
    return None


@contextlib.contextmanager
def _scratch() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


def jobs(seeds: Iterable[int]) -> list[Row]:
    """Return a draw a seed."""
    return [drawn(seed) for seed in seeds]


def summary(rows: list[Row]) -> list[str]:
    """Return how many reached a result or were refused, and how many stages ended in a traceback, by kind."""
    lines = []
    for kind, group in harness.with_all(harness.grouped(rows, "kind")).items():
        crashed = [row for row in group if row["crashes"]]
        reached = sum(row["result"] for row in group)
        lines.append((kind, len(group), reached, len(group) - reached, len(crashed)))
    table = harness.markdown("kind | sessions | with a result | refused | with a traceback", lines)
    places: dict[str, int] = {}
    for crash in (crash for row in rows for crash in row["crashes"]):
        place = crash.rsplit(": ", 1)[0] if crash.count(": ") > 1 else crash
        places[place] = places.get(place, 0) + 1
    return [*table, *(f"{count} × {place}" for place, count in sorted(places.items(), key=lambda item: -item[1]))]


TABLE = harness.Table(jobs, trial, summary, range(20_000, 22_000), page="limits", block="degenerate")
