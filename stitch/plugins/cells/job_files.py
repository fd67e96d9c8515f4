"""What the commands of all cells share: reading of job files and tables, and what they hand out.

A job file is TOML with a format; its tables, words, numbers and file names are checked key by key. Handed out are
tables of poses and columns, a session folder, a Rerun recording, a page, pictures and JSON.

Recording, page and pictures come from whoever offers them under the entry points `stitch.cell_recordings`,
`stitch.cell_reports` and `stitch.cell_pictures`, by the command's name.
"""

import csv
import json
import math
import reprlib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.output.session_files import SessionFiles, TableColumns, write_sessions
from stitch.session.reading.csv_files import TableRow, read_csv_rows
from stitch.session.reading.text_files import read_toml
from stitch.system.files import whole_file

# No length, angle or sigma of a cell lies outside; beyond, squares overflow or vanish.
LOWEST_VALUE = 1e-12
HIGHEST_VALUE = 1e9
# Points that lie within this share of their extent of one line leave the turn about it open.
_FLAT = 1e-3
POSE_COLUMNS = "x y z a_deg b_deg c_deg"


@dataclass(frozen=True)
class JobTable:
    """A table of a job file, read key by key. All methods raise `InputError` that names file, place and remedy."""

    file: Path
    entries: dict[str, Any]
    place: str = ""  # of the table in the file

    def __contains__(self, key: str) -> bool:
        return key in self.entries

    def refusal(self, key: str, remedy: str) -> InputError:
        """Return the error that refuses the value of a key."""
        return InputError(f"{self.file}: {self._at(key)} is {reprlib.repr(self.entries.get(key))}; to fix: {remedy}")

    def table(self, key: str, known: Collection[str], required: bool = False) -> "JobTable":
        """Return a table within this one, empty where it may be missing; unknown keys are refused."""
        if required and not isinstance(self.entries.get(key), dict):
            raise InputError(f"{self.file}: [{self._at(key)}] is missing; to fix: add this table")
        return checked_table(self.file, self._at(key), self.entries.get(key, {}), known)

    def choice(self, key: str, known: Collection[str], default: str | None = None) -> str:
        """Return one of some words."""
        value = self.entries.get(key, default)
        if not isinstance(value, str) or value not in known:
            raise self.refusal(key, f"write one of {', '.join(known)}")
        return value

    def number(self, key: str, default: float | None = None, positive: bool = False) -> float:
        """Return a finite number, above zero if `positive`."""
        return self._finite(key, self.entries.get(key, default), positive)

    def vectors(self, key: str, shape: tuple[int, ...], form: str) -> Array:
        """Return finite numbers of a shape, such as (3,) for [x, y, z]; `form` says how to write them."""

        def flat(value: Any, shape: tuple[int, ...]) -> list[Any]:
            if not shape:
                return [value]
            if not isinstance(value, list) or len(value) != shape[0]:
                raise InputError(f"{self.file}: {self._at(key)} is {reprlib.repr(value)}; to fix: write {form}")
            return [entry for part in value for entry in flat(part, shape[1:])]

        return np.array([self._finite(key, number, False) for number in flat(self.entries.get(key), shape)]).reshape(
            shape
        )

    def pose(self, key: str) -> Array:
        """Return the pose (4, 4) of a table with the keys x, y, z, a_deg, b_deg, c_deg."""
        names = POSE_COLUMNS.split()
        numbers = self.table(key, names, required=True)
        return poses_from_rows(np.array([numbers.number(name) for name in names]))

    def path(self, key: str) -> Path:
        """Return a file that is named relative to the job file."""
        value = self.entries.get(key)
        if not isinstance(value, str):
            raise self.refusal(key, "name a file in quotes")
        return self.file.parent / value

    def _at(self, key: str) -> str:
        return f"{self.place}.{key}" if self.place else key

    def _finite(self, key: str, value: Any, positive: bool) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            wanted = "a finite number"
        elif abs(value) > HIGHEST_VALUE:
            wanted = "a number that a cell can have"
        elif positive and value < LOWEST_VALUE:
            wanted = "a number above zero"
        else:
            return float(value)
        raise InputError(f"{self.file}: {self._at(key)} is {value!r}; to fix: write {wanted}")


def read_job_file(file: Path, expected_format: str, known: Collection[str], example: str) -> JobTable:
    """Read a job file; unknown keys of its top level are refused.

    Args:
        expected_format: the format it must state, such as "stitch-drill/1".
        example: where a job of that format lies.

    Raises:
        InputError: it is missing, not TOML, of another format, or holds an unknown key.
    """
    document = read_toml(file, f"see {example} for how it looks")
    if document.get("format") != expected_format:
        raise InputError(f'{file}: format is {document.get("format")!r}; to fix: write "{expected_format}"')
    return checked_table(file, "", document, known)


def checked_table(file: Path, place: str, entries: Any, known: Collection[str]) -> JobTable:
    """Return entries as a table; refuse a key that nobody reads, since most are misspelt.

    Raises:
        InputError: `entries` is not a table or holds an unknown key.
    """
    if not isinstance(entries, dict):
        raise InputError(f"{file}: {place} is no table; to fix: write [{place}]")
    for key in entries:
        if key not in known:
            close = get_close_matches(key, known, 1)
            hint = f"write {close[0]!r}" if close else f"write one of {', '.join(sorted(known))}"
            raise InputError(f"{file}: unknown key {f'{place}.{key}' if place else key!r}; to fix: {hint}")
    return JobTable(file, entries, place)


@dataclass(frozen=True)
class CsvColumns:
    """The wanted columns of a CSV file, row by row."""

    texts: dict[str, list[str]]
    numbers: dict[str, Array]  # (N,) each
    rows: int

    def stack(self, names: str) -> Array:
        """Return number columns (N, k) by their names, separated by blanks."""
        return np.column_stack([self.numbers[name] for name in names.split()])


def read_columns(file: Path, texts: str, numbers: str) -> CsvColumns:
    """Read a CSV with a header line; other columns are left alone.

    Args:
        texts: names of text columns, separated by blanks.
        numbers: names of number columns, separated by blanks.

    Raises:
        InputError: the file, a column or a value is missing or no finite number; names the line.
    """
    header, rows = read_csv_rows(file)
    for name in (*texts.split(), *numbers.split()):
        if name not in header:
            raise InputError(
                f"{file}: column {name!r} is missing; to fix: name {texts} {numbers} in the header".rstrip()
            )
    if not rows:
        raise InputError(f"{file}: no rows below the header; to fix: add one per line")
    for row in rows:
        for name in texts.split():
            if not row[name]:
                raise InputError(f"{row.where}: {name} is empty; to fix: write a name")
    return CsvColumns(
        {name: [row[name] for row in rows] for name in texts.split()},
        {name: np.array([_number(row, name) for row in rows]) for name in numbers.split()},
        len(rows),
    )


def require_unique(file: Path, what: str, names: list[str]) -> None:
    """Raise `InputError` where the name of a thing (`what`, such as "hole") stands in two rows."""
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{file}: {what} {name} stands twice; to fix: leave one of them out, or rename it")


def _number(row: TableRow, name: str) -> float:
    value = row.number(name)
    if abs(value) > HIGHEST_VALUE:
        raise InputError(f"{row.where}: {name} is {row[name]!r}; to fix: write a number that a cell can have")
    return value


@dataclass(frozen=True)
class Wanted:
    """What a person asks a cell's command for."""

    output: Path | None = None  # table or folder
    recording: Path | None = None
    report: Path | None = None
    session: Path | None = None
    as_json: bool = False


def write_pictures(command: str, folder: Path, *results: Any) -> list[str]:
    """Write the pictures of a command's job and result (`results`) into its folder; returns the files' names."""
    offered = entry_points(group="stitch.cell_pictures", name=command)
    return [name for writer in offered for name in writer.load()(*results, folder)]


def write_recording_and_page(command: str, recording: Path | None, report: Path | None, *results: Any) -> None:
    """Write recording and page of a command's job and result (`results`), each whole or not at all.

    Raises:
        InputError: nobody offers one for this command, or its folder does not exist.
    """
    for group, path in (("stitch.cell_recordings", recording), ("stitch.cell_reports", report)):
        if path is None:
            continue
        offered = entry_points(group=group, name=command)
        if not offered:
            raise InputError(f"{path}: no writer for `stitch {command}` is installed; to fix: install stitch anew")
        if not path.parent.is_dir():
            raise InputError(f"{path}: its folder does not exist; to fix: make it first")
        with whole_file(path) as scratch:
            for writer in offered:
                writer.load()(*results, scratch)


def hand_out(
    command: str, wanted: Wanted, sessions: Callable[[], list[SessionFiles]], document: Callable[[], Any], *results: Any
) -> bool:
    """Write sessions, recording and page of a command's job and result (`results`), and its JSON, as far as wanted.

    Args:
        sessions, document: make the sessions, and the plain data for JSON.

    Returns:
        Whether people are to read it; JSON was wanted alone where not.

    Raises:
        InputError: as `write_recording_and_page`.
    """
    if wanted.session is not None:
        write_sessions(wanted.session, sessions())
    write_recording_and_page(command, wanted.recording, wanted.report, *results)
    if wanted.as_json:
        print(json.dumps(document(), indent=1))
    return not wanted.as_json


def fixed_digits(values: Array, digits: int) -> str:
    """Return numbers in a row of a table, without a negative zero."""
    return " ".join(f"{value:.{digits}f}" for value in np.round(values, digits) + 0.0)


def on_a_line(points: Array) -> bool:
    """Return whether points (N, 3) lie on one line, or all in one place."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(len(points) < 2 or spread[1] <= _FLAT * max(spread[0], 1e-12))


def poses_from_rows(numbers: Array) -> Array:
    """Return poses (..., 4, 4) from rows (..., 6): x y z, and degrees about z, y', x''."""
    R = Rotation.from_euler("ZYX", numbers[..., 3:].reshape(-1, 3), degrees=True).as_matrix()
    return frames.make(R.reshape(*numbers.shape[:-1], 3, 3), numbers[..., :3])


def rows_from_poses(poses: Array) -> Array:
    """Return rows (N, 6) from poses (N, 4, 4), as `poses_from_rows` takes them."""
    return np.hstack([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_euler("ZYX", degrees=True)])


def poses_from_columns(table: CsvColumns) -> Array:
    """Return poses (N, 4, 4) of a table that holds the six columns."""
    return poses_from_rows(table.stack(POSE_COLUMNS))


def write_poses(file: Path, key: str, names: Sequence[str], poses: Array) -> None:
    """Write a CSV of named poses (N, 4, 4)."""
    rows = np.round(rows_from_poses(poses), 6) + 0.0
    columns = {name: rows[:, i] for i, name in enumerate(POSE_COLUMNS.split())}
    write_columns(file, {key: list(names), **columns})


def write_columns(file: Path, columns: Mapping[str, Sequence[object] | Array]) -> None:
    """Write a CSV with a header; numbers keep nine digits."""
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(columns)
        for row in zip(*columns.values(), strict=True):
            writer.writerow([f"{value:.9g}" if isinstance(value, float) else value for value in row])


def points_table(views: Sequence[str], targets: Sequence[str], places: Array, sigma: Array | None) -> TableColumns:
    """Return the columns view, target, x, y, z and, where it is known, sigma.

    Args:
        views: N names, one for each point.
        targets: N names of what was seen there.
        places: (N, 3) in the sensor's frame.
        sigma: (N,) of each coordinate; None where nobody knows it.
    """
    columns: dict[str, Any] = {"view": list(views), "target": list(targets)}
    columns |= dict(zip("xyz", places.T, strict=True))
    return columns if sigma is None else columns | {"sigma": np.asarray(sigma, float)}
