"""Sessions of 2 to 6 views with little, nothing or the same in them, through every stage: what ends in a traceback.

`drawn(seed)` gives arrays as `Session.from_arrays` takes them, of clouds, of labelled points or of both. One draw in
two has nothing degenerate, or one trait alone; the others combine several. Development: 7000 to 7499.

Whatever comes in at a door ends well or in a line: drawn arrays, saved sessions, live cells with faults, requests.

ARRAYS: one argument of `Session.from_arrays` replaced by something drawn. SAVES: sessions with odd names, covariates,
times and targets; what is read back is what was given. LIVE: views one by one with a fault at drawn calls (scans of
nothing, copies, wrong shapes, an interrupt or a full memory within a stage); after it the right views go on and reach a
result. REQUESTS: what a page may send to `stitch review`, spoilt. Used up: 9500 to 9502.
"""

import contextlib
import http.client
import json
import subprocess
import tempfile
import traceback
from collections.abc import Callable, Iterable, Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any
from unittest.mock import patch
from urllib.parse import urlsplit

import numpy as np

import stitch
from bench import harness
from bench.harness import STITCH, Row
from data_synth import kinematics
from data_synth.arms import ARMS
from data_synth.fixtures.blade_cells import measured_blade
from data_synth.write import robot_table, write_session
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
# What may follow a run, in three parts; the first takes longer than the others together.
LATER = (["diagnose"], ["compare", "add"], ["plan", "save run", "load run"])
_HAND_EYE = frames.exp(np.array([0.3, -0.2, 1.1, 40.0, -25.0, 120.0]))
_FROM_PART = 350.0  # mm, from the scanner to the middle of the part
_POINTS = 400
COUNTS = {"arrays": 60, "saves": 30, "live sessions": 25, "requests": 200}
_CLOUDS = {"seed": 3, "kind": "both", "views": 5, "mount": "eye_in_hand", "robot": True, "stated": True}
_CLOUDS |= {"checked": False, "times": "rising", "traits": []}
_LABELLED = _CLOUDS | {"kind": "points"}
_TEXTS = (
    "x",
    "view",
    "j1_deg",
    "a\nb",
    "ä ö",
    "日本",
    "half \ud83d",
    "\0",
    "",
    " ",
    "x" * 300,
    "a,b",
    '"q"',
    "../up",
    "=1+1",
)
_STAGES = ("match_pairs", "unconstrained_poses", "solve_hand_eye")
_PATHS = ("jobs", "chosen", "own", "trust", "stop")
_BODIES: tuple[Any, ...] = (
    {"kind": "note", "text": "seen"},
    {"kind": "add", "effects": ["range_scale"]},
    {"kind": "drop", "effects": ["range_scale"]},
    {"views": ["v001"], "bins": {"range": [0, 1]}},
    {"place": [0.0, 1.0, 2.0]},
    {"text": "x = 1", "trust": True},
)


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
    """Run a draw through every stage, or `later` of those after a run alone; say how far it came, and each traceback
    that is no error of stitch."""
    outcome: Row = {"result": False, "refused": "", "crashes": []}
    given = arguments(job)
    session = _stage(outcome, "from_arrays", lambda: stitch.Session.from_arrays(**given))
    if given["clouds"] is not None:
        _stage(outcome, "live", lambda: _live(given))
    if session is None:
        return outcome
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        if _stage(outcome, "save", lambda: session.save(folder / "s")) is not None:
            _stage(outcome, "load", lambda: stitch.load_session(folder / "s"))
        run = _stage(outcome, "run", lambda: stitch.run(session))
        if run is None:
            return outcome
        outcome["result"] = True
        _stage(outcome, "print", lambda: str(run) and repr(run.hand_eye) and run.residuals)
        later: dict[str, Callable[[], object]] = {
            "compare": lambda: str(stitch.compare(run)),
            "diagnose": lambda: str(stitch.diagnose(run)),
            "add": lambda: str(stitch.add(run, "joint_offset" if job["robot"] else "range_scale")),
            "plan": lambda: str(stitch.plan(session, views=1, size=120.0)),
            "save run": lambda: run.save(folder / "run"),
            "load run": lambda: str(stitch.load_run(folder / "run")),
        }
        for name in job.get("later", later):
            _stage(outcome, name, later[name])
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


def jobs(seeds: Iterable[int]) -> list[Row]:
    """Return a draw a seed, each with another third of what follows a run: all of it would take twice as long."""
    return [drawn(seed) | {"later": LATER[seed % len(LATER)]} for seed in seeds]


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
    told = [f"- {count} × {place}" for place, count in sorted(places.items(), key=lambda item: -item[1])]
    return [*table, "", *told] if told else table


TABLE = harness.Table(jobs, trial, summary, range(20_000, 22_000), page="limits", block="degenerate")


def door_jobs(seeds: range) -> Iterator[Row]:
    """So many of each door a seed; requests share a server."""
    for seed in seeds:
        for door, count in COUNTS.items():
            numbers = range(1 if door == "requests" else count)
            yield from ({"seed": seed, "door": door, "number": number} for number in numbers)


def door_trial(job: Row) -> Row:
    """What came of it: taken, refused, or each fault."""
    rng = np.random.default_rng([job["seed"], list(COUNTS).index(job["door"]), job["number"]])
    doors = {"arrays": _arrays, "saves": _saves, "live sessions": _live_with_faults, "requests": _requests}
    return doors[job["door"]](rng)


def _arrays(rng: np.random.Generator) -> Row:
    given = arguments(_CLOUDS if rng.random() < 0.5 else _LABELLED)
    key = str(rng.choice([*given, "covariates", "name", "unit", "axes"]))
    given[key] = _spoilt(given.get(key), rng)
    return _ended(lambda: stitch.Session.from_arrays(**given), {"what": key})


def _spoilt(value: Any, rng: np.random.Generator) -> Any:
    """Something else in the place of a value, or a change of it."""
    array = np.array(value, float) if isinstance(value, np.ndarray) and value.dtype.kind == "f" else np.ones((5, 3))
    flat = array.copy()
    flat.ravel()[rng.integers(flat.size)] = rng.choice([np.nan, np.inf, -np.inf, 1e30, 0.0, 1e-300])
    others = [
        *(None, [], {}, 5, -1.5, True, "text", b"bytes", object(), [None] * 5, np.nan, [[]] * 5, [{}] * 5, lambda: 0),
        *(flat, flat[:-1], flat[:, :0] if flat.ndim > 1 else flat[:0], flat.astype(np.float16), flat.astype(complex)),
        *(flat.astype(str), flat.astype(object), np.ma.masked_invalid(flat), flat.T, flat[None], flat.ravel()),
        *(np.array(["2026-01-01"] * 5, "datetime64[s]"), np.zeros(5, "timedelta64[ms]"), np.zeros((5, 10**6), bool)),
        *([flat] * 5, [list(flat)] * 4, {"v": flat}, iter([1, 2, 3]), {str(rng.choice(_TEXTS)): np.ones(5)}),
        *(str(rng.choice(_TEXTS)), [str(rng.choice(_TEXTS))] * 5, [{str(rng.choice(_TEXTS)): [0, 0, 1]}] * 5),
    ]
    return others[rng.integers(len(others))]


def _saves(rng: np.random.Generator) -> Row:
    given = arguments(_CLOUDS if rng.random() < 0.3 else _LABELLED)

    def text() -> str:
        return str(rng.choice(_TEXTS))

    if rng.random() < 0.5:
        given["covariates"] = {text(): rng.normal(size=5) * 10.0 ** rng.integers(-12, 12)}
    if rng.random() < 0.3:
        given["name"] = text()
    if rng.random() < 0.5:
        given["times"] = np.cumsum(rng.random(5)) * 10.0 ** rng.integers(-3, 10)
    if given["points"] is not None and rng.random() < 0.5:
        given["points"] = [
            {text() if k == 1 else name: at for k, (name, at) in enumerate(row.items())} for row in given["points"]
        ]

    def save() -> str:
        session = stitch.Session.from_arrays(**given)
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder) / "s"
            try:
                session.save(place)
            except stitch.StitchError:
                left = list(Path(folder).iterdir())
                return f"left {left[0].name}" if left else "refused"
            again = stitch.load_session(place)
            apart = np.abs(
                np.array([v.T_base_flange for v in again.views]) - [v.T_base_flange for v in session.views]
            ).max()
            names = [(v.name, v.covariates.keys()) for v in again.views] == [
                (v.name, v.covariates.keys()) for v in session.views
            ]
            times = np.allclose([v.time_s for v in again.views], [v.time_s for v in session.views], rtol=1e-12)
            return "" if apart < 1e-6 and names and times else f"read back otherwise: {apart:g} {names} {times}"

    return _ended(save, {})


def _live_with_faults(rng: np.random.Generator) -> Row:
    given = arguments(_CLOUDS)
    live = stitch.live(mount=given["mount"], scanner=given["scanner"])
    said: Row = {"what": []}

    def go() -> str:
        for v, (cloud, pose) in enumerate(zip(given["clouds"], given["poses"], strict=True)):
            if rng.random() < 0.6:
                said["what"].append(_faulty_call(live, cloud, pose, rng))
            live.add_view(cloud, pose, name=f"right{v}")
        names = [view.name for view in live.finish().session.views]
        return "" if sum(name.startswith("right") for name in names) >= 4 else f"views {names} are left"

    return _ended(go, said)


def _faulty_call(live: Any, cloud: Any, pose: Any, rng: np.random.Generator) -> str:
    """A call that ends in an exception, or with a view that is none; what it was."""
    which = int(rng.integers(8))
    clouds = [None, cloud[:3], cloud[:0], np.full((50, 3), np.nan), cloud[:, :2], cloud * 1e6, "scan", cloud]
    error = [KeyboardInterrupt, MemoryError, ValueError][rng.integers(3)]
    stage = f"stitch.fit.live_fit.{_STAGES[rng.integers(len(_STAGES))]}"
    broken = patch(stage, side_effect=error) if which == 7 else contextlib.nullcontext()
    try:
        with broken:
            said = live.add_view(clouds[which], pose)
    except (stitch.StitchError, KeyboardInterrupt, MemoryError, ValueError) as end:
        foreign = which < 7 and not isinstance(end, stitch.StitchError)
        if foreign:
            raise RuntimeError(f"cloud {which}: {end!r}") from end
        return type(end).__name__
    return str(said.verdict)


def _requests(rng: np.random.Generator) -> Row:
    """All requests to one server: codes, and faults of those that are answered by 5xx or not at all."""
    codes: dict[str, int] = {}
    faults: list[str] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_session(folder / "s", measured_blade(1, views=5, pixels=40), "s")
        run = [*STITCH, "run", folder / "s", "-o", folder / "r", "--no-recording"]
        subprocess.run([str(word) for word in run], check=True, capture_output=True)
        command = [*STITCH, "review", str(folder / "r"), "--no-browser", "--port", "0"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
            assert process.stdout is not None
            line = next(text for text in process.stdout if "http://" in text)
            address = urlsplit(line[line.index("http://") :].split()[0])
            for _ in range(COUNTS["requests"]):
                path, body = str(rng.choice(_PATHS)), _body(rng)
                try:
                    connection = http.client.HTTPConnection(address.netloc, timeout=60)
                    connection.request("POST", f"{address.path.rstrip('/')}/{path}", body)
                    answer = connection.getresponse()
                    text = answer.read().decode(errors="replace")
                    code = str(answer.status)
                except (OSError, http.client.HTTPException) as error:
                    code, text = repr(error)[:60], ""
                codes[code] = codes.get(code, 0) + 1
                if not code.isdigit() or code >= "500" or "Traceback" in text:
                    faults.append(f"{path} {body[:80]!r}: {code} {text[:120]}")
            process.terminate()
    return {"ended": "; ".join(faults), "codes": codes}


def _body(rng: np.random.Generator) -> bytes:
    """What a page sends, one value or the text itself spoilt."""
    body = deepcopy(_BODIES[rng.integers(len(_BODIES))])
    wrong = [None, [], {}, -1, 1e308, "x" * 5000, ["a"] * 3000, [[[]]], True, str(rng.choice(_TEXTS)), {"a": {"b": 1}}]
    body[str(rng.choice([*body, "model", "more"]))] = wrong[rng.integers(len(wrong))]
    text = json.dumps(body).encode()
    cut, kind = int(rng.integers(len(text))), rng.random()
    if kind < 0.2:
        return text[:cut]
    if kind < 0.4:
        return text[:cut] + bytes(rng.integers(0, 256, 3).tolist()) + text[cut:]
    return text.replace(b"1", b"1e999") if kind < 0.5 else text


def _ended(work: Any, row: Row) -> Row:
    """The row with how some work ended: "" where well, "refused", or the fault."""
    try:
        result = work()
        return row | {"ended": result if isinstance(result, str) else ""}
    except stitch.StitchError as error:
        return row | {"ended": "refused", "said": str(error)[:120]}
    except Exception as error:
        frame = traceback.extract_tb(error.__traceback__)[-1]
        return row | {"ended": f"{type(error).__name__} in {frame.filename[-40:]}:{frame.lineno}: {str(error)[:120]}"}


def door_summary(rows: list[Row]) -> list[str]:
    """A line a door, then each fault."""
    lines, faults = [], []
    for door, group in harness.grouped(rows, "door").items():
        wrong = [row["ended"] for row in group if row["ended"] not in ("", "refused")]
        refused = sum(row["ended"] == "refused" for row in group)
        count = COUNTS["requests"] * len(group) if door == "requests" else len(group)
        lines.append([door, count, refused, len(wrong)])
        faults += wrong
    return [
        *harness.markdown("door | tried | refused in a line | traceback, or otherwise than given", lines),
        "",
        *faults,
    ]


DOORS = harness.Table(door_jobs, door_trial, door_summary, range(9500, 9501), page="limits", block="doors")
