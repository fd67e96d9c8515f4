"""Poses as files have them: rows of numbers with what names them, before anybody says what the numbers mean."""

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from stitch.errors import InputError
from stitch.frames import Array
from stitch.intake.clock_times import ClockTimes, find_clock_column
from stitch.intake.nested_poses import nested_rows
from stitch.intake.number_table import NumberTable, read_number_table
from stitch.reading.text_file import read_text, require_file, shortened
from stitch.reading.yaml_file import parse_yaml

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
