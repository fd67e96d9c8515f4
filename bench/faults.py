"""Bad inputs of all kinds, and kills: no traceback, no hang, nothing silent, nothing lost.

`--only WORDS` takes kinds or names; `--set kills=0` kills nothing. Two workers run two cases at a time. Those that
faults.toml lists, and those that have to be computed.
"""

import csv
import fcntl
import json
import os
import re
import shutil
import socket
import sqlite3
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from datetime import date
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from plyfile import PlyData

from bench.fault_room import KILLED, TRIED_AGAIN, Case, judged, killed
from bench.harness import Row, Table, grouped, markdown
from data_synth.fixtures.edits import set_cell
from data_synth.fixtures.raw_folders import Convention, session_poses, table_of

# The room, spoilt -> the arguments of the command that meets it.
Spoil = Callable[[Path], list[str]]

RUN = ["run", "s", "-o", "out", "--no-recording"]
NOISE = bytes(range(256)) * 40
_EFFECT = """import time, sys, numpy as np
from stitch.effects import effect, number, twist
@effect("sensor", k=number("mm", typical=0.02, limit=1.0))
def own(points, view, k):
    "x"
    {}
"""
_KRL = """DEF t()
PTP {A1 -12.586,A2 -62.529,A3 -62.05,A4 68.642,A5 20.952,A6 -36.507}
LIN {X -481.815,Y 132.142,Z 684.153,A 17.154,B -13.472,C -29.927}
END
"""
_PLY = "ply\nformat {} 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
_PCD = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {0}\nHEIGHT 1\nPOINTS {0}\nDATA {1}\n"
_HUGE = 10**12
_HEADER = "Nr.;Datei;Lage X [mm];Lage Y [mm];Lage Z [mm];Drehung um Z [°];Drehung um Y [°];Drehung um X [°]"
# Keys of result.json and values of another kind.
_WRONG: dict[str, Any] = {"session": 5, "hand_eye": [[1, 2], [3]], "residual_rms": "x", "noise_floor": None}
_WRONG |= {"effects": [1], "stages": {"a": 1}, "views": [5], "unobservable": [1], "repeatability": 7, "verdict": []}
_WRONG |= {"notes": "n", "convergence": [1], "heldout_rms": {}}
# Sockets and locks that are held as long as this process lives.
_HELD: list[object] = []
FAULTS = ("traceback", "hang", "silent", "leftovers", "refused though right", "unclear", "not the result alone")


def all_cases() -> Iterator[Case]:
    """Return every case."""
    listed = tomllib.loads(Path(__file__).with_name("faults.toml").read_text(encoding="utf-8"))["kind"]
    yield from chain.from_iterable(map(_listed, listed))
    computed = (_tables, _cloud_headers, _points, _results, _disks, _terminals, _clocks, _others)
    yield from chain.from_iterable(source() for source in computed)


def _listed(kind: dict[str, Any]) -> Iterator[Case]:
    """The cases of a kind of faults.toml."""
    name, command = kind["name"], kind.get("command", " ".join(RUN)).split()
    more: dict[str, Any] = {"fine": kind.get("fine", False)}
    if "writes" in kind:
        more["writes"] = tuple(kind["writes"])
    if "right" in kind:
        more["right"] = _poses_right
    prepare = _PREPARE[kind["prepare"]] if "prepare" in kind else lambda room: None
    for line in _repeated(kind.get("lines", "")).strip().splitlines():
        words = [*kind.get("before", "").split(), *line.split()]
        yield Case(name.replace("COMMAND", words[0]), line[:120], _beside_odd_files(prepare, words), **more)
    for key, values in kind.get("keys", {}).items():
        for text in values:
            value = f'"{_repeated(text)}"' if kind.get("quoted") else _repeated(text)
            spoil = _in_session(lambda toml, key=key, value=value: with_key(toml, key, value), command)
            yield Case(name.replace("KEY", key.split(".")[0]), f"{key} = {value[:40]}", spoil, **more)
    for text in kind.get("cells", ()):
        yield Case(name, repr(text[:20]), _with_cell(kind["column"], _repeated(text)))
    for case, rows in kind.get("loads", {}).items():
        yield Case(name, case, _with_columns(kind["columns"], [row.split(",") for row in rows]), **more)
    changes: dict[str, Callable[[Path], object]] = {}
    for count, edits in ((0, kind.get("edits", {})), (1, kind.get("first", {}))):
        changes |= {case: _edited(kind, [_repeated(word) for word in edit], count) for case, edit in edits.items()}
    contents = {case: _repeated(text) for case, text in kind.get("contents", {}).items()}
    contents |= {body[:40]: _EFFECT.format(body) for body in kind.get("bodies", "").strip().splitlines()}
    changes |= {case: lambda file, text=text: file.write_text(text) for case, text in contents.items()}
    changes |= {what: lambda file, what=what: instead(file, what) for what in kind.get("instead", ())}
    for case, change in changes.items():
        cloud = kind.get("new_cloud")
        yield Case(name, f"{kind['file']} {case}", _changed(kind["file"], change, command, prepare, cloud), **more)


def _repeated(text: str) -> str:
    """The text with what stands between « and × written out, inner marks first."""
    while "«" in text:
        text = re.sub(r"«([^«»]*)×(\d+)»", lambda m: m[1] * int(m[2]), text, flags=re.DOTALL)
    return text


def _beside_odd_files(prepare: Callable[[Path], object], words: list[str]) -> Spoil:
    """Files and folders as people have them beside a session."""

    def spoil(room: Path) -> list[str]:
        prepare(room)
        for name in ("mine.txt", "mine.py"):
            (room / name).write_text("mine")
        os.mkfifo(room / "mine.pipe")
        (room / "empty.stl").touch()
        (room / "noise.stl").write_bytes(NOISE)
        (room / "own").mkdir()
        (room / "own" / "thesis.txt").write_text("mine")
        (room / "model").mkdir()
        shutil.copy(room / "r" / "model.toml", room / "model")
        (room / "link").symlink_to(room / "s")
        (room / "linked").symlink_to(room / "r")
        return words

    return spoil


def _changed(
    file: str,
    change: Callable[[Path], object],
    command: list[str],
    prepare: Callable[[Path], object] = lambda room: None,
    cloud: str | None = None,
) -> Spoil:
    """A file of the room changed; with `cloud` the second view's cloud is the file of that name."""

    def spoil(room: Path) -> list[str]:
        prepare(room)
        change(room / file)
        if cloud is not None:
            views = room / "s" / "views.csv"
            views.write_text(views.read_text().replace("clouds/v001.ply", cloud))
        return command

    return spoil


def _edited(kind: dict[str, Any], edit: Sequence[str], count: int) -> Callable[[Path], object]:
    """Patterns and their replacements, one after the other."""

    def change(file: Path) -> None:
        text = kind["text"] if "text" in kind else file.read_bytes().decode()
        for pattern, replacement in zip(edit[::2], edit[1::2], strict=True):
            text = re.sub(pattern, replacement, text, count=count)
        file.write_bytes(text.encode(kind.get("encoding", "utf-8")))

    return change


def instead(path: Path, what: str) -> None:
    """Put something else where a file should be."""
    path.unlink(missing_ok=True)
    things: dict[str, Callable[[], object]] = {
        "pipe": lambda: os.mkfifo(path),
        "folder": path.mkdir,
        "dangling link": lambda: path.symlink_to(path.parent / "nowhere"),
        "device": lambda: path.symlink_to("/dev/zero"),
        "empty": path.touch,
        "noise": lambda: path.write_bytes(NOISE),
        "UTF-16": lambda: path.write_text("view,cloud\n", encoding="utf-16"),
    }
    things[what]()


def _in_session(change: Callable[[str], str], command: list[str] = RUN) -> Spoil:
    """session.toml of the command's session changed."""
    return _changed(f"{command[1]}/session.toml", lambda file: file.write_text(change(file.read_text())), command)


def with_key(text: str, key: str, value: str) -> str:
    """Return session.toml with a key of a value as it would be typed."""
    document = tomllib.loads(text)
    table, _, name = key.rpartition(".")
    entries = document.setdefault(table, {}) if table else document
    entries.pop(name, None)
    if key == "robot.urdf":
        entries.pop("joints", None)
    line = f"[{table}]\n{name} = {value}\n" if table else f"{name} = {value}\n"
    rest = tomli_w.dumps(document)
    return rest.replace(f"[{table}]\n", line, 1) if table and f"[{table}]\n" in rest else line + rest


def _with_cell(column: str, value: str) -> Spoil:
    return _changed("s/views.csv", lambda file: set_cell(file, 2, column, value), RUN)


def _stated_urdf(room: Path) -> None:
    _in_session(lambda t: with_key(t, "robot.urdf", '"arm.urdf"\nbase_link = "a"\nflange_link = "b"'))(room)


def _foreign_code(room: Path) -> None:
    """The run r names a Python file that would tell if it were run."""
    code, model = room / "sent.py", room / "r" / "model.toml"
    code.write_text(f"open({str(room / 'executed')!r}, 'w')\n" + _EFFECT.format("return points"))
    model.write_text(f'effects_file = "{code}"\n' + model.read_text())


def _hold(room: Path) -> None:
    """Another process, this one, is writing into the run."""
    lock = os.open(room / ".r.lock", os.O_RDWR | os.O_CREAT)
    fcntl.flock(lock, fcntl.LOCK_EX)


def _copy_session(room: Path) -> None:
    shutil.copytree(room / "s", room / "t")
    file = room / "t" / "session.toml"
    file.write_text(file.read_text().replace('"s"', '"t"'))


_PREPARE: dict[str, Callable[[Path], object]] = {
    "cell": lambda room: (room / "cell").mkdir(),
    "copied_session": _copy_session,
    "foreign_code": _foreign_code,
    "german_folder": lambda room: _german_folder(_german())(room),
    "held": _hold,
    "moved_away": lambda room: shutil.move(room / "s", room / "elsewhere"),
    "program": lambda room: (room / "t.src").write_text(_KRL),
    "stated_urdf": _stated_urdf,
}


def _tables() -> Iterator[Case]:
    """A long header, and points in other units."""
    yield Case("views.csv: rows", "long header", _changed("s/views.csv", _long_header, RUN))
    for name, factor in {"metres": 1e-3, "micrometres": 1e3}.items():
        spoil = _changed("p/points.csv", lambda file, f=factor: _scaled(file, f), ["run", "p", *RUN[2:]])
        yield Case("points.csv: rows", name, spoil)


def _long_header(file: Path) -> None:
    rest = file.read_text().replace("\n", "\n1,").rstrip("1,")
    file.write_text("h" * 100_000 + "," + rest)


def _scaled(file: Path, factor: float) -> None:
    head, *rows = [row.split(",") for row in file.read_text().splitlines()]
    scaled = [[*row[:2], *(str(float(x) * factor) for x in row[2:])] for row in rows]
    file.write_text("\n".join(map(",".join, [head, *scaled])))


def _cloud_headers() -> Iterator[Case]:
    """Headers that promise too much, or nothing that can be read."""
    for encoding in ("ascii", "binary_little_endian", "binary_big_endian"):
        for count in (_HUGE, 10**30, 7, -3, "x"):
            yield _cloud("PLY headers", f"{encoding} {count}", _PLY.format(encoding, count) + "1 2 3\n")
    for encoding in ("ascii", "binary", "binary_compressed", "zip"):
        for count in (_HUGE, 10**30, 50, -1, "x"):
            yield _cloud("PCD headers", f"{encoding} {count}", _PCD.format(count, encoding) + "1 2 3\n4 5 6\n")
    size = (2**32 - 1).to_bytes(4, "little")
    unpacked = _PCD.format(3, "binary_compressed").encode() + size * 2 + b"\xff" * 99
    yield _cloud("PCD headers", "4 GB unpacked", unpacked)
    yield _cloud("PCD headers", "large counts", _PCD.format(3, "binary").replace("COUNT 1", f"COUNT {_HUGE}"))


def _cloud(kind: str, name: str, content: str | bytes) -> Case:
    data, file = content if isinstance(content, bytes) else content.encode(), f"c.{kind[:3].lower()}"
    return Case(kind, name, _changed(f"s/{file}", lambda path: path.write_bytes(data), RUN, cloud=file))


def _points() -> Iterator[Case]:
    """Scans that hold what no scanner measures."""
    for value in (1e30, -1e30, 1e9, np.nan, np.inf, 3e38):
        yield Case("single points", f"{value:g}", _with_points(lambda p, v=value: _put(p, v)))
    yield Case("few points", "none measured", _with_points(lambda p: p * 0))
    yield Case("few points", "two", _with_points(lambda p: p[:2]))
    yield Case("few points", "none", _with_points(lambda p: p[:0]))
    for name, factor in {"metres": 1e-3, "micrometres": 1e3}.items():
        yield Case("clouds in another unit", name, _with_points(lambda p, f=factor: p * f, every=True))
    yield Case("origin in the volume", "", _origin_in_volume, fine=True)


def _put(points: np.ndarray, value: float) -> np.ndarray:
    points[5, 0] = value
    return points


def _with_points(change: Callable[[np.ndarray], np.ndarray], every: bool = False) -> Spoil:
    """The points (N, 3) of the second view, or of every view, changed."""

    def spoil(room: Path) -> list[str]:
        for file in sorted((room / "s" / "clouds").glob("*.ply" if every else "v001.ply")):
            new = change(_points_of(file))
            lines = "\n".join(" ".join(f"{x:.6f}" for x in row) for row in new)
            file.write_text(_PLY.format("ascii", len(new)) + lines + "\n")
        return RUN

    return spoil


def _points_of(file: Path) -> np.ndarray:
    vertex = PlyData.read(str(file))["vertex"]
    return np.column_stack([vertex[axis] for axis in "xyz"]).astype(float)


def _origin_in_volume(room: Path) -> list[str]:
    """The same scans by a scanner whose frame stands where it measures; the hand-eye moved with it."""
    file = room / "s" / "session.toml"
    document = tomllib.loads(file.read_text())
    T = np.array(document["scanner"]["pose"])
    vertex = PlyData.read(str(room / "s" / "clouds" / "v000.ply"))["vertex"]
    middle = np.array([np.median(vertex[axis]) for axis in "xyz"])
    T[:3, 3] += T[:3, :3] @ middle
    document["scanner"]["pose"] = T.tolist()
    file.write_text(tomli_w.dumps(document))
    return _with_points(lambda p: p - middle, every=True)(room)


def _results() -> Iterator[Case]:
    """result.json with keys of another kind, or without them, or of a session elsewhere."""
    report = ["report", "r", "--no-diagnosis"]
    for key, value in _WRONG.items():
        yield Case("result.json", f"{key} wrong", _with_result(report, {key: value}))
        yield Case("result.json", f"no {key}", _with_result(report, {}, without=key))
    for value in ("", "/nowhere", "\0", "x" * 100_000, "."):
        yield Case("result.json", f"session {value[:9]!r}", _with_result(["compare", "r"], {"session": value}))


def _with_result(command: list[str], entries: dict[str, Any], without: str = "") -> Spoil:
    def change(file: Path) -> None:
        document = {**json.loads(file.read_text()), **entries}
        document.pop(without, None)
        file.write_text(json.dumps(document))

    return _changed("r/result.json", change, command)


def _with_columns(names: Sequence[str], rows: Sequence[Sequence[str]]) -> Spoil:
    """Columns more in views.csv of s, whose effect of the arm follows them; the last row goes on to the end."""

    def add(file: Path) -> None:
        head, *views = file.read_text().splitlines()
        cells = [*rows, *[rows[-1]] * len(views)]
        lines = [",".join([view, *row]) for view, row in zip(views, cells, strict=False)]
        file.write_text("\n".join([",".join([head, *names]), *lines]) + "\n")

    return _changed("s/views.csv", add, [*RUN, "--effects", "joint_compliance"])


def _five_joints(room: Path) -> list[str]:
    """The arm of s without its last joint."""
    _in_session(lambda t: re.sub(r"    \{[^}]*\},?\n\]", "]", t))(room)
    file = room / "s" / "views.csv"
    rows = list(csv.reader(file.read_text().splitlines()))
    kept = [i for i, name in enumerate(rows[0]) if name[:2] != "j6" and name not in (*"xyz", "qx", "qy", "qz", "qw")]
    file.write_text("\n".join(",".join(row[i] for i in kept) for row in rows) + "\n")
    return [*RUN, "--arm", "a"]


def _disks() -> Iterator[Case]:
    """Full disks."""
    for size in (3_000, 20_000, 60_000, 120_000):
        for command in (["run", "s", "-o", "out"], ["run", "s", "-o", "r"], ["add", "r", "incidence_bias"]):
            name = f"{' '.join(command)} {size // 1000} kB"
            yield Case("disk full", name, _asked(command), largest_file=size, writes=("q", "r", "out"))


def _asked(command: list[str]) -> Spoil:
    """The room as it is."""
    return lambda room: command


def _terminals() -> Iterator[Case]:
    """Terminals without UTF-8; an effect that prints."""
    for encoding in ("ascii", "latin-1", "cp437"):
        for command in (["effects"], ["compare", "r"], RUN):
            more: dict[str, Any] = {"environment": {"PYTHONIOENCODING": encoding}, "writes": ("r", "out")}
            yield Case("terminals without UTF-8", f"{encoding} {command[0]}", _asked(command), fine=True, **more)
    prints = 'print("chatty"); sys.stdout.write("more"); import os; os.write(1, b"raw")\n    return points + k'
    command = [*RUN, "--effects-file", "mine.py", "--effects", "own", "--json"]
    chatty = _changed("mine.py", lambda file: file.write_text(_EFFECT.format(prints)), command)
    yield Case("an effect that prints", "--json", chatty, fine=True, holds='{\n "format"')


def _german(clock: Sequence[str] = ()) -> Callable[[Path], str]:
    """A table as a German spreadsheet saves it: semicolons, decimal commas; with times of day beside."""

    def text(session: Path) -> str:
        T, clouds = session_poses(session)
        lines = [_HEADER + (";Uhrzeit" if clock else "")]
        for i, row in enumerate(table_of(T, Convention(order="ZYX", degrees=True, angles_first=False))):
            numbers = [f"{x:.6f}".replace(".", ",") for x in row]
            lines.append(";".join([str(i + 1), Path(clouds[i]).name, *numbers, *clock[i : i + 1]]))
        return "\r\n".join(lines) + "\r\n"

    return text


def _poses_right(room: Path) -> bool:
    """The session that was written has the poses of the one from which the table was made."""
    written, clouds = session_poses(room / "raw")
    T, names = session_poses(room / "s")
    true = {Path(name).name: pose for name, pose in zip(names, T, strict=True)}
    return all(np.abs(pose - true[cloud]).max() < 1e-3 for pose, cloud in zip(written, clouds, strict=True))


def _times_right(seconds: Sequence[float] | None) -> Callable[[Path], bool]:
    def right(room: Path) -> bool:
        with (room / "raw" / "views.csv").open(encoding="utf-8") as stream:
            rows = list(csv.DictReader(stream))
        times = [float(row["time_s"]) for row in rows] if "time_s" in rows[0] else None
        return _poses_right(room) and times == (None if seconds is None else list(seconds))

    return right


def _german_folder(table: Callable[[Path], str]) -> Spoil:
    """The scans of s beside a table of their poses."""

    def spoil(room: Path) -> list[str]:
        shutil.copytree(room / "s" / "clouds", room / "raw")
        (room / "raw" / "Posen.csv").write_bytes(table(room / "s").encode())
        return ["init", "raw", "--yes"]

    return spoil


def _clocks() -> Iterator[Case]:
    """Times of day beside the poses: seconds where they are times that run on, else no times at all."""
    minutes = [60.0 * i for i in range(6)]
    clocks: dict[str, tuple[list[str], list[float] | None]] = {
        "hours and minutes": ([f"9:{i:02}" for i in range(6)], minutes),
        "with a date": ([f"23.11.2026 09:0{i}:00" for i in range(6)], minutes),
        "past midnight": (["23:58", "23:59", "0:00", "0:01", "0:02", "0:03"], None),
        "99 minutes": ([f"9:{i}5" for i in range(4, 10)], None),
        "25 hours": ([f"{i}:00" for i in range(20, 26)], None),
        "half of them": (["9:00", "", "9:02", "", "9:04", ""], None),
        "afternoon": ([f"0{i}:00 PM" for i in range(1, 7)], [60 * m for m in minutes]),
    }
    for name, (cells, seconds) in clocks.items():
        spoil = _german_folder(_german(cells))
        yield Case("clock times", name, spoil, fine=True, writes=("raw/",), right=_times_right(seconds))


def _others() -> Iterator[Case]:
    """Folders for init that hold something else, histories of cells that are none, links and ports."""
    command, german = ["init", "raw", "--yes"], _PREPARE["german_folder"]
    for name, change in {
        # The other five are a session; the sixth is said to be left out.
        "an empty cloud": lambda raw: (raw / "v002.ply").write_text(""),
        # Either says the same; the other is said to be left aside.
        "a table twice": lambda raw: shutil.copy(raw / "Posen.csv", raw / "Posen2.csv"),
    }.items():
        spoil = _changed("raw", change, command, german)
        yield Case("folders for init", name, spoil, writes=("raw/",), right=_poses_right)
    for name, change in {
        "no clouds": lambda raw: [file.unlink() for file in raw.glob("*.ply")],
        "no poses": lambda raw: (raw / "Posen.csv").unlink(),
        "a session there": lambda raw: (raw / "session.toml").write_text("x"),
        "a link in a circle": lambda raw: (raw / "again").symlink_to(raw),
    }.items():
        spoil = _changed("raw", change, command, german)
        yield Case("folders for init", name, spoil)
    older = ("CREATE TABLE cell (key, value)", "INSERT INTO cell VALUES ('format', '\"stitch-history/0\"')")
    for name, change in {
        "noise": lambda file: file.write_bytes(NOISE),
        "folder": Path.mkdir,
        "pipe": os.mkfifo,
        "device": lambda file: file.symlink_to("/dev/zero"),
        "another database": _database("CREATE TABLE parts (name)"),
        "an older form": _database(*older),
    }.items():
        spoil = _changed("cell/history.sqlite", change, ["watch", "cell", "--add", "r"], _PREPARE["cell"])
        yield Case("histories of cells", name, spoil)
    yield Case("arms of other runs", "five joints", _five_joints)
    yield Case("stitch review", "port in use", _port_in_use)
    yield Case("command lines", "", _asked([]))
    yield Case("links out of a run", "pictures", _pictures_elsewhere, writes=("r",))


def _database(*statements: str) -> Callable[[Path], None]:
    def write(file: Path) -> None:
        connection = sqlite3.connect(file)
        for statement in statements:
            connection.execute(statement)
        connection.commit()
        connection.close()

    return write


def _port_in_use(room: Path) -> list[str]:
    held = socket.socket()
    held.bind(("127.0.0.1", 0))
    held.listen()
    _HELD.append(held)
    return ["review", "r", "--no-browser", "--port", str(held.getsockname()[1])]


def _pictures_elsewhere(room: Path) -> list[str]:
    shutil.rmtree(room / "r" / "pictures", ignore_errors=True)
    (room / "private").mkdir()
    (room / "r" / "pictures").symlink_to(room / "private")
    return ["compare", "r"]


@cache
def cases() -> dict[tuple[str, str], Case]:
    """Return all cases by kind and name."""
    return {(case.kind, case.name): case for case in all_cases()}


def jobs(seeds: range, kills: int) -> Iterator[Row]:
    """Every case, and so many kills at drawn moments."""
    yield from ({"kind": kind, "name": name} for kind, name in cases())
    for number in range(kills // len(KILLED)):
        yield from ({"kind": "kill", "name": name, "number": number, "seed": seeds[0]} for name in KILLED)


def trial(job: Row) -> Row:
    """Meet one bad input, or kill one command between its start and a little after its usual end."""
    if job["kind"] != "kill":
        return judged(cases()[job["kind"], job["name"]])
    rng = np.random.default_rng([job["seed"], job["number"]])
    return killed(job["name"], float(rng.uniform(0, 1.1)), job["number"] % TRIED_AGAIN == 0)


def summary(rows: list[Row]) -> list[str]:
    """Faults by kind, and what kills left."""
    kinds = grouped((row for row in rows if row["kind"] != "kill"), "kind")
    met = [row for group in kinds.values() for row in group]
    lines = []
    for kind, group in {**kinds, f"**all {len(kinds)} kinds**": met}.items():
        count = Counter(fault for row in group for fault in row["faults"])
        lines.append([kind, len(group), *(count[fault] for fault in FAULTS)])
    wrong = [
        f"{', '.join(r['faults'])}: {r['kind']}: {r['name']!r} (exit {r['code']}): {r['error']}"
        for r in met
        if r["faults"]
    ]
    sentences = []
    for command, group in grouped((row for row in rows if row["kind"] == "kill"), "name").items():
        left = Counter(row["left"] for row in group)
        failed = sum(not row["works"] for row in group)
        sentences.append(
            f"`{command}` killed {len(group)} times: {left['old']} times the old run, {left['new']} times the new one, "
            f"{left['neither']} times neither; {failed} times the next command fails."
        )
    title = f"Measured on {date.today()} by `python bench/run.py faults`:"
    return [title, "", *markdown(" | ".join(["kind", "cases", *FAULTS]), lines), "", *wrong, *sentences]


TABLE = Table(jobs, trial, summary, range(1), page="limits", block="measured", settings={"kills": 50})
