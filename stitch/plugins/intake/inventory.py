"""Every list of numbers in the files of a folder, what each is taken for, and which of them are the robot's poses.

A list is one of poses only if a layout accepts its numbers. Lists are ranked by how many clouds they serve, then by
their names; two that rank alike are asked for.
"""

import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from stitch.errors import InputError, NoResultError
from stitch.plugins.intake.cloud_pairs import clouds_served
from stitch.plugins.intake.layouts import possible_layouts
from stitch.plugins.intake.raw_poses import RawPoses, read_lists, read_raw_poses
from stitch.plugins.intake.refusals import Fix, Refusal

_NAMES_POSE = re.compile(r"pose|robot|flange|tcp|joint|trajector|actual|gripper|effector|ist\b", re.IGNORECASE)
_NAMES_OTHER = re.compile(r"marker|board|target|tag|camera|soll?\b|rsol|edges|nominal|command", re.IGNORECASE)
_FEWEST_ALIKE = 3  # files named alike, with a pose each
_SHOWN = 6


@dataclass(frozen=True)
class FoundList:
    """One list of rows in a file, or in several files that hold a row each; or a file without one."""

    files: tuple[Path, ...]
    raw: RawPoses | None
    taken_for: str = ""
    why_not: str = ""
    refusal: Refusal | None = None  # in full, of files that hold a pose each but for one of them

    @property
    def name(self) -> str:
        """As --poses takes it: FILE, or FILE#LIST."""
        part = _part(self)
        ends = " … ".join(file.name for file in dict.fromkeys((self.files[0], self.files[-1])))
        count = f" ({len(self.files)} files)" if len(self.files) > 1 else ""
        return f"{ends}#{part}" if part else f"{ends}{count}"

    @property
    def words(self) -> str:
        """What stands there, for a message."""
        if self.raw is None:
            return f"{self.name}: {self.why_not}"
        rows, columns = self.raw.numbers.shape
        names = f" ({', '.join(self.raw.header[:8])})" if self.raw.header else ""
        reason = f", {self.why_not}" if self.why_not else ""
        return f"{self.name}: {rows} row{'s' * (rows > 1)} of {columns} numbers{names}{reason}"

    def as_dict(self) -> dict[str, Any]:
        """As `stitch init --json` prints it."""
        raw = self.raw
        return {
            "file": " … ".join(str(file) for file in dict.fromkeys((self.files[0], self.files[-1]))),
            "list": raw.part if raw is not None else "",
            "rows": len(raw.numbers) if raw is not None else 0,
            "columns": list(raw.header or map(str, range(1, raw.numbers.shape[1] + 1))) if raw is not None else [],
            "taken_for": self.taken_for,
            "why_not": self.why_not,
        }


def take_inventory(files: Sequence[Path], accepts: Callable[[RawPoses], bool]) -> list[FoundList]:
    """Return every list of the files; those without `why_not` can be poses.

    Args:
        accepts: whether what a person has stated makes poses of a list that no layout accepts.
    """
    alike: dict[tuple[Path, str, str], list[Path]] = {}
    for file in files:
        alike.setdefault((file.parent, re.sub(r"\d+", "#", file.stem), file.suffix.lower()), []).append(file)
    out: list[FoundList] = []
    for group in alike.values():
        if len(group) >= _FEWEST_ALIKE:
            found = _list_of_files(group, accepts)
            if not found.why_not or found.refusal is not None:
                out.append(found)
                continue
        refused: list[FoundList] = []
        for file in group:
            try:
                out += [_judged(FoundList((file,), raw), accepts) for raw in read_lists(file)]
            except (InputError, NoResultError) as error:
                refused.append(FoundList((file,), None, why_not=_reason(error, file)))
        # What is wrong with files that are named alike is said once.
        out += [replace(refused[0], files=tuple(group))] if len(refused) == len(group) else refused
    return out


def _list_of_files(group: Sequence[Path], accepts: Callable[[RawPoses], bool]) -> FoundList:
    """Return files that are named alike as one list, or why they are none."""
    try:
        return _judged(FoundList(tuple(group), read_raw_poses(group)), accepts)
    except InputError as error:
        single = 0
        for file in group:
            with suppress(InputError, NoResultError):
                raw = read_raw_poses([file])
                single += len(raw.numbers) == 1 and not _judged(FoundList((file,), raw), accepts).why_not
        whole = error if isinstance(error, Refusal) and 2 * single > len(group) else None
        return FoundList(tuple(group), None, why_not=_reason(error, group[0]), refusal=whole)


def _judged(found: FoundList, accepts: Callable[[RawPoses], bool]) -> FoundList:
    assert found.raw is not None
    if len(found.raw.numbers) > 1 and not np.ptp(found.raw.numbers, axis=0).any():
        return replace(found, why_not="all its rows are alike")
    try:
        if accepts(found.raw) or possible_layouts(found.raw):
            return found
        reason = "no pose is known that has such columns"
    except InputError as error:
        reason = _reason(error, found.files[0])
    return replace(found, why_not=reason)


def _reason(error: Exception, file: Path) -> str:
    """What is wrong, without the file's name and the advice."""
    return str(error).split("; to fix")[0].removeprefix(str(file)).lstrip(": ")


def choose_list(folder: Path, inventory: Sequence[FoundList], clouds: Sequence[Path]) -> tuple[list[FoundList], int]:
    """Return the lists that serve as many clouds, the likely one first, and how many of them rank as it does.

    Raises:
        InputError: no list that can be poses; shows the inventory.
    """
    open_ = [found for found in inventory if found.raw is not None and not found.why_not]
    rows = [found for found in inventory if found.raw is not None]
    if not open_ and len(rows) == 1:
        open_ = rows  # what is wrong with it is said by name when its columns are read
    if len(inventory) == 1 and len(inventory[0].files) == 1 and not open_:
        read_raw_poses(inventory[0].files)  # what is wrong with the one file is said in full
    if not open_ and (refused := next((found.refusal for found in inventory if found.refusal), None)):
        raise refused
    if not open_:
        words = "name the file of the poses with --poses FILE, or a list of it with --poses FILE#LIST, and its columns "
        named = Fix(f"{words}with --columns x,y,z,rx,ry,rz", {"poses": "FILE#LIST", "columns": "COLUMNS"})
        listed = {"inventory": [found.as_dict() for found in inventory]}
        raise Refusal(f"{folder}: no list of poses there{_shown(inventory)}", named, found=listed)
    ranked: dict[bytes, tuple[Any, FoundList]] = {}
    for rank, found in sorted(((_rank(found, clouds), found) for found in open_), key=lambda one: one[0]):
        assert found.raw is not None
        ranked.setdefault(found.raw.numbers.tobytes(), (rank, found))  # copies are no rivals
    ranks = [rank for rank, _ in ranked.values()]
    return [found for rank, found in ranked.values() if rank[0] == ranks[0][0]], ranks.count(ranks[0])


def with_chosen(inventory: Sequence[FoundList], chosen: FoundList) -> tuple[FoundList, ...]:
    """Return the inventory, the chosen list first, with what became of every other one."""
    others = [
        replace(found, why_not=found.why_not or f"{chosen.name} serves the clouds")
        for found in inventory
        if found is not chosen
    ]
    return (replace(chosen, taken_for="poses", why_not=""), *others)


def several_lists(folder: Path, rivals: Sequence[FoundList]) -> Refusal:
    """Return the question which of several lists holds the poses, with their rows shown."""
    names = [f"{found.files[0]}#{part}" if (part := _part(found)) else str(found.files[0]) for found in rivals]
    told = f"{folder}: several lists may hold the poses, and the scans do not tell which{_shown(rivals)}"
    return Refusal(
        told,
        *(
            Fix(f"name it with --poses {name}", {"poses": name}, shows=found.raw.shown if found.raw else ())
            for name, found in zip(names, rivals, strict=True)
        ),
    )


def _part(found: FoundList) -> str:
    return found.raw.part if found.raw is not None else ""


def _rank(found: FoundList, clouds: Sequence[Path]) -> tuple[int, bool, bool, bool]:
    """Less is better: clouds without a row, and what the names of columns, file and list say."""
    assert found.raw is not None
    served = clouds_served(clouds, found.raw.labels, found.raw.numbers)
    named = f"{found.files[0].stem} {found.raw.part}"
    strange = False
    with suppress(InputError):
        # Named columns that only their values make a pose.
        strange = found.raw.header is not None and not possible_layouts(found.raw)[0].named
    return len(clouds) - served, strange, bool(_NAMES_OTHER.search(named)), not _NAMES_POSE.search(named)


def _shown(inventory: Sequence[FoundList]) -> str:
    """The first few lists of an inventory, for a message."""
    shown = "; ".join(found.words for found in inventory[:_SHOWN])
    more = f"; {len(inventory) - _SHOWN} more" if len(inventory) > _SHOWN else ""
    return f" ({shown}{more})" if shown else ""
