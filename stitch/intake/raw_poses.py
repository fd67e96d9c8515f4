"""Poses as files have them: rows of numbers with what names them, before anybody says what the numbers mean."""

import csv
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from stitch.controllers.program import POSE_COLUMNS, csv_text, import_file
from stitch.errors import InputError
from stitch.frames import Array
from stitch.intake.pose_tables import NumberTable, parse_number_table, read_number_table
from stitch.reading.range_image import poses_in_scans, times_in_scans
from stitch.reading.text_files import read_text, require_file, shortened
from stitch.reading.yaml_file import parse_yaml

# Times of day as tables have them, 09:14:13 with a date or without, as seconds; what cannot be told is said.

_CLOCK = re.compile(
    r"(?:(?P<date>[\d.\-/]+)[T ]+)?"
    r"(?P<h>[01]?\d|2[0-3]):(?P<m>[0-5]\d)(?::(?P<s>[0-5]\d(?:[.,]\d+)?))?(?: ?(?P<half>[AP]M)|Z)?",
    re.IGNORECASE,
)
_YEAR_FIRST = re.compile(r"(\d{4})[-./](\d{1,2})[-./](\d{1,2})")
_YEAR_LAST = re.compile(r"(\d{1,2})([-./])(\d{1,2})\2(\d{4}|\d{2})")
DAY_S, _CENTURY = 86400.0, 2000
# Of this century, counted in seconds since 1970.
EPOCH_S = (0.9e9, 4.0e9)
DAY_FIRST, MONTH_FIRST = "dates with the day first", "dates with the month first"


@dataclass(frozen=True)
class ClockTimes:
    """A column of times of day."""

    seconds: Array | None  # (n,) since the first; None where they are left out
    words: str  # how dates were read, or why times are left out; empty where nothing is to be said
    first_s: float = 0.0  # the first since the calendar's beginning, or since midnight where no date stands beside it


def find_clock_column(labels: Sequence[tuple[str, ...]]) -> ClockTimes | None:
    """The one column of times of day among the texts beside the rows of a table; None without, or with several."""
    if len({len(texts) for texts in labels}) != 1:
        return None
    times = [t for column in zip(*labels, strict=True) if (t := clock_times(column)) is not None]
    return times[0] if len(times) == 1 else None


def clock_times(cells: Sequence[str]) -> ClockTimes | None:
    """Read a column; None where a cell is no time, or where all are the same.

    Dates whose order nobody states are read both ways. What runs backwards one way is read the other way.
    """
    both = [_column_seconds(cells, day_first) for day_first in (True, False)]
    known = [moments for moments in both if moments is not None]
    if not known or all((moments == moments[0]).all() for moments in known):
        return None
    forwards = [moments for moments in known if (np.diff(moments) >= 0).all()]
    if not forwards:
        return ClockTimes(None, "times of day run backwards and are left out; to fix: write the date beside them")
    since_first = [moments - moments[0] for moments in forwards]
    if len(forwards) == 2 and not np.array_equal(since_first[0], since_first[1]):
        return ClockTimes(
            None,
            f"times are left out, as {cells[0].strip()} may begin with the day or the month; to fix: write dates as "
            "2026-12-31",
        )
    alike = len(forwards) == 2
    words = "" if alike else DAY_FIRST if forwards[0] is both[0] else MONTH_FIRST
    return ClockTimes(np.asarray(since_first[0]), words, float(forwards[0][0]))


def _column_seconds(cells: Sequence[str], day_first: bool) -> Array | None:
    told = [_time_of_day_seconds(cell.strip(), day_first) for cell in cells]
    if not told or any(t is None for t in told):
        return None
    moments: Array = np.array(told, float)
    return moments


def _time_of_day_seconds(cell: str, day_first: bool) -> float | None:
    found = _CLOCK.fullmatch(cell)
    if not found:
        return None
    day = _date_ordinal(found["date"], day_first) if found["date"] else 0
    if day is None:
        return None
    hour = int(found["h"])
    if found["half"]:
        hour = hour % 12 + 12 * (found["half"].upper() == "PM")
    return DAY_S * day + 3600.0 * hour + 60.0 * int(found["m"]) + float((found["s"] or "0").replace(",", "."))


def _date_ordinal(text: str, day_first: bool) -> int | None:
    """Days; None where it is no date. With dots the day always stands first."""
    if found := _YEAR_FIRST.fullmatch(text):
        year, month, day = map(int, found.groups())
    elif found := _YEAR_LAST.fullmatch(text):
        first, second, year = int(found[1]), int(found[3]), int(found[4])
        year += _CENTURY * (len(found[4]) == 2)
        day, month = (first, second) if day_first or found[2] == "." else (second, first)
    else:
        return None
    try:
        return date(year, month, day).toordinal()
    except ValueError:
        return None


# Poses in JSON and YAML: lists, matrices and mappings, however deep, as rows of named numbers.

PoseRow = tuple[tuple[str, ...], dict[str, float]]  # texts beside a pose, and its numbers by name

# Sizes of a bare list of numbers that can be a pose or joint angles.
_SIZES = (5, 6, 7, 8, 9, 12, 16)
_MATRICES = ((3, 3), (3, 4), (4, 4), (1, 3), (3, 1), (1, 4), (4, 1))


def nested_rows(document: Any) -> list[PoseRow]:
    """Rows of a document; numbers without names are called 0, 1, 2 … Empty if it holds no poses.

    A pose may be a list of numbers, a matrix, or a mapping; poses may stand in a list, or in a mapping by name.
    """
    if isinstance(document, dict):
        named = [((str(key), *_texts(value)), _pose_numbers(value)) for key, value in document.items()]
        direct = [(texts, row) for texts, row in named if row is not None]
        if len(direct) > 1 and len({tuple(row) for _, row in direct}) == 1:
            return direct
    own = _pose_numbers(document)
    if own is not None:
        return [(_texts(document), own)]
    if isinstance(document, list):
        rows: list[PoseRow] = []
        for item in document:
            row = _pose_numbers(item)
            rows += [(_texts(item), row)] if row is not None else nested_rows(item)
        return rows
    deeper = [nested_rows(value) for value in document.values()] if isinstance(document, dict) else []
    return max(deeper, key=len, default=[])


def _pose_numbers(value: Any) -> dict[str, float] | None:
    """The numbers of one pose by name, or None if a value is none."""
    flat = _flat_numbers(value)
    if flat is not None:
        return {str(i): x for i, x in enumerate(flat)} if len(flat) in _SIZES else None
    if not isinstance(value, dict):
        return None
    data = _matrix_numbers(value)
    if data is not None:
        return {str(i): x for i, x in enumerate(data)}
    inner = next((row for v in value.values() if isinstance(v, dict) and (row := _pose_numbers(v)) is not None), None)
    if inner is not None:
        # The pose stands one level deeper, beside a time, a temperature or a name.
        unnamed = all(name.isdigit() for name in inner)
        beside = _ros_stamp(value) | {k: float(x) for k, x in value.items() if _is_number(x)}
        return inner if unnamed else beside | inner
    out = _named_numbers(value)
    return out if len(out) >= _SIZES[0] else None


def _ros_stamp(value: dict[str, Any]) -> dict[str, float]:
    """The time of a message of ROS, 1 or 2, from its header; nothing where none is written."""
    header = value.get("header")
    stamp = header.get("stamp") if isinstance(header, dict) else None
    if not isinstance(stamp, dict):
        return {}
    whole, part = stamp.get("sec", stamp.get("secs")), stamp.get("nanosec", stamp.get("nsecs", 0))
    if not (isinstance(whole, (int, float)) and isinstance(part, (int, float)) and whole > 0):
        return {}
    return {"time_s": whole + 1e-9 * part}


def _matrix_numbers(value: dict[str, Any]) -> list[float] | None:
    """16 numbers that stand alone in a mapping: OpenCV's and Zivid's layouts."""
    inner = [v for v in value.values() if isinstance(v, (list, dict))]
    if len(inner) != 1 and not {"rows", "cols", "data"} <= {*value}:
        lists = [flat for v in inner if (flat := _flat_numbers(v)) is not None and len(flat) == 16]
        return lists[0] if len(lists) == 1 else None
    if len(inner) != 1:
        return None
    flat = _flat_numbers(inner[0])
    if flat is not None:
        return flat if len(flat) in (12, 16) else None
    return _matrix_numbers(inner[0]) if isinstance(inner[0], dict) else None


def _flat_numbers(value: Any) -> list[float] | None:
    """The numbers of a list, or of a matrix row by row; None if it is neither."""
    if not isinstance(value, list) or not value:
        return None
    if all(_is_number(item) for item in value):
        return [float(item) for item in value]
    rows = [_flat_numbers(item) for item in value if isinstance(item, list) and all(_is_number(x) for x in item)]
    shape = (len(value), *{len(row) for row in rows if row is not None})
    if len(rows) < len(value) or shape not in _MATRICES:
        return None
    return [x for row in rows if row is not None for x in row]


def _named_numbers(value: dict[str, Any], prefix: str = "") -> dict[str, float]:
    """Numbers of a mapping by their path: position.x, rotation.0 …"""
    out: dict[str, float] = {}
    for key, item in value.items():
        name = f"{prefix}{key}"
        flat = _flat_numbers(item)
        if _is_number(item):
            out[name] = float(item)
        elif flat is not None:
            out |= {f"{name}.{i}": x for i, x in enumerate(flat)}
        elif isinstance(item, dict) and name.count(".") < 5:
            out |= _named_numbers(item, f"{name}.")
    return out


def _texts(value: Any) -> tuple[str, ...]:
    """Texts that stand beside the numbers of a pose."""
    return tuple(item for item in value.values() if isinstance(item, str)) if isinstance(value, dict) else ()


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


STRUCTURED = (".json", ".yaml", ".yml", ".npy", ".npz")
TABLES = (".txt", ".csv", ".dat", ".tsv", ".tab", ".asc", ".pose", ".poses")
_LAST_ROW = np.array([0.0, 0.0, 0.0, 1.0])
_MAX_POSES_MB = 50


@dataclass(frozen=True)
class RawPoses:
    """V rows of C numbers; each row holds one pose, or the joint angles of one."""

    source: str  # file or files, for messages
    header: tuple[str, ...] | None  # names of the columns
    numbers: Array  # (V, C)
    labels: tuple[tuple[str, ...], ...]  # per row the texts beside it, such as a view's name or its cloud's
    words: str  # how it was read

    @property
    def clock(self) -> ClockTimes | None:
        """Times of day, where one of the texts beside the poses is one."""
        return find_clock_column(self.labels)

    @property
    def time_s(self) -> Array | None:
        """Seconds (V,) since the first pose, where one of the texts beside the poses is a time of day."""
        return None if self.clock is None else self.clock.seconds

    def renamed(self, names: Sequence[str]) -> "RawPoses":
        """The same with columns named by a person.

        Raises:
            InputError: more or fewer names than columns, or a name twice.
        """
        if twice := {name for name in names if name != "-" and names.count(name) > 1}:
            raise InputError(f"--columns {','.join(names)}: {twice.pop()} stands twice; to fix: name each column once")
        if len(names) != self.numbers.shape[1]:
            raise InputError(
                f"--columns {','.join(names)}: {len(names)} names, {self.source} has {self.numbers.shape[1]} columns "
                "of numbers; to fix: name each, and - for one to leave out"
            )
        return replace(self, header=tuple(names), words=f"{self.words}; columns as named")


def read_raw_poses(files: Sequence[Path]) -> RawPoses:
    """Read the rows of one file, or of several that hold one pose each.

    Raises:
        InputError: no poses in a file, or files of different kinds; names file and line.
    """
    if len(files) == 1:
        return _read_file(files[0])
    rows = [_read_file(file) for file in files]
    odd = next((r for r in rows if len(r.numbers) != 1), None)
    if odd is not None:
        raise InputError(f"{odd.source}: holds {len(odd.numbers)} poses, one a file is expected; to fix: name one file")
    width = rows[0].numbers.shape[1]
    other = next((r for r in rows if r.numbers.shape[1] != width or r.header != rows[0].header), None)
    if other is not None:
        raise InputError(f"{other.source}: is written otherwise than {rows[0].source}; to fix: export all alike")
    where = f"{files[0].name} … {files[-1].name}"
    return RawPoses(
        source=where,
        header=rows[0].header,
        numbers=np.vstack([r.numbers for r in rows]),
        labels=tuple((file.stem, *row.labels[0]) for file, row in zip(files, rows, strict=True)),
        words=f"{len(files)} files, a pose each",
    )


def _read_file(file: Path) -> RawPoses:
    require_file(file, "name a file of poses")
    suffix = file.suffix.lower()
    if suffix in (".npy", ".npz"):
        return _from_numpy(file)
    if suffix in (".json", ".yaml", ".yml"):
        told = read_text(file, "name a file of poses", _MAX_POSES_MB)
        documents = [_from_json(file, told)] if suffix == ".json" else parse_yaml(file, told)
        document = documents[0] if len(documents) == 1 else documents
        return _from_rows(file, nested_rows(document), suffix[1:].upper())
    table = read_number_table(file)
    return _matrix_blocks(table) or RawPoses(str(file), table.header, table.numbers, table.labels, table.words)


def _matrix_blocks(table: NumberTable) -> RawPoses | None:
    """4×4 matrices, or 3×4 ones, over several lines each; None if the table is none of that."""
    x = table.numbers
    if x.shape[1] != 4:
        return None
    if len(x) % 4 == 0 and np.allclose(x[3::4], _LAST_ROW):
        return RawPoses(str(table.file), None, x.reshape(-1, 16), ((),) * (len(x) // 4), "4×4 matrices")
    if len(x) % 4 == 0 and np.allclose(x.reshape(-1, 4, 4)[:, :3, 3], 0) and np.allclose(x.reshape(-1, 16)[:, 15], 1):
        return RawPoses(str(table.file), None, x.reshape(-1, 16), ((),) * (len(x) // 4), "4×4 matrices by columns")
    if len(x) % 3 == 0:
        R = x.reshape(-1, 3, 4)[:, :, :3]
        if np.allclose(R @ R.transpose(0, 2, 1), np.eye(3), atol=1e-3):
            return RawPoses(str(table.file), None, x.reshape(-1, 12), ((),) * (len(x) // 3), "3×4 matrices")
    return None


def _from_json(file: Path, text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{file}: not valid JSON ({shortened(reason)}); to fix: correct it there") from None


def _from_numpy(file: Path) -> RawPoses:
    try:
        loaded = np.load(file, allow_pickle=False)
        arrays = {file.stem: loaded} if isinstance(loaded, np.ndarray) else {k: loaded[k] for k in loaded.files}
    except (ValueError, OSError, EOFError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{file}: cannot be read ({shortened(reason)}); to fix: save plain numbers") from None
    fitting = [a for a in arrays.values() if a.dtype.kind in "fiu" and a.ndim in (2, 3) and a.size]
    if not fitting:
        raise InputError(f"{file}: holds no array (V, C) or (V, 4, 4); to fix: save the poses as one of these")
    x = np.asarray(max(fitting, key=lambda a: a.ndim), float)
    flat = x.reshape(1, 16) if x.shape == (4, 4) else x.reshape(len(x), -1)
    return RawPoses(str(file), None, flat, ((),) * len(flat), f"an array {'×'.join(map(str, x.shape))}")


def _from_rows(file: Path, rows: Sequence[tuple[tuple[str, ...], dict[str, float]]], kind: str) -> RawPoses:
    if not rows:
        raise InputError(f"{file}: holds no poses that are known; to fix: write a table or 4×4 matrices")
    names = tuple(rows[0][1])
    for i, (_, row) in enumerate(rows, 1):
        if tuple(row) != names:
            raise InputError(f"{file}: pose {i} is written otherwise than the first; to fix: write all alike")
    numbers = np.array([list(row.values()) for _, row in rows], float)
    if not np.isfinite(numbers).all():
        raise InputError(f"{file}: a number is not finite; to fix: leave that pose out")
    header = None if all(re.fullmatch(r"\d+", name) for name in names) else names
    return RawPoses(str(file), header, numbers, tuple(labels for labels, _ in rows), kind)


# Poses of a folder without a table: those in the headers of its scans.


def header_poses(clouds: Sequence[Path]) -> RawPoses:
    """The pose in the header of each scan, named as its file is, with the time where the header has one.

    Raises:
        InputError: a header without a pose.
    """
    poses = poses_in_scans(list(clouds))
    if poses is None:
        raise InputError(
            f"{clouds[0].parent}: no poses in the headers of the scans; to fix: name them with --poses FILE"
        )
    told = times_in_scans(list(clouds))
    times: Sequence[tuple[str, ...]] = [()] * len(clouds) if told is None else [(time,) for time in told]
    words = "they may be the scanner's own, of scans that were registered already: then the hand-eye is about unity"
    return RawPoses(
        source=f"{clouds[0].name} … {clouds[-1].name}",
        header=None,
        numbers=poses.reshape(-1, 16),
        labels=tuple((cloud.name, *time) for cloud, time in zip(clouds, times, strict=True)),
        words=words,
    )


# Which pose belongs to which scan by the clock: times in the names of the clouds against times beside the poses.

_STAMP = re.compile(
    r"(?<!\d)(\d{4})[-_.]?(\d{2})[-_.]?(\d{2})[T_\- ]+(\d{2})[-_.h]?(\d{2})[-_.m]?(\d{2})(?:[-_.,](\d{3}|\d{6}))?(?!\d)"
)
# Seconds since 1970 with a fraction, or milli-, micro- or nanoseconds, as cameras and ROS call their files.
_SINCE_1970 = re.compile(r"(?<![\d.])(\d{10}(?:[._]\d{1,9})?|\d{13}|\d{16}|\d{19})(?![\d.])")
# Of the usual time from scan to scan: a pose farther from its scan was not taken with it.
_NEAR = 0.1


def rows_by_time(
    clouds: Sequence[Path], labels: Sequence[tuple[str, ...]], numbers: Array | None = None
) -> tuple[list[int], float] | None:
    """Per cloud the row nearest in time, and the farthest of them, s; None where times do not tell it.

    Args:
        labels: per row the texts beside it: times of day, for clouds that have date and time in their names.
        numbers: (V, C) of the table: a column of seconds since 1970, for clouds that have these.
    """
    clock, own = find_clock_column(labels), [_calendar_seconds(cloud.stem) for cloud in clouds]
    if clock is not None and clock.seconds is not None:
        # Times of day without a date are of any day.
        dated = clock.first_s >= DAY_S
        poses = clock.first_s + clock.seconds
        return _nearest_rows(own, poses if dated else poses % DAY_S, None if dated else DAY_S)
    columns = [] if numbers is None else [t for c in numbers.T if (t := since_1970(c)) is not None]
    return (
        _nearest_rows([_unix_seconds(cloud.stem) for cloud in clouds], columns[0], None) if len(columns) == 1 else None
    )


def _nearest_rows(own: Sequence[float | None], poses: Array, day: float | None) -> tuple[list[int], float] | None:
    """Rows and the farthest of them, unless one is too far away or belongs to two."""
    if len(own) < 2 or None in own:
        return None
    scans: Array = np.array(own, float)
    away = np.abs((scans if day is None else scans % day)[:, None] - poses)
    rows = away.argmin(axis=1)
    farthest = float(away.min(axis=1).max())
    usual = float(np.median(np.diff(np.sort(scans))))
    if len(set(rows.tolist())) < len(rows) or farthest > _NEAR * usual:
        return None
    return rows.tolist(), farthest


def since_1970(times: Array) -> Array | None:
    """Seconds since 1970 of a column (n,) of times of this century, in s, ms, µs or ns; None of other numbers."""
    for second in (1.0, 1e-3, 1e-6, 1e-9):
        seconds: Array = times * second
        if len(times) and EPOCH_S[0] < seconds.min() and seconds.max() < EPOCH_S[1]:
            return seconds
    return None


def _unix_seconds(name: str) -> float | None:
    """Seconds since 1970 of the one such number in a name; None where there is none, or several."""
    found = _SINCE_1970.findall(name)
    told = since_1970(np.array([float(found[0].replace("_", "."))])) if len(found) == 1 else None
    return None if told is None else float(told[0])


def _calendar_seconds(name: str) -> float | None:
    """Seconds since the calendar's beginning of the one time in a name; None where there is none, or several."""
    found = _STAMP.findall(name)
    if len(found) != 1:
        return None
    year, month, day, hour, minute, second, part = found[0]
    try:
        days = date(int(year), int(month), int(day)).toordinal()
    except ValueError:
        return None
    clock = 3600 * int(hour) + 60 * int(minute) + int(second)
    return DAY_S * days + clock + (float(f"0.{part}") if part else 0.0)


# Poses of a robot program: its points that have one.

PROGRAMS = (".ls", ".src", ".mod", ".script")
_KUKA_DATA = ".dat"
_LOOKED_AT = 65536


def is_program(file: Path) -> bool:
    """Whether a file is a program of a robot; .dat is the ending of a KUKA's points, and of many a table."""
    kind = file.suffix.lower()
    if kind != _KUKA_DATA:
        return kind in PROGRAMS
    with file.open("rb") as stream:
        return b"DEFDAT" in stream.read(_LOOKED_AT).upper()


def read_by_its_program(file: Path) -> bool:
    """Whether a file holds the points of a KUKA's program that lies beside it, which is read instead."""
    return file.suffix.lower() == _KUKA_DATA and any(file.with_suffix(s).exists() for s in (".src", ".SRC"))


def program_poses(file: Path) -> RawPoses:
    """Points with a pose, mm; of a program with joint targets alone, these.

    Raises:
        InputError, NoResultError: as the program's reader does.
    """
    told = import_file(file, "mm")
    header, *body = list(csv.reader(told.text.splitlines()))
    posed = POSE_COLUMNS[-1] in header
    kept = [row for row in body if row[-1]] if posed else body
    columns = [i for i in range(len(header)) if all(row[i] for row in kept)]
    table = parse_number_table(file, csv_text([[row[i] for i in columns] for row in [header, *kept]]))
    words = "the points of a robot program"
    left = len(body) - len(kept)
    words += f", {left} without a pose left out" if left else ""
    if told.warnings:
        words += (
            "; where a tool or a base was in force, the hand-eye is that of the tool, unless `stitch import --frame … "
            "--tool …` has made flange poses of them"
        )
    return RawPoses(str(file), table.header, table.numbers, table.labels, words)
