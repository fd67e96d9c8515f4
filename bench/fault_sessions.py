"""Bad inputs: session.toml and the names in it, views, tables of points, the robot."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path

from fault_room import Case

from data_synth.fixtures.edits import set_cell

RUN = ["run", "s", "-o", "out", "--no-recording"]
POINTS = ["run", "p", "-o", "out", "--no-recording"]
_BAD_KEYS = {
    "name": ("5", "[]", "true"),
    "length_unit": ('"cm"', "5", "[]", "{}"),
    "mount": ('"hand"', "1", "[1]"),
    "cloud_unit": ('"inch"', "{}"),
    "scanner.noise": ("-1", '"x"', "nan", "inf", "[]", "true", "1e400", "9" * 400),
    "scanner.standoff": ("0", '"x"', "-inf", "{}", "9" * 400),
    "scanner.pose": ("5", "[[1,2],[3]]", "[]", '"x"', f"[[{'9' * 400},0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]"),
    "scanner.optical_axis": ('"+x"', "[0,0,1]", "{}"),
    "sphere.radius": ("-1", '"x"', "nan"),
    "part.cad": ("5", '"nowhere.stl"', '"."'),
    "robot.gravity": ("9.81", "[0,0]", '"down"', "[0,0,nan]"),
    "robot.payload": ("5", "{ mass = -1 }", "{ mass = nan }", "{ weight = 3 }"),
    "robot.dh": ('"craig"', "5"),
    "robot.urdf": ('"nowhere.urdf"', "5", '"."'),
}
_NAMES = ("..", "../x", "/abs", "a/b", "", " ", ".hid", "a\\u0000b", "a\\nb", "x" * 300, "y" * 100_000)
_ODD_NAMES = ("[red]x[red]", ":smile: part", "Größe µ 7", "O'Brien & Söhne", "a" * 150)


def with_toml(change: Callable[[str], str | bytes], command: list[str] = RUN) -> Callable[[Path], list[str]]:
    def spoil(room: Path) -> list[str]:
        file = room / command[1] / "session.toml"
        new = change(file.read_text())
        file.write_bytes(new if isinstance(new, bytes) else new.encode())
        return command

    return spoil


def with_key(key: str, value: str) -> Callable[[str], str]:
    def change(text: str) -> str:
        import tomllib

        import tomli_w

        document = tomllib.loads(text)
        table, _, name = key.rpartition(".")
        entries = document.setdefault(table, {}) if table else document
        entries.pop(name, None)
        if key == "robot.urdf":
            entries.pop("joints", None)
        own = f"[{table}]\n{name} = {value}\n" if table else f"{name} = {value}\n"
        told = tomli_w.dumps(document)
        return told.replace(f"[{table}]\n", own, 1) if table and f"[{table}]\n" in told else own + told

    return change


def instead(file: str, what: str, command: list[str]) -> Callable[[Path], list[str]]:
    """Something else where a file should be."""

    def spoil(room: Path) -> list[str]:
        path = room / file
        path.unlink(missing_ok=True)
        if what == "pipe":
            os.mkfifo(path)
        elif what == "folder":
            path.mkdir()
        elif what == "dangling link":
            path.symlink_to(room / "nowhere")
        elif what == "device":
            path.symlink_to("/dev/zero")
        elif what == "empty":
            path.touch()
        elif what == "noise":
            path.write_bytes(bytes(range(256)) * 40)
        elif what == "UTF-16":
            path.write_text("view,cloud\n", encoding="utf-16")
        return command

    return spoil


def session_files() -> Iterator[Case]:
    """session.toml as a file and as TOML."""
    for key, values in _BAD_KEYS.items():
        for value in values:
            yield Case(f"session.toml: {key.split('.')[0]}", f"{key} = {value[:20]}", with_toml(with_key(key, value)))
    for name in _NAMES:
        yield Case(
            "name of a session", name[:20], with_toml(with_key("name", f'"{name}"'), ["run", "s", "--no-recording"])
        )
    for name in _ODD_NAMES:
        spoil = with_toml(with_key("name", f'"{name}"'), ["run", "s", "--no-recording"])
        yield Case("odd names that are right", name[:20], spoil, fine=True)
    broken: dict[str, Callable[[str], str | bytes]] = {
        "open bracket": lambda t: t + "[",
        "twice": lambda t: t + t,
        "deep": lambda t: t + "x = " + "[" * 50_000,
        "5000 digits": lambda t: "x = " + "9" * 5000 + "\n" + t,
        "Latin-1": lambda t: ("# ü\n" + t).encode("latin-1"),
        "unknown key": lambda t: "lenght_unit = 'mm'\n" + t,
        "30 MB": lambda t: t + "#" * 30_000_000,
        "NUL": lambda t: t + "\0",
        "no format": lambda t: t.replace("stitch-session/1", "stitch-session/9"),
    }
    for name, change in broken.items():
        yield Case("TOML", name, with_toml(change))
    yield Case("TOML that is right", "BOM", with_toml(lambda t: b"\xef\xbb\xbf" + t.encode()), fine=True)
    yield Case("TOML that is right", "CRLF", with_toml(lambda t: t.replace("\n", "\r\n")), fine=True)
    for what in ("pipe", "folder", "dangling link", "device", "empty", "noise"):
        yield Case("session.toml is no file", what, instead("s/session.toml", what, RUN))


def _cell(column: str, value: str, row: int = 2) -> Callable[[Path], list[str]]:
    def spoil(room: Path) -> list[str]:
        set_cell(room / "s" / "views.csv", row, column, value)
        return RUN

    return spoil


def with_text(file: str, change: Callable[[str], str], command: list[str]) -> Callable[[Path], list[str]]:
    def spoil(room: Path) -> list[str]:
        path = room / file
        path.write_text(change(path.read_text()))
        return command

    return spoil


def tables() -> Iterator[Case]:
    """views.csv, points.csv, targets.csv, frames.csv."""
    for value in ("abc", "1;5", "nan", "inf", "1e400", "9" * 5000, "1e29", "--1", "0x10"):
        yield Case("views.csv: numbers", value[:20], _cell("x", value))
    for value in ("2", "0", "nan", "1e200", ""):
        yield Case("views.csv: quaternion", value, _cell("qw", value))
    for value in ("v000", "", "a\x1bb", "z" * 100_000):
        yield Case("views.csv: names", repr(value[:10]), _cell("view", value))
    for value in ("clouds/nowhere.ply", "clouds", "../s", "x" * 5000, "views.csv", ""):
        yield Case("views.csv: cloud", value[:20], _cell("cloud", value))
    changes: dict[str, Callable[[str], str]] = {
        "header alone": lambda t: t.splitlines()[0] + "\n",
        "no column view": lambda t: t.replace("view,", "vue,", 1),
        "a cell more": lambda t: t.rstrip("\n") + ",7\n",
        "open quote": lambda t: t.replace("v001", '"v001', 1),
        "column twice": lambda t: "\n".join(f"{line},1" if i else f"{line},x" for i, line in enumerate(t.splitlines())),
        "long header": lambda t: "h" * 100_000 + "," + t.replace("\n", "\n1,").rstrip("1,"),
        "row twice": lambda t: t + t.splitlines()[-1] + "\n",
    }
    for name, change in changes.items():
        yield Case("views.csv: rows", name, with_text("s/views.csv", change, RUN))
    for file, command in (("s/views.csv", RUN), ("p/views.csv", POINTS), ("p/points.csv", POINTS)):
        for what in ("pipe", "folder", "dangling link", "device", "empty", "noise", "UTF-16"):
            yield Case(f"{Path(file).name} is no table", f"{file} {what}", instead(file, what, command))
    for what in ("pipe", "folder", "dangling link", "empty"):
        yield Case("targets.csv", what, instead("p/targets.csv", what, POINTS))
        yield Case("frames.csv", what, instead("p/frames.csv", what, POINTS))
    more: dict[str, Callable[[str], str]] = {
        "unknown view": lambda t: t + "nobody,ball0,1,2,3\n",
        "target twice": lambda t: t + t.splitlines()[1] + "\n",
        "no name": lambda t: t + "v0,,1,2,3\n",
        "text": lambda t: t + "v0,new,1,x,3\n",
        "NaN": lambda t: t + "v0,new,1,nan,3\n",
        "escape in a name": lambda t: t + "v0,a\x1b[31m,1,2,3\n",
        "metres": lambda t: "\n".join([t.splitlines()[0], *map(_in_metres, t.splitlines()[1:])]),
        "micrometres": lambda t: "\n".join([t.splitlines()[0], *(_in_metres(x, 1e3) for x in t.splitlines()[1:])]),
    }
    for name, change in more.items():
        yield Case("points.csv: rows", name, with_text("p/points.csv", change, POINTS))


def _in_metres(row: str, factor: float = 1e-3) -> str:
    view, target, *xyz = row.split(",")
    return ",".join([view, target, *(str(float(x) * factor) for x in xyz)])
