"""Poses as files have them: rows of numbers with what names them, before anybody says what the numbers mean."""

import csv
import json
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from stitch.errors import InputError
from stitch.numerics.frames import Array
from stitch.plugins.intake.clock_times import ClockTimes, find_clock_column
from stitch.plugins.intake.controllers.program import POSE_COLUMNS, csv_text, import_file
from stitch.plugins.intake.nested_poses import nested_lists, xml_document
from stitch.plugins.intake.pose_formats import PoseRow, joint_state_rows, open3d_rows, read_pose_text
from stitch.plugins.intake.pose_tables import (
    NumberTable,
    longest_block,
    parse_number_table,
    repeated_records,
)
from stitch.plugins.intake.refusals import Fix, Refusal, change
from stitch.plugins.intake.scan_headers import poses_in_scans, times_in_scans
from stitch.plugins.intake.table_files import WORKBOOKS, read_any_text, require_array_room, workbook_sheets
from stitch.session.reading.text_files import reason_of, require_file
from stitch.session.reading.yaml_file import parse_yaml

ARRAYS = (".npy", ".npz", ".mat")
STRUCTURED = (".json", ".yaml", ".yml", *ARRAYS)
TABLES = (".txt", ".csv", ".dat", ".tsv", ".tab", ".asc", ".pose", ".poses", ".log", ".va", ".pos")
_ORTHONORMAL = 1e-2
# An axis of rotation has length 1 within this; a larger angle is in degrees.
_UNIT_AXIS, _TURN = 1e-3, 2 * np.pi + 1e-3
_MAX_POSES_MB = 50
# 3DTK: angles about x, y, z that turn along, in a left-handed frame; what its numbers are where z points the other way.
_NAMES_OF_3DTK = ("x [cm]", "y [cm]", "z [cm]", "omega [deg]", "phi [deg]", "kappa [deg]")
_MIRRORED = (1.0, 1.0, -1.0, -1.0, -1.0, 1.0)
_ROWS_SHOWN = 3
# Of files, or of rows, that have to hold a pose: where fewer do, the export is at fault and not a view.
_FEWEST_WHOLE = 0.6
# Lines of a record: a rotation and a position, and what stands before or behind them.
_RECORD_LINES = range(4, 9)
PROGRAMS = (".ls", ".src", ".mod", ".script")
_KUKA_DATA = ".dat"
_LOOKED_AT = 65536


@dataclass(frozen=True)
class RawPoses:
    """V rows of C numbers; each row holds one pose, or the joint angles of one."""

    source: str  # file or files, for messages
    header: tuple[str, ...] | None  # names of the columns
    numbers: Array  # (V, C)
    labels: tuple[tuple[str, ...], ...]  # per row the texts beside it, such as a view's name or its cloud's
    words: str  # how it was read
    without_pose: frozenset[int] = frozenset()  # rows without a number where one belongs; they repeat another row
    part: str = ""  # its name among the lists of its file: a path in a document, an element, a sheet

    @property
    def shown(self) -> tuple[str, ...]:
        """The first rows with their columns numbered, for a person who is asked for their names."""
        names = self.header or ("",) * self.numbers.shape[1]
        columns = [
            [f"{i}{':' * bool(name)}{name}", *(f"{x:.6g}" for x in column)]
            for i, (name, column) in enumerate(zip(names, self.numbers[:_ROWS_SHOWN].T, strict=True), 1)
        ]
        padded = [[cell.rjust(max(map(len, column))) for cell in column] for column in columns]
        return tuple("  ".join(row) for row in zip(*padded, strict=True))

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
            told = f"--columns {','.join(names)}: {twice.pop()} stands twice"
            raise Refusal(told, Fix("name each column once", {"columns": "COLUMNS"}))
        if len(names) != self.numbers.shape[1]:
            raise Refusal(
                f"--columns {','.join(names)}: {len(names)} names, {self.source} has {self.numbers.shape[1]} columns "
                "of numbers",
                Fix("name each, and - for one to leave out", {"columns": "COLUMNS"}),
            )
        return replace(self, header=tuple(names), words=f"{self.words}; columns as named")

    def oriented(self, orientation: Sequence[float]) -> "RawPoses":
        """Return the same with the one rotation that all poses have behind x, y and z.

        Raises:
            InputError: other than three or four numbers, or a table that has more than x, y, z.
        """
        where = [i for i, name in enumerate(self.header or "xyz") if name.lower().split(" ")[0].rstrip("_m[(") in "xyz"]
        if len(orientation) not in (3, 4) or len(where) != 3:
            words = "state three angles, or a quaternion x,y,z,w, for a table of x, y, z alone"
            raise Refusal(
                f"--orientation: {len(orientation)} numbers for {self.source}",
                Fix(words, {"orientation": "ORIENTATION", "rotation": "ROTATION"}),
            )
        names = ("rot0", "rot1", "rot2") if len(orientation) == 3 else ("qx", "qy", "qz", "qw")
        header = (*(self.header or "xyz"), *names)
        constant = np.tile(np.array(orientation, float), (len(self.numbers), 1))
        return replace(self, header=header, numbers=np.hstack([self.numbers, constant]))


def read_raw_poses(files: Sequence[Path]) -> RawPoses:
    """Read the rows of one file, or of several that hold one pose each.

    Raises:
        InputError: no poses in a file, or files of different kinds; names file and line.
    """
    if len(files) == 1:
        return _read_file(files[0])
    rows, broken = _read_each(files)
    width = rows[0].numbers.shape[1]
    other = next((r for r in rows if r.numbers.shape[1] != width or r.header != rows[0].header), None)
    if other is not None:
        told = f"{other.source}: is written otherwise than {rows[0].source}"
        raise Refusal(told, change(other.source, "export all alike"))
    return RawPoses(
        source=f"{files[0].name} … {files[-1].name}",
        header=rows[0].header,
        numbers=np.vstack([r.numbers for r in rows]),
        labels=tuple((file.stem, *row.labels[0]) for file, row in zip(files, rows, strict=True)),
        words=f"{len(files)} files, a pose each",
        without_pose=broken,
    )


def _read_each(files: Sequence[Path]) -> tuple[list[RawPoses], frozenset[int]]:
    """Return the pose of each file, and the numbers of files that hold none: a few of many, which repeat another."""
    rows: dict[int, RawPoses] = {}
    refused: InputError | None = None
    for i, file in enumerate(files):
        try:
            rows[i] = _read_file(file)
        except InputError as error:
            refused = refused or error
            continue
        if len(rows[i].numbers) != 1:
            held = len(rows[i].numbers)
            named = Fix("name the one file of all poses with --poses FILE", {"poses": str(file)})
            told = f"{file}: holds {held} poses, one a file is expected"
            raise Refusal(told, named if held >= len(files) else change(file, "leave one in it"))
    if refused is not None and len(rows) < _FEWEST_WHOLE * len(files):
        raise refused
    broken = {i for i in range(len(files)) if i not in rows or rows[i].without_pose}
    first = next(row for i, row in rows.items() if i not in broken) if len(broken) < len(files) else rows[0]
    return [first if i in broken else rows[i] for i in range(len(files))], frozenset(broken)


def _read_file(file: Path) -> RawPoses:
    """Return the longest list of a file, the first of such; of several sheets of a workbook the only one.

    Raises:
        InputError: no list of numbers.
    """
    lists = read_lists(file)
    if file.suffix.lower() in WORKBOOKS and len(lists) > 1:
        raise Refusal(
            f"{file}: {len(lists)} sheets hold rows of numbers",
            *(Fix(f"name one with --poses {file}#{raw.part}", {"poses": f"{file}#{raw.part}"}) for raw in lists[:4]),
        )
    return max(lists, key=lambda raw: len(raw.numbers))


def read_lists(file: Path) -> list[RawPoses]:
    """Return every list of rows of numbers in a file; `RawPoses.part` names each.

    Raises:
        InputError: none, or a file that cannot be read; names file and line.
    """
    require_file(file, "name a file of poses")
    suffix = file.suffix.lower()
    if is_program(file):
        return [program_poses(file)]
    if suffix in ARRAYS:
        return _with_joined(_from_numpy(file))
    if suffix in WORKBOOKS:
        return _from_workbook(file)
    text = read_any_text(file, "name a file of poses", _MAX_POSES_MB)
    if suffix in (".json", ".yaml", ".yml"):
        documents = [_from_json(file, text)] if suffix == ".json" else parse_yaml(file, text)
        document = documents[0] if len(documents) == 1 else documents
        rows = open3d_rows(document) or joint_state_rows(document)
        kind = suffix[1:].upper()
        lists = {"": (rows, kind)} if rows else {path: (rows, kind) for path, rows in nested_lists(document).items()}
    else:
        lists = read_pose_text(text)
        if not lists and text.lstrip().startswith("<"):
            with suppress(ElementTree.ParseError):
                document = xml_document(ElementTree.fromstring(text))
                lists = {path: (rows, "XML") for path, rows in nested_lists(document).items()}
    if lists or suffix in (".json", ".yaml", ".yml"):
        return _with_joined(_from_lists(file, lists))
    try:
        table = parse_number_table(file, text)
    except InputError:
        block = longest_block(text)
        if block is None:
            if (records := _records_of_lines(file, text)) is not None:
                return [records]
            raise
        table = parse_number_table(file, block[0])
        table = replace(table, words=f"{table.words}; {block[1]}")
    return [_matrix_blocks(table) or _raw_poses(str(file), table.header, table.numbers, table.labels, table.words)]


def _with_joined(lists: list[RawPoses]) -> list[RawPoses]:
    """Return lists of a file, rotations of nine numbers with the positions that stand in another list behind them."""
    turns = [raw for raw in lists if raw.numbers.shape[1] == 9 and is_rotation(raw.numbers)]
    shifts = [raw for raw in lists if raw.numbers.shape[1] == 3]
    joined = [
        replace(R, header=None, numbers=np.hstack([R.numbers, t.numbers]), part=f"{R.part}+{t.part}")
        for R in turns
        for t in shifts
        if len(R.numbers) == len(t.numbers)
    ]
    return [*joined, *lists]


def is_rotation(rows: Array) -> bool:
    """Whether nine numbers each, (V, 9) or (V, 3, 3), are rotations."""
    R = rows.reshape(-1, 3, 3)
    return bool(np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max() < _ORTHONORMAL and (np.linalg.det(R) > 0).all())


def _from_workbook(file: Path) -> list[RawPoses]:
    """Return the sheets that hold rows of numbers."""
    found: list[RawPoses] = []
    for name, text in workbook_sheets(file).items():
        with suppress(InputError):
            table = parse_number_table(file, text, sparse=True)
            sheet = _raw_poses(f"{file}, sheet {name}", table.header, table.numbers, table.labels, f"sheet {name}")
            found.append(replace(sheet, part=name))
    if not found:
        named = Fix("name the table of poses with --poses FILE", {"poses": "FILE"})
        raise Refusal(f"{file}: no sheet holds rows of numbers", named)
    return found


def _raw_poses(
    source: str, header: tuple[str, ...] | None, numbers: Array, labels: Sequence[tuple[str, ...]], words: str
) -> RawPoses:
    """Return rows of numbers; those with one that is not finite repeat the first of the others.

    Raises:
        InputError: hardly a row is whole.
    """
    if header is not None:
        header, numbers = _axis_times_angle(header, numbers)
    broken = np.asarray(~np.isfinite(numbers).all(axis=1), bool)
    if len(numbers) > 1 and (~broken).sum() < _FEWEST_WHOLE * len(numbers):
        raise Refusal(
            f"{source}: {broken.sum()} of {len(numbers)} rows hold a number that is not finite",
            change(source, "export the poses again"),
        )
    whole = np.where(broken[:, None], numbers[np.argmin(broken)], numbers) if broken.any() else numbers
    return RawPoses(source, header, whole, tuple(labels), words, frozenset(np.flatnonzero(broken).tolist()))


def _axis_times_angle(header: tuple[str, ...], numbers: Array) -> tuple[tuple[str, ...], Array]:
    """Return columns with an axis of length 1 and the angle about it, rad or degrees, as one vector of rotation."""
    axis = [i for i, name in enumerate(header) if re.search(r"axis[._]?[0-2xyz]$|^[akun]_?[xyz]$", name, re.IGNORECASE)]
    angle = [i for i, name in enumerate(header) if re.search(r"angle([._\s]*(rad|deg))?\W*$", name, re.IGNORECASE)]
    if len(axis) != 3 or len(angle) != 1:
        return header, numbers
    if np.abs(np.linalg.norm(numbers[:, axis], axis=1) - 1).max() > _UNIT_AXIS:
        return header, numbers
    size = numbers[:, angle]
    size = np.radians(size) if "deg" in header[angle[0]].lower() or np.abs(size).max() > _TURN else size
    kept = [i for i in range(len(header)) if i not in (*axis, *angle)]
    names = (*(header[i] for i in kept), *(f"rv{k} [rad]" for k in "xyz"))
    return names, np.hstack([numbers[:, kept], size * numbers[:, axis]])


def _matrix_blocks(table: NumberTable) -> RawPoses | None:
    """4×4 or 3×4 matrices over several lines each, or one position above its angles; None if it is none of that."""
    x = table.numbers
    if x.shape == (2, 3) and table.header is None:
        of_3dtk = table.file.with_suffix(".3d").exists()
        words = (
            "a pose of 3DTK, z the other way round as of its scans" if of_3dtk else "position and angles, a line each"
        )
        header, sense = (_NAMES_OF_3DTK, _MIRRORED) if of_3dtk else (None, 1.0)
        return _raw_poses(str(table.file), header, x.reshape(1, 6) * sense, ((),), words)
    for height in (4, 3) if x.shape[1] == 4 else ():
        blocks = x.reshape(-1, height, 4) if len(x) % height == 0 else x[:0, None]
        whole = blocks[np.isfinite(blocks).all(axis=(1, 2))]
        if len(whole) and is_rotation(whole[:, :3, :3]):
            flat = blocks.reshape(len(blocks), -1)
            return _raw_poses(str(table.file), None, flat, ((),) * len(flat), f"{height}×4 matrices")
    return None


def _records_of_lines(file: Path, text: str) -> RawPoses | None:
    """Return records of three numbers a line, each a row: rotation by rows, position, and others."""
    lines = repeated_records(text)
    x = np.array(lines, float) if lines and len(lines[0]) == 3 else np.empty((0, 3))
    for height in _RECORD_LINES:
        flat = x.reshape(-1, 3 * height) if len(x) % height == 0 and len(x) >= 3 * height else np.empty((0, 0))
        for first in range(0, flat.shape[1] - 8, 3):
            turns = flat[:, first : first + 9]
            if is_rotation(turns) and np.ptp(turns, axis=0).any():
                return _raw_poses(str(file), None, flat, ((),) * len(flat), f"records of {height} lines")
    return None


def _from_json(file: Path, text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise Refusal(f"{file}: not valid JSON ({reason_of(error)})", change(file, "correct it there")) from None


def _from_numpy(file: Path) -> list[RawPoses]:
    try:
        arrays = _named_arrays(file)
    except InputError as error:
        raise Refusal(str(error).split("; to fix")[0], change(file, "save the poses alone")) from None
    except Exception as error:  # whatever a library raises at bytes that are no arrays
        raise Refusal(f"{file}: cannot be read ({reason_of(error)})", change(file, "save plain numbers")) from None
    fitting = [(name, a) for name, a in arrays.items() if a.dtype.kind in "fiu" and a.ndim in (2, 3) and a.size]
    fitting.sort(key=lambda item: -item[1].ndim)
    if not fitting:
        told = f"{file}: holds no array (V, C) or (V, 4, 4)"
        raise Refusal(told, change(file, "save the poses as one of these"))
    out: list[RawPoses] = []
    for name, array in fitting:
        x = np.asarray(array, float)
        flat = x.reshape(1, 16) if x.shape == (4, 4) else x.reshape(len(x), -1)
        raw = _raw_poses(str(file), None, flat, ((),) * len(flat), f"an array {'×'.join(map(str, x.shape))}")
        out.append(replace(raw, part=name))
    return out


def _named_arrays(file: Path) -> dict[str, Array]:
    """Return the arrays of a .npy, .npz or .mat by name; MATLAB counts matrices by the last axis."""
    require_array_room(file)
    if file.suffix.lower() != ".mat":
        loaded = np.load(file, allow_pickle=False)
        return {file.stem: loaded} if isinstance(loaded, np.ndarray) else {k: loaded[k] for k in loaded.files}
    from scipy.io import loadmat

    waiting = list(loadmat(file, simplify_cells=True).items())
    arrays: dict[str, Array] = {}
    while waiting:
        name, value = waiting.pop(0)
        if isinstance(value, dict):
            waiting += [(f"{name}.{key}", inner) for key, inner in value.items()]
        elif isinstance(value, (list, np.ndarray)) and len(value) and all(isinstance(one, dict) for one in value):
            waiting += [(f"{name}.{key}", [one[key] for one in value if key in one]) for key in value[0]]
        elif isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype == object):
            if len({np.shape(one) for one in value}) == 1:
                arrays[name] = np.array(list(value))
        elif isinstance(value, np.ndarray):
            by_last = value.ndim == 3 and value.shape[:2] in ((4, 4), (3, 4)) and value.shape[1:] != (4, 4)
            arrays[name] = value.transpose(2, 0, 1) if by_last else value
    return arrays


def _from_lists(file: Path, lists: dict[str, tuple[list[PoseRow], str]]) -> list[RawPoses]:
    """Return the lists all of whose rows have the same names."""
    refused = Refusal(f"{file}: holds no poses that are known", change(file, "write a table or 4×4 matrices"))
    out: list[RawPoses] = []
    for part, (rows, kind) in lists.items():
        names = tuple(rows[0][1])
        odd = next((i for i, (_, row) in enumerate(rows, 1) if tuple(row) != names), None)
        if odd is not None:
            told = f"{file}: pose {odd} is written otherwise than the first"
            refused = Refusal(told, change(file, "write all alike"))
            continue
        numbers = np.array([list(row.values()) for _, row in rows], float)
        header = None if all(re.fullmatch(r"\d+", name) for name in names) else names
        width = min(len(labels) for labels, _ in rows)
        raw = _raw_poses(str(file), header, numbers, [labels[:width] for labels, _ in rows], kind)
        out.append(replace(raw, part=part))
    if not out:
        raise refused
    return out


def header_poses(clouds: Sequence[Path]) -> RawPoses:
    """The pose in the header of each scan, named as its file is, with the time where the header has one."""
    poses = poses_in_scans(list(clouds))
    assert poses is not None
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
