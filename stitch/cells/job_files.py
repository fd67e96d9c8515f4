"""A cell's job file: its format, and checks of tables, words, numbers and file names."""

import csv
import math
import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stitch import frames
from stitch.errors import InputError
from stitch.frames import Array
from stitch.reading.csv_files import finite_number, read_csv_lines
from stitch.reading.text_files import read_toml
from stitch.system.files import whole_file
from stitch.writing.session_files import TableColumns

# No length, angle or sigma of a cell lies outside; beyond, squares overflow or vanish.
LOWEST_VALUE, HIGHEST_VALUE = 1e-12, 1e9


def read_job_file(file: Path, expected_format: str, known: set[str], example: str) -> dict[str, Any]:
    """The document of a job file.

    Args:
        expected_format: the format it must state, such as "stitch-drill/1".
        known: the keys of its top level.
        example: where a job of that format lies.

    Raises:
        InputError: it is missing, not TOML, of another format, or holds an unknown key.
    """
    document = read_toml(file, f"see {example} for how it looks")
    if document.get("format") != expected_format:
        raise InputError(f'{file}: format is {document.get("format")!r}; to fix: write "{expected_format}"')
    check_keys(file, "", document, known)
    return document


def table(file: Path, document: dict[str, Any], name: str) -> dict[str, Any]:
    """A required table of a document.

    Raises:
        InputError: it is missing or not a table.
    """
    entry = document.get(name)
    if not isinstance(entry, dict):
        raise InputError(f"{file}: [{name}] is missing; to fix: add this table")
    return entry


def check_keys(file: Path, place: str, entries: Any, known: set[str]) -> None:
    """Refuse a key that nobody reads: most are misspelt.

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


def choice(file: Path, place: str, value: Any, known: tuple[str, ...]) -> str:
    """One of some words.

    Raises:
        InputError: it is none.
    """
    if not isinstance(value, str) or value not in known:
        raise InputError(f"{file}: {place} is {value!r}; to fix: write one of {', '.join(known)}")
    return value


def finite(file: Path, place: str, value: Any, positive: bool = False) -> float:
    """A finite number, above zero if `positive`.

    Raises:
        InputError: it is none.
    """
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{file}: {place} is {value!r}; to fix: write a finite number")
    if abs(value) > HIGHEST_VALUE:
        raise InputError(f"{file}: {place} is {value!r}; to fix: write a number that a cell can have")
    if positive and value < LOWEST_VALUE:
        raise InputError(f"{file}: {place} is {value!r}; to fix: write a number above zero")
    return float(value)


def vectors(file: Path, place: str, value: Any, shape: tuple[int, ...], form: str) -> Array:
    """Finite numbers of a shape, such as (3,) for [x, y, z].

    Args:
        form: how to write them, for the message.

    Raises:
        InputError: another shape, or something that is no finite number.
    """
    for number in _flat(file, place, value, shape, form):
        finite(file, place, number)
    return np.array(value, float)


def _flat(file: Path, place: str, value: Any, shape: tuple[int, ...], form: str) -> list[Any]:
    """The entries of nested lists of a shape, row by row."""
    if not shape:
        return [value]
    if not isinstance(value, list) or len(value) != shape[0]:
        raise InputError(f"{file}: {place} is {reprlib.repr(value)}; to fix: write {form}")
    return [entry for part in value for entry in _flat(file, place, part, shape[1:], form)]


def resolve_file(file: Path, place: str, value: Any) -> Path:
    """A file that a job names relative to itself.

    Raises:
        InputError: no name in quotes.
    """
    if not isinstance(value, str):
        raise InputError(f"{file}: {place} is {value!r}; to fix: name a file in quotes")
    return file.parent / value


# CSV tables with named columns, as a person edits them.


@dataclass(frozen=True)
class CsvColumns:
    """The wanted columns of a CSV file, row by row."""

    texts: dict[str, list[str]]
    numbers: dict[str, Array]  # (N,) each
    rows: int

    def stack(self, names: str) -> Array:
        """Number columns (N, k) by their names, separated by blanks."""
        return np.column_stack([self.numbers[name] for name in names.split()])


def read_columns(file: Path, texts: str, numbers: str) -> CsvColumns:
    """Read a CSV with a header line; other columns are left alone.

    Args:
        texts: names of text columns, separated by blanks.
        numbers: names of number columns, separated by blanks.

    Raises:
        InputError: the file, a column or a value is missing or no finite number; names the line.
    """
    header, lines = read_csv_lines(file)
    for name in (*texts.split(), *numbers.split()):
        if name not in header:
            raise InputError(
                f"{file}: column {name!r} is missing; to fix: name {texts} {numbers} in the header".rstrip()
            )
    if not lines:
        raise InputError(f"{file}: no rows below the header; to fix: add one per line")
    rows = [(line, dict(zip(header, cells + [""] * len(header), strict=False))) for line, cells in lines]
    return CsvColumns(
        {name: [_text(file, line, name, row[name]) for line, row in rows] for name in texts.split()},
        {name: np.array([_number(file, line, name, row[name]) for line, row in rows]) for name in numbers.split()},
        len(rows),
    )


def require_unique(file: Path, what: str, names: list[str]) -> None:
    """Refuse a name that stands in two rows.

    Args:
        what: the thing that has the name, such as "hole".

    Raises:
        InputError: names the first that does.
    """
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{file}: {what} {name} stands twice; to fix: leave one of them out, or rename it")


def _text(file: Path, line: int, name: str, cell: str) -> str:
    if not cell.strip():
        raise InputError(f"{file} line {line}: {name} is empty; to fix: write a name")
    return cell.strip()


def _number(file: Path, line: int, name: str, cell: str) -> float:
    value = finite_number(file, line, name, cell)
    if abs(value) > HIGHEST_VALUE:
        raise InputError(f"{file} line {line}: {name} is {cell.strip()!r}; to fix: write a number that a cell can have")
    return value


# What every cell's command reads and can hand out beside its result: a Rerun recording, a page, a session folder.
#
# Recording and page come from whoever offers them under the entry points `stitch.cell_recordings` and
# `stitch.cell_reports`, by the command's name.


def write_pictures(command: str, folder: Path, *results: Any) -> list[str]:
    """Write the pictures of a command's job and result (`results`) into its folder; returns the files' names.

    They come from whoever offers them under the entry point `stitch.cell_pictures`, by the command's name.
    """
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


# Points that lie within this share of their extent of one line leave the turn about it open.
_FLAT = 1e-3


def on_a_line(points: Array) -> bool:
    """Whether points (N, 3) lie on one line, or all in one place."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(len(points) < 2 or spread[1] <= _FLAT * max(spread[0], 1e-12))


# Poses as CSV rows: x, y, z and the angles a, b, c in degrees, turned about z, y', x'' in this order.

POSE_COLUMNS = "x y z a_deg b_deg c_deg"


def poses_from_rows(numbers: Array) -> Array:
    """Poses (..., 4, 4) from rows (..., 6)."""
    numbers = np.asarray(numbers, float)
    R = Rotation.from_euler("ZYX", numbers[..., 3:].reshape(-1, 3), degrees=True).as_matrix()
    return frames.make(R.reshape(*numbers.shape[:-1], 3, 3), numbers[..., :3])


def rows_from_poses(poses: Array) -> Array:
    """Rows (N, 6) from poses (N, 4, 4)."""
    poses = np.asarray(poses, float)
    return np.hstack([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_euler("ZYX", degrees=True)])


def poses_from_columns(table: CsvColumns) -> Array:
    """Poses (N, 4, 4) of a table that holds the six columns."""
    return poses_from_rows(table.stack(POSE_COLUMNS))


def pose_from_table(file: Path, place: str, entries: Any) -> Array:
    """The pose (4, 4) that a table of a job file holds, by the keys of COLUMNS.

    Raises:
        InputError: no table, an unknown key, or something that is no finite number.
    """
    check_keys(file, place, entries, set(POSE_COLUMNS.split()))
    return poses_from_rows(np.array([finite(file, f"{place}.{key}", entries.get(key)) for key in POSE_COLUMNS.split()]))


def write_poses(file: Path, key: str, names: Sequence[str], poses: Array) -> None:
    """A CSV of named poses (N, 4, 4)."""
    rows = np.round(rows_from_poses(poses), 6) + 0.0
    columns = {name: rows[:, i] for i, name in enumerate(POSE_COLUMNS.split())}
    write_columns(file, {key: list(names), **columns})


def write_columns(file: Path, columns: Mapping[str, Sequence[object] | Array]) -> None:
    """A CSV with a header; numbers keep nine digits."""
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(columns)
        for row in zip(*columns.values(), strict=True):
            writer.writerow([f"{value:.9g}" if isinstance(value, float) else value for value in row])


# Columns of points.csv from labelled points, as a session of `stitch run` and `diagnose` wants them.


def points_table(views: Sequence[str], targets: Sequence[str], places: Array, sigma: Array | None) -> TableColumns:
    """Columns view, target, x, y, z and, where it is known, sigma.

    Args:
        views: N names, one for each point.
        targets: N names of what was seen there.
        places: (N, 3) in the sensor's frame.
        sigma: (N,) of each coordinate; None where nobody knows it.
    """
    columns: dict[str, Any] = {"view": list(views), "target": list(targets)}
    columns |= dict(zip("xyz", places.T, strict=True))
    return columns if sigma is None else columns | {"sigma": np.asarray(sigma, float)}
