"""Which rows of a recording belong to scans: at a trigger, or at the stops of the arm."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices, Mask
from stitch.plugins.intake.clock_times import times_of_both
from stitch.plugins.intake.cloud_pairs import LACKING, named_pairing
from stitch.plugins.intake.layouts import POSE_UNITS, clock_column, pose_units
from stitch.plugins.intake.raw_poses import RawPoses
from stitch.plugins.intake.readings import JOINT_ANGLES, Reading, StatedTable, all_readings
from stitch.plugins.intake.refusals import Fix, Refusal

# The arm stands if it turns (rad) and shifts (m) by less from this long (s) before to this long after.
AROUND = 0.2
_STILL_TURN, _STILL_SHIFT = 1e-3, 5e-4
# Two rows, or scans, are of one stop if the flange has turned and shifted by less between them.
_SAME_TURN, _SAME_SHIFT = 2e-3, 1e-3
# Stops are told from pauses by lasting so much longer.
_LONGER = 3.0
# Of a longer recording every second, third … row is read.
_MOST_ROWS = 4_000
# Offsets of two clocks are tried in such parts of a rest.
_OFFSET_STEPS = 20.0
# Stops that make a session, and rows a scan of what can only be a recording.
_FEWEST, _MANY = 3, 5
_TRUE = {"true", "on", "yes", "high", "trigger", "triggered", "1"}


def rows_with_scans(raw: RawPoses, clouds: Sequence[Path], urdf: Path | None, stated: StatedTable) -> RawPoses:
    """Return the rows of a recording that belong to scans; the table as it is where it is none.

    Raises:
        InputError: more or fewer stops of the arm than scans, and no trigger.
    """
    count, rows = len(clouds), len(raw.numbers)
    if rows >= 2 * count and (times := times_of_both(clouds, raw.labels, raw.numbers)) is not None:
        return _rows_by_clocks(raw, *times[:2], all_readings(raw, urdf, stated))
    if rows <= count + LACKING or named_pairing(clouds, raw.labels, raw.numbers) is not None:
        return raw
    triggered = _triggered_rows(raw, count)
    if triggered is not None:
        return _picked(raw, triggered, f"{count} rows of {rows} at the trigger")
    if rows < 2 * count:
        return raw
    thin = _picked(raw, np.arange(0, rows, -(-rows // _MOST_ROWS)), "")
    stops = _rows_at_stops(all_readings(thin, urdf, stated), count)
    if len(stops) < _FEWEST or abs(len(stops) - count) > LACKING:
        if rows < _MANY * count:
            return raw
        raise Refusal(
            f"{raw.source}: the arm stops {len(stops)} times in its {rows} rows, and there are {count} clouds",
            Fix(
                "state the row of each cloud, in the order of their names, as with --rows 12,450,-,902",
                {"rows": "ROWS"},
            ),
        )
    return _picked(thin, stops, f"{len(stops)} stops of the arm in {rows} rows")


def _rows_by_clocks(raw: RawPoses, scans: Array, poses: Array, found: Sequence[Reading]) -> RawPoses:
    """Return the rows at which the arm stands, by the one offset of clocks that puts all scans into its rests.

    The table as it is where the clocks agree, or no offset does it.

    Args:
        scans, poses: times (N,) and (V,), s.
    """
    T = _metric_poses(found[0])
    still = stationary_scans(
        T[np.maximum(np.arange(len(T)) - 1, 0)], T, T[np.minimum(np.arange(len(T)) + 1, len(T) - 1)]
    )
    rests = [poses[[stop[0], stop[-1]]] for stop in _stops(T, still) if len(stop) > 1]
    if len(rests) < len(scans) or (np.diff(poses) < 0).any():
        return raw
    first, last = np.array(rests).T
    shortest = float(np.median(last - first))
    usual = float(np.median(np.diff(np.sort(scans))))
    offsets = np.arange(-usual, usual, shortest / _OFFSET_STEPS)
    moved = scans[:, None] + offsets
    inside = ((moved[..., None] >= first) & (moved[..., None] <= last)).any(axis=-1).all(axis=0)
    if not inside.any() or inside[np.argmin(np.abs(offsets))]:
        return raw
    # Of offsets side by side the middle one, of the run nearest to none.
    runs = np.split(np.flatnonzero(inside), np.flatnonzero(np.diff(np.flatnonzero(inside)) > 1) + 1)
    middle = [float(offsets[run].mean()) for run in runs]
    offset = min(middle, key=abs)
    rows = np.abs((scans + offset)[:, None] - poses).argmin(axis=1)
    if len(set(rows.tolist())) < len(scans):
        return raw
    side = "ahead of" if offset < 0 else "behind"
    words = f"the clock of the scans is {abs(offset):.2g} s {side} the robot's: only then was each taken at a rest"
    return _picked(raw, np.asarray(rows, np.int64), words)


def _picked(raw: RawPoses, rows: Indices, words: str) -> RawPoses:
    return replace(
        raw,
        numbers=raw.numbers[rows],
        labels=tuple(raw.labels[i] for i in rows),
        words=f"{raw.words}, {words}" if words else raw.words,
        without_pose=frozenset(n for n, row in enumerate(rows.tolist()) if row in raw.without_pose),
    )


def _triggered_rows(raw: RawPoses, count: int) -> Indices | None:
    """Return the middle row of each of so many runs of a signal that is on, or of each number of a scan."""
    signals = [column for column in raw.numbers.T if 2 <= len(set(column.tolist())) <= count + 1]
    texts = zip(*raw.labels, strict=False) if raw.labels and raw.labels[0] else ()
    signals += [np.array([float(cell.strip().lower() in _TRUE) for cell in column]) for column in texts]
    for signal in signals:
        changes = np.flatnonzero(np.diff(signal)) + 1
        runs = np.split(np.arange(len(signal)), changes)
        if len(set(signal.tolist())) == 2:
            runs = [run for run in runs if signal[run[0]] == signal.max()]
        elif (np.diff(signal) < 0).any():
            continue
        elif len(runs) == count + 1:
            # A counter of the scans taken: the arm stands where it goes up.
            runs = [run[:1] for run in runs[1:]]
        if len(runs) == count:
            return np.array([run[len(run) // 2] for run in runs], np.int64)
    return None


def _rows_at_stops(found: Sequence[Reading], count: int) -> Indices:
    """Return the middle rows of the stops, of the longest ones where others are much shorter."""
    best: list[list[int]] = []
    # Where the arm stands, any order of angles shows it; a vector of rotation and quaternions have another sign at π.
    found = sorted(found, key=lambda reading: -reading.rank)
    usual = {(r.layout.words, r.angle_unit, r.rotation == "rotation-vector"): r for r in found}
    for reading in usual.values():
        T = _metric_poses(reading)
        times = clock_column(reading.layout.rest)
        at = np.arange(len(T), dtype=float) if times is None else times
        around = 1.0 if times is None else AROUND
        before = np.searchsorted(at, at - around)
        after = np.searchsorted(at, at + around, "right") - 1
        stops = _stops(T, stationary_scans(T[before], T, T[after]))
        # Readings under which the arm seems to jump break stops apart.
        if not best or abs(len(stops) - count) < abs(len(best) - count):
            best = stops
    best = sorted(best, key=len, reverse=True)
    if len(best) > count and len(best[count - 1]) >= _LONGER * len(best[count]):
        best = best[:count]
    return np.array(sorted(stop[len(stop) // 2] for stop in best), np.int64)


def _metric_poses(reading: Reading) -> Array:
    """Poses (V, 4, 4) in m, by the usual unit where the file says none."""
    unit = reading.layout.length_unit or pose_units(reading.T[:, :3, 3])[0]
    metres = 1e-3 if reading.rotation == JOINT_ANGLES else POSE_UNITS[unit]
    return frames.make(reading.T[:, :3, :3], reading.T[:, :3, 3] * metres)


def stationary_scans(before: Array, at: Array, after: Array) -> Mask:
    """Return (M,) bool of flange poses (M, 4, 4), m; a pose that was not recorded is NaN and says nothing."""
    still = _is_recorded(at)
    for other in (before, after):
        both = np.flatnonzero(_is_recorded(other) & still)
        still[both] = _is_near(at[both], other[both], _STILL_TURN, _STILL_SHIFT)
    return still


def _is_recorded(T: Array) -> Mask:
    return np.asarray(np.isfinite(T).all(axis=(1, 2)), bool)


def middle_of_stops(T: Array, still: Mask) -> Indices:
    """Return numbers of scans, in the order of time: the middle one of each stop.

    Args:
        T: (M, 4, 4) flange poses in the order of time, m.
    """
    return np.array([group[len(group) // 2] for group in _stops(T, still)], np.int64)


def _stops(T: Array, still: Mask) -> list[list[int]]:
    """Group rows that follow each other at one place."""
    rows = np.flatnonzero(still)
    groups: list[list[int]] = []
    for run in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1):
        left = run
        while len(left):
            near = _is_near(T[left[:1]], T[left], _SAME_TURN, _SAME_SHIFT)
            end = len(left) if near.all() else int(np.argmin(near))
            groups.append(left[:end].tolist())
            left = left[end:]
    return groups


def _is_near(a: Array, b: Array, turn: float, shift: float) -> Mask:
    step = frames.log(frames.inverse(a) @ b)
    return np.asarray((np.linalg.norm(step[:, :3], axis=1) < turn) & (np.linalg.norm(step[:, 3:], axis=1) < shift))
