"""Which row of a table belongs to which cloud: by name, by time, by number, by order."""

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, count
from pathlib import Path

import numpy as np

from stitch.numerics.frames import Array, Mask
from stitch.plugins.intake.clock_times import rows_by_time
from stitch.plugins.intake.refusals import Fix, Refusal

# Clouds or poses that a list may lack where nothing but the order pairs them: more, and they do not belong together.
LACKING = 2
_SHIFTS = (1, -1, 2, -2)


@dataclass(frozen=True)
class Pairing:
    """Per cloud the row of its pose; None where it has none."""

    rows: tuple[int | None, ...]
    words: str
    by_name: bool  # names tell it; else the order is a guess

    @property
    def stated(self) -> str:
        """As --rows takes it."""
        told = ["-" if row is None else str(row + 1) for row in self.rows]
        in_order = all(row is not None and row == first for row, first in zip(self.rows, count(self.rows[0] or 0)))
        return f"{told[0]}-{told[-1]}" if in_order else ",".join(told)

    @property
    def used(self) -> tuple[int, ...]:
        """Clouds that have a pose."""
        return tuple(i for i, row in enumerate(self.rows) if row is not None)

    def of(self, clouds: Sequence[int], without_pose: Collection[int]) -> "Pairing":
        """Return the pairing of some of the clouds; those whose row holds no pose have none."""
        rows = tuple(self.rows[i] for i in clouds)
        return replace(self, rows=tuple(None if row in without_pose else row for row in rows))

    def one_session_each(self, kept: Sequence[int], clouds: int, later: Mask) -> list[Fix]:
        """Return the advice to make one session of the first views, and one of the later ones.

        Args:
            kept: numbers of the views among so many clouds.
        """
        of_cloud = dict(zip(kept, zip(self.rows, later, strict=True), strict=True))
        each = [of_cloud.get(i, (None, False)) for i in range(clouds)]
        fixes = []
        for side, told in enumerate(("make one session of the first scans", "another of the others")):
            rows = ",".join(str(row + 1) if row is not None and is_later == side else "-" for row, is_later in each)
            name = ("before", "after")[side]
            fixes.append(Fix(f"{told}, --rows={rows} -o {name}", {"rows": rows, "output": name}))
        return fixes


def pairings(clouds: Sequence[Path], labels: Sequence[tuple[str, ...]], numbers: Array | None = None) -> list[Pairing]:
    """Ways to pair, the likely one first; one where the names tell it.

    Args:
        clouds: files in their order.
        labels: per row the texts that stand beside it.
        numbers: (V, C) of the table: a column of it may number the clouds.

    Raises:
        InputError: so many more of one than of the other that they do not belong together.
    """
    named = named_pairing(clouds, labels, numbers)
    N, M = len(clouds), len(labels)
    if named is not None:
        # Numbers that only count the rows may begin elsewhere, or count a row too many: the scans decide.
        counts = [list(range(first, first + M)) for first in (0, 1)]
        counted = any([_last_number(text) for text in texts] in counts for texts in zip(*labels, strict=False))
        open_ = counted and "numbers" in named.words and 3 <= N < M <= N + LACKING
        rivals = _incomplete_pairings(N, M) if open_ else []
        return [named, *(pair for pair in rivals if pair.rows != named.rows)]
    numbered = _by_row(clouds, M)
    if numbered:
        # A row too many is none of a cloud's number.
        gaps = _incomplete_pairings(N, M) if M - N <= LACKING else []
        return numbered + [pair for pair in gaps if all(pair.rows != other.rows for other in numbered)]
    if abs(N - M) > LACKING or min(N, M) < 3:
        raise Refusal(
            f"{clouds[0].parent}: {N} clouds and {M} poses, and their names do not tell which belong together",
            Fix("state the row of each cloud, in the order of their names, as with --rows 1-7,-,9", {"rows": "ROWS"}),
        )
    if N == M:
        same: tuple[int | None, ...] = tuple(range(N))
        out = [Pairing(same, "in the order of the names of the clouds", False)]
        out.append(Pairing(same[::-1], "the poses in reverse order", False))
        return out + [_shifted_pairing(N, by) for by in _SHIFTS if N - abs(by) >= 4]
    return _incomplete_pairings(N, M)


def stated_pairing(clouds: Sequence[Path], rows: Sequence[int | None], count: int) -> Pairing:
    """Return the pairing that a person states.

    Args:
        rows: from 0, of each cloud.
        count: of the rows of the table.

    Raises:
        InputError: another number than of clouds, or a row that is not there.
    """
    if len(rows) != len(clouds) or max((row for row in rows if row is not None), default=0) >= count:
        told = f"--rows: {len(rows)} for {len(clouds)} clouds and a table of {count} rows"
        raise Refusal(told, Fix("write a row, or -, for each cloud in the order of their names", {"rows": "ROWS"}))
    return Pairing(tuple(rows), "stated with --rows", True)


def named_pairing(
    clouds: Sequence[Path], labels: Sequence[tuple[str, ...]], numbers: Array | None = None
) -> Pairing | None:
    """Return the pairing that names, times or numbers tell; None where they do not."""
    ways = (
        _by_text(clouds, labels, numbers),
        _by_time(clouds, labels, numbers),
        _by_number(clouds, labels, numbers),
    )
    # Names of which some are alike by chance pair fewer.
    return max((way for way in ways if way is not None), key=lambda way: len(way.used), default=None)


def clouds_served(clouds: Sequence[Path], labels: Sequence[tuple[str, ...]], numbers: Array | None = None) -> int:
    """Return how many clouds a list of poses can serve; of a recording all but one, as a table is the surer list."""
    named = named_pairing(clouds, labels, numbers)
    if named is not None:
        return len(named.used)
    if len(labels) > len(clouds) + LACKING:
        return len(clouds) - 1
    return len(labels) if len(labels) >= len(clouds) - LACKING else 0


def _by_row(clouds: Sequence[Path], rows: int) -> list[Pairing]:
    """Return cloud N with row N, counted from 0, from 1, or both, of numbered clouds that are fewer than the rows."""
    own = [n for cloud in clouds if (n := _last_number(cloud.stem)) is not None]
    if not len(clouds) == len(set(own)) < rows or len(own) < 3 or 2 * len(own) < rows:
        return []
    out = []
    for first in (0, 1):
        if min(own) >= first and max(own) < rows + first:
            words = f"cloud N with pose N, counted from {first}; {rows - len(own)} poses without a cloud"
            out.append(Pairing(tuple(n - first for n in own), words, False))
    return out


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


def _by_text(clouds: Sequence[Path], labels: Sequence[tuple[str, ...]], numbers: Array | None) -> Pairing | None:
    """A text beside the pose is the cloud's path, file name, or name without its ending.

    A row that is written twice, with the same numbers, counts once.
    """
    where: dict[str, set[int]] = {}
    for row, texts in enumerate(labels):
        for text in texts:
            path = Path(text.strip().replace("\\", "/").lower())
            for name in {path.name, path.stem}:
                where.setdefault(name, set()).add(row)
    rows = []
    for cloud in clouds:
        called = sorted(where.get(cloud.name.lower()) or where.get(cloud.stem.lower()) or ())
        alike = len(called) == 1 or (
            numbers is not None and len(called) > 1 and not np.ptp(numbers[called], axis=0).any()
        )
        rows.append(called[0] if alike else None)
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


def _by_number(clouds: Sequence[Path], labels: Sequence[tuple[str, ...]], numbers: Array | None) -> Pairing | None:
    """The last number in the cloud's name is that in the name of the pose, view_07 and robot_pose_7, or in one column.

    Of columns of whole numbers, no two alike, no other may hold those of the clouds.
    """
    own = [_last_number(cloud.stem) for cloud in clouds]
    if None in own or len(set(own)) < len(own):
        return None
    texts = [[_last_number(Path(text).stem) for text in column] for column in zip(*labels, strict=False)]
    named = [
        column for column in texts if None not in column and len(set(column)) == len(column) and {*own} <= {*column}
    ]
    if named:
        return Pairing(tuple(named[0].index(number) for number in own), "by the numbers in the names", True)
    counted = [list(c) for c in ([] if numbers is None else numbers.T) if len(set(c)) == len(c) and {*own} <= {*c}]
    if len(counted) != 1 or any(x != int(x) for x in counted[0]):
        return None
    return Pairing(tuple(counted[0].index(number) for number in own), "by the numbers in a column", True)


def _last_number(name: str) -> int | None:
    found = re.findall(r"\d+", name)
    return int(found[-1]) if found else None
