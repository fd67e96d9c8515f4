"""From a folder of measured points, without scans, to a session of labelled points or of a measured probe.

Tables of a robot's poses or joints and of what a tracker, a camera or a motion capture system measured are found,
paired and read in every way that they can be meant; the way under which one hand-eye fits best is taken.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from scipy.spatial.transform import Rotation

from stitch.errors import InputError, NoResultError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.observations.targets.closed_form_hand_eye import closed_form_hand_eye
from stitch.output.session_files import TableColumns, pose_columns, table_text
from stitch.plugins.intake.cloud_pairs import LACKING, Pairing, pairings
from stitch.plugins.intake.controllers.program import numbered_names
from stitch.plugins.intake.first_session import bare_session
from stitch.plugins.intake.folder_files import clouds_among, list_files
from stitch.plugins.intake.guesses import Guess
from stitch.plugins.intake.layouts import POSE_UNITS, covariate_columns, pose_units, possible_layouts
from stitch.plugins.intake.measured_tables import (
    CAMERAS,
    COUNTED,
    MEASURED,
    TURNS,
    Geometry,
    RobotPoses,
    Table,
    columns_of,
    find_geometry,
    find_robot_poses,
    read_tables,
)
from stitch.plugins.intake.raw_poses import PROGRAMS, STRUCTURED, TABLES
from stitch.plugins.intake.readings import JOINT_ANGLES, Reading, readings
from stitch.plugins.intake.session_draft import (
    comment_lines,
    joint_columns,
    require_free,
    robot_lines,
    session_name,
    write_texts,
)
from stitch.plugins.intake.stated_folder import StatedFolder
from stitch.plugins.intake.table_files import WORKBOOKS
from stitch.session.capture import Capture, build_capture, sightings_of
from stitch.session.reading.session_toml import SESSION_FORMAT
from stitch.session.session import Mount, Sighting, View

# Time about that of a pose within which a target's rows count, s.
_AROUND_S = 0.25
# Views by which all ways are judged, and then so many of the best.
_FEW_VIEWS, _MORE_VIEWS, _BEST = 12, 60, 8
_LEAST_MM = 1e-4  # what tables round
_TOLD, _FITS = 1.3, 0.02  # next best is so much worse; what fits leaves less than this share of the points' spread
_LEVER_MM = 100.0  # at which a turn of a probe counts
# A recording of motion capture is as long as a scan; scans are more, and have neither names nor times.
_LONG_TABLES = 2


@dataclass(frozen=True)
class Observed:
    """What the sensor showed, view by view; lengths as the file has them."""

    views: tuple[str, ...]  # what each is called; empty texts where nothing names them
    targets: tuple[dict[str, tuple[Array, float]], ...]  # place (3,) and sigma of each target
    turns: tuple[Reading, ...] = ()  # ways to read the turns of a 6D probe, (V, 4, 4) each
    rows: tuple[int, ...] = ()  # of the table, where a row is a view
    words: str = ""


@dataclass(frozen=True)
class Measured:
    """One thing that a table gives the places of."""

    table: Table
    group: str

    @property
    def columns(self) -> dict[str, int]:
        return self.table.groups[self.group]

    @property
    def points(self) -> Array:
        return self.table.raw.numbers[:, [self.columns[a] for a in "xyz"]]

    @property
    def sigma(self) -> Array:
        """(n,) of a coordinate; NaN where nobody states it."""
        told = [(role, i) for role, i in self.columns.items() if role.startswith("sigma")]
        if not told:
            return np.full(len(self.points), np.nan)
        each = [self.table.raw.numbers[:, i] / (2.0 if role.endswith("2") else 1.0) for role, i in told]
        return np.asarray(np.sqrt(np.mean(np.square(each), axis=0)))

    @property
    def is_probe(self) -> bool:
        return any(TURNS.fullmatch(role) for role in self.columns)


def find_measured(tables: Sequence[Table], poses: RobotPoses, geometry: Geometry | None) -> list[Measured]:
    """Return everything that has a place and is not the robot's."""
    out = []
    for table in tables:
        if geometry is not None and table.file == geometry.file:
            continue
        for group in table.groups:
            if table is not poses.table or group != poses.group:
                out.append(Measured(table, group))
    told = [m for m in out if MEASURED.search(f"{m.table.title} {m.group}")]
    return told or out


def observed(found: Sequence[Measured], poses: RobotPoses) -> Observed:
    """Return what was measured view by view.

    Raises:
        InputError: rows that do not tell which view and which target they belong to.
    """
    first, columns = found[0], found[0].columns
    names = tuple(texts[0] if texts else "" for texts in first.table.raw.labels)
    rows = tuple(range(len(first.points)))
    if len(found) == 1 and first.is_probe:
        kept = [i for role, i in columns.items() if not role.startswith("sigma")]
        raw = columns_of(first.table.raw, kept, first.group)
        ways = tuple(way for layout in possible_layouts(raw) for way in readings(layout))
        probe = tuple({"probe": seen} for seen in zip(first.points, first.sigma.tolist(), strict=True))
        return Observed(names, probe, ways, rows, "one probe with its turn, a row a view")
    recorded = poses.table.times is not None and first.table.times is not None and not any(first.table.raw.labels)
    if len(found) == 1 and first.table is not poses.table and not recorded:
        return _long_table(first, len(poses.raw.numbers))
    if len({len(m.points) for m in found}) > 1:
        titles = ", ".join(dict.fromkeys(m.table.title for m in found))
        raise InputError(f"{titles}: have different numbers of rows; to fix: take out what does not belong")
    targets = _target_names(found)
    each = [zip(m.points, m.sigma.tolist(), strict=True) for m in found]
    seen = tuple(
        {name: shown for name, shown in zip(targets, row, strict=True) if np.isfinite(shown[0]).all()}
        for row in zip(*each, strict=True)
    )
    return Observed(names, seen, (), rows, f"targets {_listed(targets)}, a row a view")


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:4]) + (f" … {names[-1]}" if len(names) > 4 else "")


def _target_names(found: Sequence[Measured]) -> list[str]:
    several = len({m.table.title for m in found}) > 1
    names = [" ".join(filter(None, (m.table.file.stem if several else "", m.group))) for m in found]
    common = set.intersection(*({*name.split()} for name in names)) if len(names) > 1 else set()
    own = ["-".join(word for word in name.split() if word not in common) for name in names]
    return numbered_names(name or f"t{k + 1}" for k, name in enumerate(own))


def _keys(m: Measured) -> list[list[str]]:
    """Return what may name view and target of the rows of a long table: texts, words in them, columns that count."""
    raw, out = m.table.raw, list[list[str]]()
    for texts in zip(*raw.labels, strict=False):
        out.append(list(texts))
        parts = [re.findall(r"[a-z]+\d*|\d+", text.lower()) for text in texts]
        if len({len(p) for p in parts}) == 1 and len(parts[0]) > 1:
            out += [list(column) for column in zip(*parts, strict=True)]
    for i in range(raw.numbers.shape[1]):
        values = raw.numbers[:, i]
        named = raw.header is None or bool(COUNTED.search(raw.header[i]))
        if named and i not in m.columns.values() and np.array_equal(values, np.round(values)):
            out.append([f"{value:.0f}" for value in values])
    return out


def _long_table(m: Measured, count: int) -> Observed:
    """A row a sighting: of the keys one names the view, another the target."""
    rows, keys = len(m.points), _keys(m)
    best: tuple[tuple[int, int], list[str], list[str]] | None = None
    for view in keys:
        number = len(set(view))
        if not count - LACKING <= number <= count + LACKING and not (3 <= number < count):
            continue
        for target in (*keys, ["target"] * rows):
            if target is not view and len(set(zip(view, target, strict=True))) == rows:
                rank = (abs(number - count), len(set(target)))
                best = min(filter(None, (best, (rank, view, target))), key=lambda b: b[0])
    if best is None and rows % count == 0:
        each = rows // count
        view = [str(i // each) for i in range(rows)]
        shown = [k for k in keys if len(set(k)) == each and len(set(zip(view, k, strict=True))) == rows]
        best = ((0, each), view, shown[0] if shown else [f"t{i % each + 1}" for i in range(rows)])
        words = f"{each} rows a view, in order"
    elif best is None:
        raise InputError(
            f"{m.table.title}: {rows} points for {count} poses, and nothing tells which belong together; to fix: write "
            "the view's name beside each point"
        )
    else:
        words = f"targets {_listed(sorted(set(best[2])))} of views {best[1][0]} … {best[1][-1]}"
    _, view, target = best
    by_view: dict[str, dict[str, tuple[Array, float]]] = {}
    for v, t, p, s in zip(view, target, m.points, m.sigma, strict=True):
        by_view.setdefault(v, {})[t] = (p, float(s))
    named = words.startswith("targets")
    return Observed(tuple(by_view) if named else ("",) * len(by_view), tuple(by_view.values()), words=words)


def at_times(seen: Observed, times: Array, poses: Array) -> tuple[Observed, float]:
    """Return what was measured about the times of the poses, the median of each target, and how near it is, s.

    Raises:
        InputError: the clocks have nothing in common.
    """
    around = min(_AROUND_S, float(np.diff(np.sort(poses)).min(initial=4 * _AROUND_S)) / 4)
    away = np.abs(times - poses[:, None])
    rows = away.argmin(axis=1)
    farthest = float(away.min(axis=1).max())
    if farthest > around:
        raise InputError(
            f"a pose lies {farthest:.3g} s from the nearest measurement: the clocks differ; to fix: write both in one "
            "clock, or the pose's name beside each point"
        )
    out = list[dict[str, tuple[Array, float]]]()
    for near in away <= around:
        about = [seen.targets[i] for i in np.flatnonzero(near)]
        shown = {name: [t[name] for t in about if name in t] for name in dict.fromkeys(n for t in about for n in t)}
        out.append({name: (np.median([p for p, _ in own], axis=0), own[0][1]) for name, own in shown.items()})
    turns = tuple(replace(way, T=way.T[rows]) for way in seen.turns)
    return Observed(("",) * len(out), tuple(out), turns, tuple(rows.tolist()), seen.words), farthest


def pair(seen: Observed, found: Sequence[Measured], poses: RobotPoses) -> tuple[Observed, list[Pairing]]:
    """Return what was measured, and each way to pair it with the poses: per view the row of its pose.

    Raises:
        InputError: they do not belong together.
    """
    table, count = found[0].table, len(poses.raw.numbers)
    if table is poses.table and len(seen.targets) == count:
        return seen, [Pairing(tuple(range(count)), "each row is one view", True)]
    robot_times = poses.table.times
    if seen.rows and table.times is not None and robot_times is not None and len(seen.targets) > count + LACKING:
        picked, farthest = at_times(seen, table.times, robot_times)
        words = f"by time, the nearest measurement {farthest:.2g} s away at most"
        return picked, [Pairing(tuple(range(count)), words, True)]
    called = [Path(re.sub(r"[./\\]", "_", name) or "view") for name in seen.views]
    try:
        return seen, pairings(called, poses.raw.labels, poses.raw.numbers)
    except InputError:
        raise InputError(
            f"{table.title}: {len(called)} views, but {count} poses in {poses.table.title}, and no names tell which "
            "belong together; to fix: write the view's name beside both"
        ) from None


@dataclass(frozen=True)
class Way:
    """One way to read what was found, lengths in mm."""

    reading: Reading
    robot: dict[str, Any] | None
    pairing: Pairing
    mount: Mount
    unit: str  # of the poses
    point_unit: str
    turn: int | None  # of `Observed.turns`
    misfit: float  # mm

    @property
    def T(self) -> Array:
        """(n, 4, 4) of all rows, mm."""
        T = self.reading.T
        return frames.make(T[:, :3, :3], T[:, :3, 3] * (1e3 * POSE_UNITS[self.unit]))


def _sighting(seen: Observed, way: Way, view: int) -> Sighting:
    """What one view shows, mm."""
    scale = 1e3 * POSE_UNITS[way.point_unit]
    names = tuple(seen.targets[view])
    points, sigma = zip(*(seen.targets[view][name] for name in names), strict=True)
    turn = None if way.turn is None else seen.turns[way.turn].T[view, :3, :3]
    return Sighting(names, np.array(points) * scale, np.array(sigma) * scale, turn)


def _capture(seen: Observed, way: Way, views: Sequence[int]) -> Capture:
    """Some of the views as a way reads them, mm."""
    T = way.T[[way.pairing.rows[v] or 0 for v in views]]
    each = [
        View("", None, pose, None, None, time_s=None, covariates={}, sighting=_sighting(seen, way, v))
        for v, pose in zip(views, T, strict=True)
    ]
    return build_capture("", (), T, way.mount, sightings_of(bare_session(each, way.mount)))


def _misfit(seen: Observed, way: Way, at_most: int) -> float:
    """The median distance of the targets from where they lie on the median, mm; inf where the views do not show it."""
    paired = [v for v in way.pairing.used if seen.targets[v]]
    capture = _capture(seen, way, paired[:: -(-len(paired) // at_most)])
    s = capture.sightings
    assert s is not None
    try:
        T_reference_sensor = capture.T_reference_mount @ closed_form_hand_eye(capture)
    except (NoResultError, np.linalg.LinAlgError, ValueError):
        return float("inf")
    v, slot = np.nonzero(s.used)
    places, target = frames.transform(T_reference_sensor[v], s.points[v, slot][:, None])[:, 0], s.target[v, slot]
    off = [places[target == k] - np.median(places[target == k], axis=0) for k in range(len(s.targets))]
    left = float(np.median(np.linalg.norm(np.concatenate(off), axis=1)))
    if s.rotation is None:
        return left
    R = T_reference_sensor[v, :3, :3] @ s.rotation[v]
    turned = Rotation.from_matrix(frames.nearest_rotation(R.mean(axis=0)).T @ R).magnitude()
    return left + _LEVER_MM * float(np.median(turned))


def candidate_interpretations(
    seen: Observed, found: Sequence[Measured], poses: RobotPoses, pairs: Sequence[Pairing], stated: StatedFolder
) -> list[Way]:
    """Every way that is not ruled out by what files or people say, the best first."""
    told = found[0].table.unit_of(found[0].columns)
    mounts: Sequence[Mount] = [m for m in ("eye_to_hand", "eye_in_hand") if stated.mount in (None, m)]
    turns: Sequence[int | None] = range(len(seen.turns)) if seen.turns else (None,)
    out = []
    for (reading, robot), pairing, mount in product(poses.ways, pairs, mounts):
        if stated.inverse:
            reading = replace(reading, T=frames.inverse(reading.T))
        known = stated.length_unit or reading.layout.length_unit or poses.table.unit
        units = [known] if known else pose_units(reading.T[:, :3, 3])
        for unit, point_unit, turn in product(units, [told] if told else ["mm", "m"], turns):
            way = Way(reading, robot, pairing, mount, unit=unit, point_unit=point_unit, turn=turn, misfit=0.0)
            out.append(replace(way, misfit=_misfit(seen, way, _FEW_VIEWS)))
    out.sort(key=lambda way: way.misfit)
    judged = [replace(way, misfit=_misfit(seen, way, _MORE_VIEWS)) for way in out[:_BEST]]
    return sorted([*judged, *out[_BEST:]], key=lambda way: way.misfit)


@dataclass(frozen=True)
class MeasuredSession:
    """What lies in a folder without scans, and how it is taken."""

    folder: Path
    found: tuple[Measured, ...]
    poses: RobotPoses
    seen: Observed
    way: Way
    guesses: tuple[Guess, ...]


def measured_session(folder: Path, stated: StatedFolder) -> MeasuredSession | None:
    """Find the robot's poses and what was measured of it in a folder without scans; None where nothing was.

    Raises:
        InputError: what was found does not belong together, or lacks what it needs; says how to fix it.
    """
    if not folder.is_dir() or stated.columns:
        return None
    files = list_files(folder)
    clouds, _ = clouds_among(files)
    if len(clouds) > _LONG_TABLES or any(file.suffix.lower() not in TABLES for file in clouds):
        return None
    kinds = (*STRUCTURED, *TABLES, *PROGRAMS, *WORKBOOKS)
    tables = [table for file in files if file.suffix.lower() in kinds for table in _tables_of(file)]
    scans = [t for t in tables if t.file in clouds and t.times is None and len(t.groups) < 2 and not any(t.raw.labels)]
    if scans or not any(table.groups for table in tables):
        return None
    geometry = find_geometry(files, tables)
    poses = find_robot_poses(tables, geometry, stated)
    found = find_measured(tables, poses, geometry) if poses is not None else []
    if poses is None or not found:
        return None
    seen, pairs = pair(observed(found, poses), found, poses)
    ways = candidate_interpretations(seen, found, poses, pairs, stated)
    if not ways or not np.isfinite(ways[0].misfit):
        raise InputError(
            f"{folder}: no one hand-eye fits what was measured to the robot's poses; to fix: turn the flange about two "
            "axes at least, and check that both tables are of the same poses"
        )
    guesses = _guesses(found, poses, seen, ways, stated)
    return MeasuredSession(folder, tuple(found), poses, seen, ways[0], guesses)


def _tables_of(file: Path) -> list[Table]:
    try:
        return read_tables(file)
    except InputError:
        if file.suffix.lower() in WORKBOOKS:
            raise
        return []  # a text of other things


def _guesses(
    found: Sequence[Measured], poses: RobotPoses, seen: Observed, ways: Sequence[Way], stated: StatedFolder
) -> tuple[Guess, ...]:
    best = ways[0]
    places = np.array([place for targets in seen.targets for place, _ in targets.values()])
    extent = 1e3 * POSE_UNITS[best.point_unit] * float(np.linalg.norm(np.ptp(places, axis=0)))

    def guess(what: str, value: str, of: Callable[[Way], Any], flag: str, told: str | None = None) -> Guess:
        """A choice that the fit decides where nobody has told it."""
        other = next((way for way in ways[1:] if of(way) != of(best)), None)
        if told is not None or other is None:
            return Guess(what, value, told or "told by the files", True, flag)
        sure = best.misfit < _FITS * extent and other.misfit > _TOLD * best.misfit + _LEAST_MM
        reason = f"one hand-eye leaves {best.misfit:.3g} mm (median), otherwise {other.misfit:.3g} mm"
        return Guess(what, value, reason, sure, flag)

    measured = ", ".join(dict.fromkeys(m.table.title for m in found))
    by_joints = best.robot is not None or best.reading.rotation == JOINT_ANGLES
    arm = f", the arm of {_arm_file(poses).name}" if by_joints else ""
    files = f"points of {measured}, poses of {poses.table.title}{arm}"
    named = seen.words if best.pairing.by_name else None
    rotation = "stated with --rotation" if stated.rotation else None
    unit = "stated with --unit" if stated.length_unit else None
    unit = unit or ("told by the file" if best.reading.layout.length_unit or poses.table.unit else None)
    sigmas = any(np.isfinite(sigma) for targets in seen.targets for _, sigma in targets.values())
    sigma_words = "as stated beside the points" if sigmas else "not stated"
    return (
        Guess("files", files, "no scans lie there", True, "--poses"),
        guess("pairing", best.pairing.words, lambda w: w.pairing.rows, "the view's name in both tables", named),
        guess(
            "rotation", best.reading.words, lambda w: (w.reading.words, w.turn, str(w.robot)), "--rotation", rotation
        ),
        guess("length_unit", best.unit, lambda w: w.unit, "--unit", unit),
        guess("point_unit", best.point_unit, lambda w: w.point_unit, "its unit in the header, as X [mm]"),
        guess("mount", best.mount, lambda w: w.mount, "--mount", "stated with --mount" if stated.mount else None),
        Guess("sigma", sigma_words, "columns of the table tell it", True, "noise under [scanner]"),
    )


def write_measured(folder: Path, made: MeasuredSession, *, force: bool = False) -> None:
    """Write session.toml, views.csv, and points.csv or frames.csv, into a folder, made where there is none.

    Raises:
        InputError: there is a session already.
    """
    shown = "points.csv" if made.way.turn is None else "frames.csv"
    if not force:
        require_free(folder, ("session.toml", "views.csv", shown))
    row_of = made.way.pairing.rows
    order = sorted((v for v in made.way.pairing.used if made.seen.targets[v]), key=lambda v: row_of[v] or 0)
    views = _views_columns(made, order, [row_of[v] or 0 for v in order])
    seen = table_text(_file_columns(made, order, list(map(str, views["view"]))))
    write_texts(folder, {"views.csv": table_text(views), shown: seen, "session.toml": _toml(folder, made)})


def _views_columns(
    made: MeasuredSession, order: Sequence[int], rows: Sequence[int]
) -> dict[str, Sequence[object] | Array]:
    """views.csv, mm: names, joints or poses, times, and what stands beside them."""
    reading, raw = made.way.reading, made.poses.raw
    named = [made.seen.views[v] or next(iter(raw.labels[row]), "") for v, row in zip(order, rows, strict=True)]
    plain = [re.sub(r"[^\w.+-]+", "-", name).strip("-") or f"p{i + 1:03d}" for i, name in enumerate(named)]
    out: dict[str, Sequence[object] | Array] = {"view": numbered_names(plain)}
    out |= joint_columns(reading, rows)
    if reading.rotation != JOINT_ANGLES:
        out |= pose_columns(made.way.T[rows])
    out |= covariate_columns(reading.layout, rows, raw.time_s)
    times = made.found[0].table.times
    if "time_s" not in out and times is not None and made.seen.rows:
        at = times[[made.seen.rows[v] for v in order]]
        if (np.diff(at) >= 0).all():
            out["time_s"] = [f"{t:.9g}" for t in at - at[0]]
    return out


def _file_columns(made: MeasuredSession, order: Sequence[int], names: Sequence[str]) -> TableColumns:
    """points.csv or frames.csv, mm; sigma where one is stated."""
    seen = [_sighting(made.seen, made.way, v) for v in order]
    places, sigma = np.concatenate([s.points for s in seen]), np.concatenate([s.sigma for s in seen])
    views = [name for name, s in zip(names, seen, strict=True) for _ in s.targets]
    stated = {} if np.isnan(sigma).all() else {"sigma": ["" if np.isnan(x) else f"{x:.6g}" for x in sigma]}
    shown: TableColumns
    if made.way.turn is None:
        shown = {"target": [target for s in seen for target in s.targets], **dict(zip("xyz", places.T, strict=True))}
    else:
        shown = pose_columns(frames.make(np.array([s.rotation for s in seen]), places))
    return {"view": views, **shown, **stated}


def _toml(folder: Path, made: MeasuredSession) -> str:
    """session.toml with every guess as a comment, mm."""
    lines = [f'format = "{SESSION_FORMAT}"', f'name = "{session_name(made.folder)}"', ""]
    lines += [line for guess in made.guesses for line in comment_lines(guess)]
    lines += ['length_unit = "mm"', f'mount = "{made.way.mount}"', ""]
    kind = "camera" if any(CAMERAS.search(f"{m.table.title} {m.group}") for m in made.found) else "tracker"
    if made.way.mount == "eye_to_hand":
        told = "# By the names of files and columns; area, line, probe, camera and tracker are known."
        lines += ["[scanner]", told, f'kind = "{kind}"', ""]
    if made.way.robot is not None:
        lines.append(tomli_w.dumps({"robot": made.way.robot}))
    elif made.way.reading.rotation == JOINT_ANGLES:
        lines += robot_lines(folder, _arm_file(made.poses), made.way.reading)
    return "\n".join(lines) + "\n"


def _arm_file(poses: RobotPoses) -> Path:
    assert poses.geometry is not None
    return poses.geometry.file
