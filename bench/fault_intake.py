"""Bad inputs: folders of scans and tables of poses as people have them, for `stitch init`."""

import csv
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from fault_room import Case

from data_synth.fixtures.raw_folders import Convention, session_poses, table_of

_HEADER = "Nr.;Datei;Lage X [mm];Lage Y [mm];Lage Z [mm];Drehung um Z [°];Drehung um Y [°];Drehung um X [°]"
_FLAGS = """
--rotation nonsense
--angles grad
--unit parsec
--cloud-unit inch
--mount hand
--columns x,y,z
--columns -,x,x,x,rz,ry,rx
--poses nowhere.csv
--poses raw
--poses mine.pipe
--ball -1
--ball nan
--board nonsense
--board charuco:0x0:20:15:DICT_4X4_50
-o mine.txt
-o s
"""
Rows = list[list[str]]
Change = Callable[[Rows], Rows]


def _german(change: Change = lambda rows: rows, header: str = _HEADER) -> Callable[[Path], str]:
    """A table as a German spreadsheet saves it: semicolons, decimal commas; `change` works on its cells."""

    def text(session: Path) -> str:
        T, clouds = session_poses(session)
        numbers = table_of(T, Convention(order="ZYX", degrees=True, angles_first=False))
        cells = [[f"{x:.6f}".replace(".", ",") for x in row] for row in numbers]
        names = [[str(i), Path(cloud).name] for i, cloud in enumerate(clouds, 1)]
        rows = change([name + row for name, row in zip(names, cells, strict=True)])
        return "\r\n".join([header, *map(";".join, rows)]) + "\r\n"

    return text


def _folder(table: Callable[[Path], str], encoding: str = "utf-8") -> Callable[[Path], list[str]]:
    """The scans of s beside a table of their poses."""

    def spoil(room: Path) -> list[str]:
        shutil.copytree(room / "s" / "clouds", room / "raw")
        (room / "raw" / "Posen.csv").write_bytes(table(room / "s").encode(encoding))
        (room / "mine.txt").write_text("mine")
        os.mkfifo(room / "mine.pipe")
        return ["init", "raw", "--yes"]

    return spoil


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
        told = [float(row["time_s"]) for row in rows] if "time_s" in rows[0] else None
        return _poses_right(room) and told == (None if seconds is None else list(seconds))

    return right


def _cell(row: int, column: int, value: str) -> Change:
    return lambda rows: [[*own[:column], value, *own[column + 1 :]] if i == row else own for i, own in enumerate(rows)]


def _thousands(mark: str) -> Change:
    def marked(cell: str) -> str:
        whole, _, rest = cell.partition(",")
        return f"{int(whole):,}".replace(",", mark) + f",{rest}" if abs(int(whole)) > 999 else cell

    return lambda rows: [[*row[:2], *map(marked, row[2:])] for row in rows]


def spreadsheets() -> Iterator[Case]:
    """Tables of another country: what can be read is read right, the rest is refused with its line."""
    right: dict[str, Change] = {
        "as it is": lambda rows: rows,
        "separators at the end": lambda rows: [[*row, "", ""] for row in rows],
        "empty rows": lambda rows: [*rows, [""] * 8, [""] * 8],
        "quotes": lambda rows: [[f'"{cell}"' for cell in row] for row in rows],
        "rows of another order": lambda rows: rows[::-1],
        "units in a row of their own": lambda rows: [["", "", *["mm"] * 3, *["°"] * 3], *rows],
        "remarks in some rows": lambda rows: [[*row, "gut" * (i == 3)] for i, row in enumerate(rows)],
    }
    for name, change in right.items():
        header = _HEADER + ";Bemerkung" * (name[:7] == "remarks")
        for encoding in ("cp1252", "utf-16") if name == "as it is" else ("cp1252",):
            spoil = _folder(_german(change, header), encoding)
            told = f"{name}, {encoding}"
            yield Case("spreadsheets that are right", told, spoil, fine=True, writes=("raw/",), right=_poses_right)
    odd: dict[str, Change] = {
        "thousands with points": _thousands("."),
        "thousands with spaces": _thousands("\u00a0"),
        "a whole number with a point for thousands": _cell(2, 2, "1.269"),
        "minus of a typesetter": lambda rows: [[cell.replace("-", "\u2212") for cell in row] for row in rows],
        "mean in the last row": lambda rows: [*rows, ["", "Mittelwert", *rows[0][2:]]],
        "#WERT!": _cell(1, 4, "#WERT!"),
        "no number": _cell(1, 4, ""),
        "a cell more": lambda rows: [rows[0], [*rows[1], "5"], *rows[2:]],
        "a row less": lambda rows: rows[:-1],
        "a row twice": lambda rows: [*rows, rows[-1]],
        "a row alone": lambda rows: rows[:1],
        "cloud of another name": _cell(3, 1, "other.ply"),
        "cloud twice": _cell(3, 1, "v000.ply"),
        "open quote": _cell(3, 1, '"v003.ply'),
        "400 digits": _cell(3, 2, "9" * 400),
    }
    for name, change in odd.items():
        yield Case("spreadsheets", name, _folder(_german(change)), writes=("raw/",), right=_poses_right)
    twice = _german(header=_HEADER.replace("Lage Y", "Lage X"))
    yield Case("spreadsheets", "column twice", _folder(twice), writes=("raw/",), right=_poses_right)
    yield Case("spreadsheets", "UTF-16 without a mark", _folder(_german(), "utf-16-le"))


def clocks() -> Iterator[Case]:
    """Times of day beside the poses: seconds where they are times that run on, else no times at all."""
    minutes = [60.0 * i for i in range(6)]
    told: dict[str, tuple[list[str], list[float] | None]] = {
        "hours and minutes": ([f"9:{i:02}" for i in range(6)], minutes),
        "with a date": ([f"23.11.2026 09:0{i}:00" for i in range(6)], minutes),
        "past midnight": (["23:58", "23:59", "0:00", "0:01", "0:02", "0:03"], None),
        "99 minutes": ([f"9:{i}5" for i in range(4, 10)], None),
        "25 hours": ([f"{i}:00" for i in range(20, 26)], None),
        "half of them": (["9:00", "", "9:02", "", "9:04", ""], None),
        "afternoon": ([f"0{i}:00 PM" for i in range(1, 7)], [60 * m for m in minutes]),
    }
    for name, (cells, seconds) in told.items():
        table = _german(
            lambda rows, cells=cells: [[*row, cell] for row, cell in zip(rows, cells, strict=True)],
            _HEADER + ";Uhrzeit",
        )
        yield Case("clock times", name, _folder(table), fine=True, writes=("raw/",), right=_times_right(seconds))


def raw_folders() -> Iterator[Case]:
    """Flags that cannot be, and folders that hold something else."""
    for line in _FLAGS.strip().splitlines():
        yield Case("flags of init", line, lambda room, words=line: [*_folder(_german())(room), *words.split()])
    for name, change in {
        "an empty cloud": lambda raw: (raw / "v002.ply").write_text(""),
        "no clouds": lambda raw: [file.unlink() for file in raw.glob("*.ply")],
        "no poses": lambda raw: (raw / "Posen.csv").unlink(),
        "two tables": lambda raw: shutil.copy(raw / "Posen.csv", raw / "Posen2.csv"),
        "a session there": lambda raw: (raw / "session.toml").write_text("x"),
        "a link in a circle": lambda raw: (raw / "again").symlink_to(raw),
    }.items():
        yield Case("folders for init", name, _changed(change))
    for folder in ("nowhere", "mine.txt", "s", "r"):
        yield Case("folders for init", folder, lambda room, f=folder: [_folder(_german())(room)[0], f, "--yes"])


def _changed(change: Callable[[Path], object]) -> Callable[[Path], list[str]]:
    def spoil(room: Path) -> list[str]:
        arguments = _folder(_german())(room)
        change(room / "raw")
        return arguments

    return spoil
