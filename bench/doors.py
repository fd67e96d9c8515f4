"""Whatever comes in at a door ends well or in a line: drawn arrays, saved sessions, live cells with faults, requests.

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
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any
from unittest.mock import patch
from urllib.parse import urlsplit

import numpy as np

import stitch
from bench import degenerate
from bench.harness import STITCH, Row, Table, grouped, markdown
from data_synth.fixtures.blade_cells import measured_blade
from data_synth.write import write_session

COUNTS = {"arrays": 60, "saves": 30, "live sessions": 25, "requests": 200}
_CLOUDS = {"seed": 3, "kind": "both", "views": 5, "mount": "eye_in_hand", "robot": True, "stated": True}
_CLOUDS |= {"checked": False, "times": "rising", "traits": []}
_POINTS = _CLOUDS | {"kind": "points"}
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
_STAGES = ("match_pairs", "unconstrained_poses", "fit_hand_eye")
_PATHS = ("jobs", "chosen", "own", "trust", "stop")
_BODIES: tuple[Any, ...] = (
    {"kind": "note", "text": "seen"},
    {"kind": "add", "effects": ["range_scale"]},
    {"kind": "drop", "effects": ["range_scale"]},
    {"views": ["v001"], "bins": {"range": [0, 1]}},
    {"place": [0.0, 1.0, 2.0]},
    {"text": "x = 1", "trust": True},
)


def jobs(seeds: range) -> Iterator[Row]:
    """So many of each door a seed; requests share a server."""
    for seed in seeds:
        for door, count in COUNTS.items():
            numbers = range(1 if door == "requests" else count)
            yield from ({"seed": seed, "door": door, "number": number} for number in numbers)


def trial(job: Row) -> Row:
    """What came of it: taken, refused, or each fault."""
    rng = np.random.default_rng([job["seed"], list(COUNTS).index(job["door"]), job["number"]])
    doors = {"arrays": _arrays, "saves": _saves, "live sessions": _live, "requests": _requests}
    return doors[job["door"]](rng)


def _arrays(rng: np.random.Generator) -> Row:
    given = degenerate.arguments(_CLOUDS if rng.random() < 0.5 else _POINTS)
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
    given = degenerate.arguments(_CLOUDS if rng.random() < 0.3 else _POINTS)

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


def _live(rng: np.random.Generator) -> Row:
    given = degenerate.arguments(_CLOUDS)
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


def summary(rows: list[Row]) -> list[str]:
    """A line a door, then each fault."""
    lines, faults = [], []
    for door, group in grouped(rows, "door").items():
        wrong = [row["ended"] for row in group if row["ended"] not in ("", "refused")]
        refused = sum(row["ended"] == "refused" for row in group)
        count = COUNTS["requests"] * len(group) if door == "requests" else len(group)
        lines.append([door, count, refused, len(wrong)])
        faults += wrong
    return [*markdown("door | tried | refused in a line | traceback, or otherwise than given", lines), "", *faults]


TABLE = Table(jobs, trial, summary, range(9500, 9501), page="limits", block="doors")
