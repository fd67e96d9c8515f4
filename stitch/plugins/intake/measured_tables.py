"""Tables of a robot's poses or joints, of its geometry, and of measured points, as a folder without scans has them."""

import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from stitch.errors import InputError
from stitch.numerics.frames import Array
from stitch.plugins.intake.column_names import bare_name, read_names
from stitch.plugins.intake.layouts import POSE_UNITS, clock_column
from stitch.plugins.intake.pose_tables import parse_number_table
from stitch.plugins.intake.raw_poses import STRUCTURED, RawPoses, is_program, read_raw_poses
from stitch.plugins.intake.readings import JOINT_ANGLES, Reading, all_readings, with_joints_of
from stitch.plugins.intake.stated_folder import StatedFolder
from stitch.plugins.intake.table_files import WORKBOOKS, read_any_text, workbook_sheets
from stitch.session.reading.robot_description import robot_from_dh
from stitch.session.robot import Robot

_ROBOT = re.compile(r"robot|flange|tcp|joint|\barm\b|kuka|abb|fanuc|nominal|command|program", re.IGNORECASE)
MEASURED = re.compile(
    r"track|leica|laser|meas|probe|smr|mocap|marker|rigid|vicon|opti|qualisys|reflector|prism|ball|sphere|point|faro|"
    r"spatial|tmac|camera|mm_?probe",
    re.IGNORECASE,
)
CAMERAS = re.compile(r"mocap|marker|rigid body|vicon|opti|qualisys|camera|motive", re.IGNORECASE)
_GEODETIC = {"east": "x", "easting": "x", "north": "y", "northing": "y", "height": "z", "elevation": "z"}
_SIGMA = re.compile(r"(?:sigma|std|stddev|stdev|sd|s|u|unc|uncertainty|u95|rms)_?([xyz])?")
TURNS = re.compile(r"r[xyz]|q[xyzw0-3]|rot[xyzw]|rv[xyz]|roll|pitch|yaw|[abcwpr]")
_FILLERS = {"position", "pos", "rotation", "rot", "coordinate", "orientation", "translation", "1", "sigma"}
_STATED_UNIT = re.compile(r"units?\W{0,3}(?:of length)?\W{0,3}(millimet|mm|met|m\b|inch)", re.IGNORECASE)
_UNIT_WORDS = {"millimet": "mm", "mm": "mm", "met": "m", "m": "m", "inch": "inch"}
COUNTED = re.compile(r"view|pose|index|idx|id|nr|no|num|number|point|target|meas|frame|config", re.IGNORECASE)
_MAX_MB = 200
# Links of a robot add up to more than this in mm, and to less in m.
_LONGEST_M = 20.0
# A reading, and the [robot] table by which it is one of joints.
ReadingOfArm = tuple[Reading, dict[str, Any] | None]


@dataclass(frozen=True)
class Table:
    """Rows of numbers of one file, or of one sheet of it."""

    file: Path
    title: str  # of file and sheet, for people
    raw: RawPoses
    unit: str | None = None  # of lengths, where words above the table state it

    @cached_property
    def groups(self) -> dict[str, dict[str, int]]:
        """Columns by role, x, y, z, rx …, sigma, of each thing that the table gives a place of, by its name."""
        names, taken = self.raw.header, set[int]()
        if names is None:
            return self._unnamed_group()
        joints, out = set(read_names(names).joints), dict[str, dict[str, int]]()
        for i, name in enumerate(names):
            role, owner = _role_of(name)
            if i not in joints and role:
                out.setdefault(owner, {}).setdefault(role, i)
                taken.add(i)
        placed = {owner: columns for owner, columns in out.items() if {"x", "y", "z"} <= set(columns)}
        shared = {r: i for o, columns in out.items() if o not in placed for r, i in columns.items() if r[:5] == "sigma"}
        return {owner: shared | columns for owner, columns in placed.items()}

    def _unnamed_group(self) -> dict[str, dict[str, int]]:
        x = self.raw.numbers
        counted = x.shape[1] == 4 and bool((x[:, 0] == np.round(x[:, 0])).all())
        if x.shape[1] == 3 or counted:
            return {"": dict(zip("xyz", range(counted, 3 + counted), strict=True))}
        return {"": {"x": 0, "y": 1, "z": 2, "sigma": 3}} if x.shape[1] == 4 else {}

    def unit_of(self, columns: Mapping[str, int]) -> str | None:
        """As the header says it, or words above it."""
        told = None if self.raw.header is None else bare_name(self.raw.header[columns["x"]])[1]
        return told if told in POSE_UNITS else self.unit

    @cached_property
    def times(self) -> Array | None:
        """(n,) s of the clock that the table keeps; None where it has none."""
        if (times := clock_column(dict(zip(self.raw.header or (), self.raw.numbers.T, strict=False)))) is not None:
            return times
        clock = self.raw.clock
        return None if clock is None or clock.seconds is None else clock.first_s + clock.seconds


def _role_of(name: str) -> tuple[str, str]:
    """What a column holds, and of what; an empty role for what is neither place, turn nor sigma."""
    bare, unit = bare_name(name)
    words = [w for w in re.split(r"[._\s/\-:,\[\](){}]+", name.lower()) if w and w != unit and w not in _FILLERS]
    numbered = re.fullmatch(r"([xyz])_?(\w*\d)", bare)
    axes = [w for w in words if w in ("x", "y", "z")]
    spread = next((m for w in words if len(w) > 1 and (m := _SIGMA.fullmatch(w))), None)
    if "sigma" in name.lower() or spread:
        axis = (spread and spread[1]) or (axes[0] if axes else "")
        rest = [w for w in words if w not in axes and not _SIGMA.fullmatch(w)]
        double = "2" if re.search(r"95|2\W*sigma|k\W*=?\W*2", name.lower()) else ""
        return f"sigma{axis}{double}", " ".join(rest)
    if numbered:
        return numbered[1], numbered[2]
    role = _GEODETIC.get(bare, bare)
    if role not in ("x", "y", "z") and len(axes) == 1 and not TURNS.fullmatch(role):
        role = axes[0]
    if role not in ("x", "y", "z") and not TURNS.fullmatch(role):
        return "", ""
    return role, " ".join(w for w in words if w not in (bare, role, *axes))


def read_tables(file: Path) -> list[Table]:
    """Return the tables of numbers of a file; none where it holds none.

    Raises:
        InputError: a workbook that cannot be read.
    """
    if file.suffix.lower() in STRUCTURED or is_program(file):
        return [Table(file, file.name, read_raw_poses([file]))]
    if file.suffix.lower() in WORKBOOKS:
        texts = {f"{file.name}, sheet {name}": text for name, text in workbook_sheets(file).items()}
    else:
        texts = {file.name: read_any_text(file, "name a table", _MAX_MB)}
    out = []
    for title, text in texts.items():
        told = _STATED_UNIT.search(text[:4000])
        unit = _UNIT_WORDS[told[1].lower()] if told else None
        try:
            table = parse_number_table(file, text, sparse=True)
            raw = RawPoses(title, table.header, table.numbers, table.labels, table.words)
        except InputError:
            if file.suffix.lower() in WORKBOOKS:
                continue
            raw = read_raw_poses([file])
        out.append(Table(file, title, raw, unit))
    return out


@dataclass(frozen=True)
class Geometry:
    """The arm that a file holds: each way to read it, with the [robot] table, mm, that says so where it is no URDF."""

    file: Path
    arms: tuple[tuple[Path | Robot, dict[str, Any] | None], ...]


def find_geometry(files: Sequence[Path], tables: Sequence[Table]) -> Geometry | None:
    """Return the geometry that lies in a folder, if one does: a URDF, a [robot] table, or a table of DH rows."""
    for file in files:
        if file.suffix.lower() == ".urdf":
            return Geometry(file, ((file, None),))
    for file in files:
        if file.suffix.lower() == ".toml":
            try:
                table = tomllib.loads(file.read_text(encoding="utf-8")).get("robot", {})
            except (ValueError, OSError):
                continue
            if "joints" in table:
                return Geometry(file, (_arm_of(table),))
    for dh in tables:
        names = [bare_name(name)[0] or name.lower() for name in dh.raw.header or ()]
        if {"a", "alpha", "d"} <= set(names):
            x = dict(zip(names, dh.raw.numbers.T, strict=True))
            turns = np.array([x["alpha"], x.get("theta", np.zeros(len(x["a"])))])
            if np.abs(turns).max() <= 2 * np.pi:
                turns = np.degrees(turns)
            rows = [
                {"a": a, "alpha_deg": alpha, "d": d, "theta_deg": theta}
                for a, alpha, d, theta in np.column_stack([x["a"], turns[0], x["d"], turns[1]]).tolist()
            ]
            kinds = ("standard", "modified")  # nobody says which kind they are
            return Geometry(
                dh.file, tuple(_arm_of({"name": dh.file.stem, "dh": kind, "joints": rows}) for kind in kinds)
            )
    return None


def _arm_of(table: dict[str, Any]) -> tuple[Robot, dict[str, Any]]:
    """The arm of a [robot] table, with the table in mm."""
    table = _in_mm(table)
    gravity = np.array(table.get("gravity", (0, 0, -9.81)), float)
    name, dh = table.get("name", "arm"), table.get("dh", "standard")
    return robot_from_dh(name, dh, table["joints"], table.get("payload"), gravity, "mm"), table


def _in_mm(table: dict[str, Any]) -> dict[str, Any]:
    rows = table["joints"]
    long = sum(abs(row.get("a", 0)) + abs(row.get("d", 0)) for row in rows)
    if long > _LONGEST_M:
        return table

    def scaled(owner: dict[str, Any]) -> dict[str, Any]:
        com = {"com": [1e3 * x for x in owner["com"]]} if "com" in owner else {}
        return owner | com | {key: 1e3 * owner[key] for key in ("a", "d") if key in owner}

    payload = {"payload": scaled(table["payload"])} if "payload" in table else {}
    return {**table, "joints": [scaled(row) for row in rows], **payload}


@dataclass(frozen=True)
class RobotPoses:
    """Rows of the robot's poses, and each way to read them."""

    table: Table
    group: str | None  # of its groups, which holds its poses; None: joints alone, or a table without names
    raw: RawPoses
    ways: tuple[ReadingOfArm, ...]
    geometry: Geometry | None = None


def find_robot_poses(tables: Sequence[Table], geometry: Geometry | None, stated: StatedFolder) -> RobotPoses | None:
    """Return the rows that hold the robot's poses or joints; None where no table has any.

    Raises:
        InputError: several do, or joint angles without the robot's geometry.
    """
    found = list[tuple[int, RobotPoses]]()
    arms = ((None, None),) if geometry is None else geometry.arms
    refused: InputError | None = None
    for table in tables:
        if geometry is not None and geometry.file == table.file:
            continue
        for group, raw in _posed(table, geometry):
            said = f"{table.title} {group or ''}"
            score = 2 * bool(_ROBOT.search(said)) - 2 * bool(MEASURED.search(said)) + 9 * (table.file == stated.poses)
            try:
                every = [(way, arm) for model, arm in arms for way in all_readings(raw, model, stated)]
            except InputError as error:
                refused = error
                continue
            jointed = any(way.rotation == JOINT_ANGLES for way, _ in every)
            ways = every if jointed else [(way, None) for way, _ in every[: len(every) // len(arms)]]
            found.append((score + 3 * jointed, RobotPoses(table, group, raw, tuple(ways), geometry)))
    if not found:
        if refused is not None:
            raise refused
        return None
    best = max(score for score, _ in found)
    alike = [poses for score, poses in found if score == best]
    if len(alike) > 1:
        named = ", ".join(dict.fromkeys(f"{p.table.title} {p.group or ''}".strip() for p in alike))
        raise InputError(
            f"{tables[0].file.parent}: {named} may hold the robot's poses; to fix: name it with --poses FILE"
        )
    return alike[0]


def _posed(table: Table, geometry: Geometry | None) -> Iterator[tuple[str | None, RawPoses]]:
    """Yield what of a table can be poses of a robot: joints, things with a turn, columns without names."""
    raw = table.raw
    if raw.header is None:
        if not table.groups:
            yield None, raw
        return
    if geometry is not None and isinstance(geometry.arms[0][0], Path):
        raw = with_joints_of(raw, geometry.arms[0][0])
    named = read_names(raw.header or ())
    if len(named.rotation) in (12, 16):
        yield None, raw
        return
    if named.joints:
        placed = {i for columns in table.groups.values() for i in columns.values()}
        yield None, columns_of(raw, [i for i in range(raw.numbers.shape[1]) if i not in placed])
        return
    for owner, columns in table.groups.items():
        if any(TURNS.fullmatch(role) for role in columns):
            others = {i for o, c in table.groups.items() if o != owner for i in c.values()}
            kept = [i for i in range(raw.numbers.shape[1]) if i not in others]
            yield owner, columns_of(raw, kept, owner)


def columns_of(raw: RawPoses, kept: Sequence[int], owner: str = "") -> RawPoses:
    header = [(raw.header or ())[i] for i in kept]
    for word in owner.split():
        header = [re.sub(rf"(?i)(?<![a-z]){re.escape(word)}[ _.:/-]*", "", name) for name in header]
    return replace(raw, header=tuple(header), numbers=raw.numbers[:, kept])
