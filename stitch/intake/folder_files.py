"""What a folder holds: clouds, files of poses, a robot's description."""

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from natsort import natsorted, ns

from stitch import frames
from stitch.errors import InputError
from stitch.frames import Array
from stitch.intake.layouts import POSE_UNITS, Reading, possible_layouts
from stitch.intake.raw_poses import (
    PROGRAMS,
    STRUCTURED,
    TABLES,
    is_program,
    read_by_its_program,
    read_raw_poses,
    rows_by_time,
)
from stitch.integrity.hypotheses import Hypothesis
from stitch.measurement.session import Mount
from stitch.reading.clouds import CLOUD_SUFFIXES
from stitch.reading.depth_image import DEPTH_SUFFIXES, is_depth_image
from stitch.reading.range_image import poses_in_scans
from stitch.reading.text_files import readable

# Which files of a folder are scans, and which of them are the scans of its campaign.

# Text files are clouds or tables of poses: a scan has more lines than a campaign has views.
_EITHER = (".txt", ".csv", ".asc")
_CLOUD_LINES = 400


def clouds_among(files: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Files of the kind that most clouds have, and clouds of other kinds."""
    fitting = [f for f in files if f.suffix.lower() in CLOUD_SUFFIXES and _is_cloud(f)]
    if not fitting:
        return [], []
    kinds = Counter(f.suffix.lower() for f in fitting)
    order = list(CLOUD_SUFFIXES)
    best = max(kinds, key=lambda kind: (kinds[kind], -order.index(kind)))
    return [f for f in fitting if f.suffix.lower() == best], [f for f in fitting if f.suffix.lower() != best]


def _is_cloud(file: Path) -> bool:
    if file.suffix.lower() == ".npy":
        return _is_cloud_array(file) or is_depth_image(file)
    if file.suffix.lower() in DEPTH_SUFFIXES:
        return is_depth_image(file)
    if file.suffix.lower() not in _EITHER:
        return True
    with file.open("rb") as stream:
        return sum(1 for _, _ in zip(stream, range(_CLOUD_LINES), strict=False)) == _CLOUD_LINES


def _is_cloud_array(file: Path) -> bool:
    """An image of points, or more rows than a campaign has views; matrices (V, 4, 4) are poses."""
    try:
        shape = np.load(file, mmap_mode="r", allow_pickle=False).shape or (0,)
    except (ValueError, OSError):
        return False
    image = len(shape) == 3 and shape[1:] not in ((4, 4), (3, 4))
    return shape[-1] >= 3 and (image or (len(shape) == 2 and shape[0] >= _CLOUD_LINES))


# Which row of a table belongs to which cloud: by name, by time, by number, by order.

# Clouds or poses that a list may lack: more, and the lists do not belong together.
_LACKING = 2
_SHIFTS = (1, -1, 2, -2)


@dataclass(frozen=True)
class Pairing:
    """Per cloud the row of its pose; None where it has none."""

    rows: tuple[int | None, ...]
    words: str
    by_name: bool  # names tell it; else the order is a guess

    @property
    def used(self) -> tuple[int, ...]:
        """Clouds that have a pose."""
        return tuple(i for i, row in enumerate(self.rows) if row is not None)


def pairings(clouds: Sequence[Path], labels: Sequence[tuple[str, ...]], numbers: Array | None = None) -> list[Pairing]:
    """Ways to pair, the likely one first; one where the names tell it.

    Args:
        clouds: files in their order.
        labels: per row the texts that stand beside it.
        numbers: (V, C) of the table: a column of it may number the clouds.

    Raises:
        InputError: so many more of one than of the other that they do not belong together.
    """
    named = _by_text(clouds, labels) or _by_time(clouds, labels, numbers)
    named = named or _by_number(clouds, labels) or _by_column(clouds, numbers)
    if named is not None:
        return [named]
    N, M = len(clouds), len(labels)
    if abs(N - M) > _LACKING or min(N, M) < 3:
        raise InputError(
            f"{clouds[0].parent}: {N} clouds and {M} poses, and their names do not tell which belong together; to fix: "
            "write the cloud's file name beside each pose, or leave out what does not belong"
        )
    if N == M:
        same: tuple[int | None, ...] = tuple(range(N))
        out = [Pairing(same, "in the order of the names of the clouds", False)]
        out.append(Pairing(same[::-1], "the poses in reverse order", False))
        return out + [_shifted_pairing(N, by) for by in _SHIFTS if N - abs(by) >= 4]
    return _incomplete_pairings(N, M)


def _shifted_pairing(count: int, by: int) -> Pairing:
    rows = tuple(i + by if 0 <= i + by < count else None for i in range(count))
    side = "below" if by > 0 else "above"
    return Pairing(rows, f"each cloud with the pose {abs(by)} row{'s' * (abs(by) > 1)} {side}", False)


def _incomplete_pairings(N: int, M: int) -> list[Pairing]:
    """One list lacks one or two: every way, the end first."""
    out = []
    if N < M:
        for gone in list(combinations(range(M), M - N))[::-1]:
            rows = tuple(row for row in range(M) if row not in gone)
            words = f"in order, pose {' and '.join(str(g + 1) for g in gone)} without a cloud"
            out.append(Pairing(rows, words, False))
        return out
    for gone in list(combinations(range(N), N - M))[::-1]:
        left = iter(range(M))
        told = tuple(None if i in gone else next(left) for i in range(N))
        out.append(Pairing(told, f"in order, cloud {' and '.join(str(g + 1) for g in gone)} without a pose", False))
    return out


def _by_text(clouds: Sequence[Path], labels: Sequence[tuple[str, ...]]) -> Pairing | None:
    """A text beside the pose is the cloud's path, file name, or name without its ending."""
    where: dict[str, set[int]] = {}
    for row, texts in enumerate(labels):
        for text in texts:
            path = Path(text.strip().replace("\\", "/").lower())
            for name in {path.name, path.stem}:
                where.setdefault(name, set()).add(row)
    rows = []
    for cloud in clouds:
        found = where.get(cloud.name.lower()) or where.get(cloud.stem.lower())
        rows.append(next(iter(found)) if found is not None and len(found) == 1 else None)
    known = [row for row in rows if row is not None]
    if len(known) < 2 or len(set(known)) < len(known):
        return None
    return Pairing(tuple(rows), "by the names beside the poses", True)


def _by_time(clouds: Sequence[Path], labels: Sequence[tuple[str, ...]], numbers: Array | None) -> Pairing | None:
    """The times in the clouds' names are those beside the poses, to a fraction of the time from scan to scan."""
    found = rows_by_time(clouds, labels, numbers)
    if found is None:
        return None
    rows, farthest = found
    words = f"by the times in the names of the clouds, {farthest:.2g} s at most from those of their poses"
    left = len(labels) - len(rows)
    words += f"; {left} poses belong to no cloud" if left else ""
    return Pairing(tuple(rows), words, True)


def _by_number(clouds: Sequence[Path], labels: Sequence[tuple[str, ...]]) -> Pairing | None:
    """The last number in the cloud's name is that in the name of the pose: view_07 and robot_pose_7."""
    own = [_last_number(cloud.stem) for cloud in clouds]
    theirs = [_last_number(Path(texts[0]).stem) if texts else None for texts in labels]
    if None in own or None in theirs or len(set(own)) < len(own) or len(set(theirs)) < len(theirs):
        return None
    if not set(own) <= set(theirs):
        return None
    return Pairing(tuple(theirs.index(number) for number in own), "by the numbers in the names", True)


def _by_column(clouds: Sequence[Path], numbers: Array | None) -> Pairing | None:
    """The one column of whole numbers, no two alike, in which the last numbers of the clouds' names stand."""
    own = [_last_number(cloud.stem) for cloud in clouds]
    if numbers is None or None in own or len(set(own)) < len(own):
        return None
    counted = [list(c) for c in numbers.T if len(set(c)) == len(c) and {*own} <= {*c}]
    if len(counted) != 1 or any(x != int(x) for x in counted[0]):
        return None
    return Pairing(tuple(counted[0].index(number) for number in own), "by the numbers in a column", True)


def _last_number(name: str) -> int | None:
    found = re.findall(r"\d+", name)
    return int(found[-1]) if found else None


# What was guessed about a folder: each guess with its reason, how sure it is, and the flag that overrules it.


@dataclass(frozen=True)
class Guess:
    """One thing that the files do not say, or say only in a name."""

    what: str  # "rotation", "mount" …
    value: str
    reason: str
    determined: bool  # the files or the scans tell it; False: it cannot be told from these views
    flag: str  # that overrules it
    runner_up: str | None = None

    @property
    def line(self) -> str:
        """For a comment or a terminal."""
        untold = "" if self.determined else f" cannot be told from these views, {self.flag} overrules it;"
        other = f"; next best: {self.runner_up}" if self.runner_up else ""
        return f"{self.what}: {self.value};{untold} {self.reason}{other}"

    def as_dict(self) -> dict[str, Any]:
        """As `stitch init --json` prints it."""
        return {
            "what": self.what,
            "value": self.value,
            "reason": self.reason,
            "told": self.determined,
            "flag": self.flag,
            "runner_up": self.runner_up,
        }


# A way to take clouds and table together: how rotations read, unit, direction, which row to which cloud.

# The doctor counts in millimetres.
MM = 1e-3


@dataclass(frozen=True)
class Interpretation:
    """One way. `carries`: the poses as read take the mount's frame to the reference; else their inverse does."""

    reading: Reading
    pairing: Pairing
    length_unit: str
    carries: bool

    @property
    def T(self) -> Array:
        """Poses (V, 4, 4) of the clouds, mm; identity where a cloud has none."""
        scale = POSE_UNITS[self.length_unit] / MM
        out = np.tile(np.eye(4), (len(self.pairing.rows), 1, 1))
        for i, row in enumerate(self.pairing.rows):
            if row is not None:
                T = self.reading.T[row]
                out[i] = frames.make(T[:3, :3], T[:3, 3] * scale)
        return out

    def hypothesis(self, number: int) -> Hypothesis:
        """The same for the judges of integrity, which know it again by its number."""
        mount: Mount = "eye_in_hand" if self.carries else "eye_to_hand"
        complete = len(self.pairing.used) == len(self.pairing.rows)
        return Hypothesis(str(number), self.T, mount, "", used=None if complete else self.pairing.used)


def all_interpretations(
    readings: Iterable[Reading], pairs: Sequence[Pairing], units: Sequence[str], directions: Sequence[bool]
) -> list[Interpretation]:
    """Every combination, the usual first.

    Args:
        units: for readings of which the file does not tell it.
        directions: whether the poses carry the mount's frame.
    """
    ranked = sorted(readings, key=lambda r: r.rank)
    return [
        Interpretation(reading, pairing, unit, carries)
        for pairing in pairs
        for reading in ranked
        for unit in ([reading.layout.length_unit] if reading.layout.length_unit else units)
        for carries in directions
    ]


_DEEPEST = 3
_LARGEST_TABLE_MB = 5.0
_PACKED = (".zip", ".7z", ".rar", ".tar", ".gz", ".tgz", ".xz", ".bz2", ".zst")
_WORKBOOKS = (".xlsx", ".xls", ".ods", ".numbers")
# What this program writes itself.
_OWN = {"views.csv", "session.toml", "points.csv", "frames.csv", "targets.csv"}


@dataclass(frozen=True)
class FolderFiles:
    """Files of one folder; clouds in the order of their names, numbers by size."""

    folder: Path
    clouds: tuple[Path, ...]
    poses: tuple[Path, ...]  # one table, or a file for each pose; none: they stand in the headers of the scans
    urdf: Path | None
    unused: tuple[Path, ...]  # clouds of another kind and other files of poses, not used


@readable()
def find_folder_files(folder: Path, poses: Path | None = None) -> FolderFiles:
    """Find clouds and poses in a folder and below it.

    Args:
        poses: file or folder of the poses, where a person names it.

    Raises:
        InputError: no clouds, no poses, or several tables of poses.
    """
    _require_folder(folder)
    if poses is not None and not poses.exists():
        raise InputError(f"{poses}: no such file; to fix: name the file of the poses")
    files = _list_files(folder, 0)
    named = {poses, *(poses.iterdir() if poses is not None and poses.is_dir() else ())}
    clouds, other_clouds = clouds_among([f for f in files if f not in named])
    if not clouds:
        raise InputError(_no_clouds_message(folder, files))
    taken = {*clouds, *other_clouds}
    candidates = [f for f in files if f not in taken and _may_hold_poses(f) and not read_by_its_program(f)]
    _require_no_workbook(folder, [poses] if poses is not None else [] if candidates else files)
    chosen: list[Path] = []
    rest: list[Path] = []
    if poses is not None:
        chosen, rest = _stated_pose_files(poses, taken)
    elif candidates or poses_in_scans(clouds) is None:
        chosen, rest = _choose_pose_files(folder, candidates, len(clouds))
    urdfs = [f for f in files if f.suffix.lower() == ".urdf"]
    return FolderFiles(
        folder=folder,
        clouds=tuple(clouds),
        poses=tuple(chosen),
        urdf=urdfs[0] if len(urdfs) == 1 else None,
        unused=(*other_clouds, *rest),
    )


def _require_folder(folder: Path) -> None:
    if folder.is_dir():
        return
    if not folder.is_file():
        raise InputError(f"{folder}: no such folder; to fix: name the folder of the scans")
    if folder.suffix.lower() in _PACKED:
        raise InputError(f"{folder}: is packed; to fix: unpack it and name the folder")
    raise InputError(f"{folder}: is a file; to fix: name the folder that it lies in, {folder.parent}")


def _no_clouds_message(folder: Path, files: Sequence[Path]) -> str:
    """Why, and what to do: an archive that nobody has unpacked, or files of other kinds."""
    packed = next((f for f in files if f.suffix.lower() in _PACKED), None)
    if packed is not None:
        return f"{folder}: no clouds there, only packed in {packed.relative_to(folder)}; to fix: unpack it there"
    kinds = Counter(f.suffix.lower() or f.name for f in files).most_common(3)
    there = f", only {', '.join(f'{count} {kind}' for kind, count in kinds)}" if kinds else ""
    return f"{folder}: no clouds there{there}; to fix: put the scans there as {', '.join(CLOUD_SUFFIXES)}"


def _list_files(folder: Path, depth: int) -> list[Path]:
    """Files in a folder and below, hidden ones and folders of runs left out."""
    out = []
    for entry in natsorted(folder.iterdir(), alg=ns.IGNORECASE):
        if entry.name.startswith(".") or entry.name in _OWN:
            continue
        if entry.is_file():
            out.append(entry)
        elif entry.is_dir() and depth < _DEEPEST and not (entry / "result.json").exists():
            out += _list_files(entry, depth + 1)
    return out


def _may_hold_poses(file: Path) -> bool:
    kinds = (*STRUCTURED, *TABLES, *PROGRAMS)
    return file.suffix.lower() in kinds and file.stat().st_size < _LARGEST_TABLE_MB * 1e6


def _stated_pose_files(poses: Path, clouds: set[Path]) -> tuple[list[Path], list[Path]]:
    if poses.is_dir():
        inside = [f for f in poses.iterdir() if f.is_file() and f not in clouds and _may_hold_poses(f)]
        if not inside:
            raise InputError(f"{poses}: no files of poses there; to fix: name the file or the folder of the poses")
        return natsorted(inside, alg=ns.IGNORECASE), []
    return [poses], []


def _require_no_workbook(folder: Path, files: Sequence[Path]) -> None:
    book = next((f for f in files if f.suffix.lower() in _WORKBOOKS), None)
    if book is not None:
        raise InputError(f"{book}: workbooks are not read; to fix: save the sheet of the poses as CSV in {folder}")


def _choose_pose_files(folder: Path, candidates: Sequence[Path], clouds: int) -> tuple[list[Path], list[Path]]:
    """The one table, or the files that are named alike and are about as many as the clouds."""
    alike: dict[tuple[Path, str, str], list[Path]] = {}
    for file in candidates:
        alike.setdefault((file.parent, re.sub(r"\d+", "#", file.stem), file.suffix.lower()), []).append(file)
    sets = [files for files in alike.values() if len(files) > 2 and abs(len(files) - clouds) <= 2]
    single = [files for files in alike.values() if len(files) == 1]
    groups = sets or [g for g in single if _names_pose(g[0])]
    groups = groups or (len(single) > 1 and [g for g in single if _holds_poses(g[0])]) or single
    if not groups and alike:
        most = max(alike.values(), key=len)
        raise InputError(
            f"{folder}: {clouds} clouds but {len(most)} files that may hold a pose each, {most[0].name} … "
            f"{most[-1].name}; to fix: leave out what does not belong, or name the file of the poses with --poses FILE"
        )
    if not groups:
        raise InputError(f"{folder}: no file of poses there; to fix: name it with --poses FILE")
    if len(groups) > 1:
        shown = ", ".join(str(g[0].relative_to(folder)) for g in groups[:4])
        raise InputError(f"{folder}: several files may hold the poses ({shown}); to fix: name it with --poses FILE")
    return groups[0], [f for f in candidates if f not in groups[0]]


def _holds_poses(file: Path) -> bool:
    """Several, whatever the file is called; what a camera's file or a remark holds is none."""
    if is_program(file):
        return True
    try:
        raw = read_raw_poses([file])
        return len(raw.numbers) > 1 and bool(possible_layouts(raw))
    except InputError:
        return False


def _names_pose(file: Path) -> bool:
    return bool(re.search(r"pose|robot|flange|tcp|joint|trajector", file.stem.lower()))
