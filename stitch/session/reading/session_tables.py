"""views.csv: one row per scan, columns by name."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.session.reading.csv_files import finite_number, is_number, read_csv_lines
from stitch.session.reading.text_files import require_file, require_name, shortened
from stitch.session.robot import Robot, forward
from stitch.session.session import NominalTargets, Sighting

# What bends an arm, in views.csv: payload_kg and j1_torque_nm …, known in every view or in none.

_PAYLOAD = "payload_kg"
_TORQUE = re.compile(r"j([1-9]\d*)_torque_nm$")
# No arm carries a hundred tonnes, no drive exerts a million N·m.
_LARGEST_KG, _LARGEST_NM = 1e5, 1e6


def require_loads(file: Path, header: Sequence[str], cells: Sequence[tuple[int, dict[str, str]]], joints: int) -> None:
    """Refuse loads of some views or some joints alone: gravity would silently take their place.

    Args:
        cells: line number and cells by column of every row.
        joints: how many the table has.

    Raises:
        InputError: names the line or the columns, and how to fix it.
    """
    filled = [name for name in header if any(row[name] for _, row in cells)]
    torques = [name for name in filled if _TORQUE.match(name)]
    if torques and joints and sorted(torques) != sorted(f"j{i + 1}_torque_nm" for i in range(joints)):
        raise InputError(
            f"{file} line 1: torques of {', '.join(torques)}, but the table has {joints} joints; to fix: write one "
            "column a joint, or take them out"
        )
    for name in [*torques, *(name for name in filled if name == _PAYLOAD)]:
        for line, row in cells:
            value = finite_number(file, line, name, row[name], "write a number in every row, or take the column out")
            if name == _PAYLOAD and value < 0:
                raise InputError(f"{file} line {line}: {name} is {value:g}; to fix: write a mass, 0 for none")
            if abs(value) > (_LARGEST_KG if name == _PAYLOAD else _LARGEST_NM):
                raise InputError(f"{file} line {line}: {name} is {value:g}, as on no arm; to fix: correct its unit")


# frames.csv: measured poses of a probe or board in the sensor's frame, a row per view.

_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_SIGMA = ("sigma", "sigma_deg")
_PROBE_QUATERNION_TOLERANCE = 1e-3


@dataclass(frozen=True)
class MeasuredFrames:
    """Poses of the probe (tracker) or board (camera), in the order of the file."""

    views: tuple[str, ...]
    T_sensor_probe: Array  # (V, 4, 4), length_unit
    sigma: Array | None  # (V,) of a coordinate, length_unit
    sigma_rotation: Array | None  # (V,) of a rotation, rad


def read_frames(file: Path, known: Sequence[str]) -> MeasuredFrames:
    """Read and check frames.csv against the views known from views.csv.

    Raises:
        InputError: names the line and how to fix it.
    """
    require_file(file, f"a frames session needs {','.join(('view', *_POSE))} there")
    header, rows = read_csv_lines(file)
    missing = [name for name in ("view", *_POSE) if name not in header]
    if missing:
        raise InputError(f"{file} line 1: no column {missing[0]!r}; columns are {', '.join(header) or 'none'}")
    if not rows:
        raise InputError(f"{file}: no poses; write one row per view")
    names: dict[str, int] = {}
    table = np.empty((len(rows), len(_POSE)))
    spread = {name: np.empty(len(rows)) for name in _SIGMA if name in header}
    allowed = set(known)
    for i, (line, cells) in enumerate(rows):
        row = dict(zip(header, (cell.strip() for cell in cells), strict=True))
        _check_name(file, line, row["view"], names, allowed)
        table[i] = [finite_number(file, line, name, row[name]) for name in _POSE]
        norm = float(np.linalg.norm(table[i, 3:]))
        if abs(norm - 1) > _PROBE_QUATERNION_TOLERANCE:
            raise InputError(
                f"{file} line {line}: qx,qy,qz,qw has length {norm:.4f}, not a rotation; "
                "write a unit quaternion, w last"
            )
        for name, values in spread.items():
            values[i] = finite_number(file, line, name, row[name])
            if values[i] <= 0:
                raise InputError(f"{file} line {line}: {name} is {values[i]:g}; write a positive number")
    T = frames.from_quaternion(table[:, :3], table[:, 3:])
    turn = spread.get("sigma_deg")
    return MeasuredFrames(tuple(names), T, spread.get("sigma"), None if turn is None else np.radians(turn))


def _check_name(file: Path, line: int, name: str, names: dict[str, int], allowed: set[str]) -> None:
    if name in names:
        raise InputError(f"{file} line {line}: view {name} stands on line {names[name]} already; leave one out")
    if name not in allowed:
        raise InputError(
            f"{file} line {line}: view {shortened(name)} is not in views.csv; add it there or remove the row"
        )
    names[name] = line


# Columns of joint angles in views.csv: called as the format calls them, none missing.

JOINT = re.compile(r"j([1-9]\d*)_deg$")
_OTHER_JOINT_NAME = re.compile(r"(?:j|joint|axis|a|q|theta)[_ ]?([1-9]\d?)(?:[_ ]?[\[(]?(?:deg|rad|°)[\])]?)?", re.I)
_LISTED_COLUMNS = 4
# Angles that give the reported poses this closely are those of the joints.
_ANGLE, _REACH = np.radians(2.0), 0.02


def require_joint_columns(file: Path, header: Sequence[str], robot: Robot | None) -> list[int]:
    """Numbers of the joints that have a column.

    Raises:
        InputError: one is missing, or there are more or fewer than the robot has joints.
    """
    found = sorted(int(m.group(1)) for name in header if (m := JOINT.match(name)))
    if not found:
        return found
    count = max(found[-1], robot.n_joints if robot else 0)
    missing = list(islice((i for i in range(1, count + 1) if i not in found), _LISTED_COLUMNS))
    told = ", ".join(f"j{i}_deg" for i in missing)
    if missing and missing[0] < found[-1]:
        raise InputError(
            f"{file} line 1: no column {told}; joint columns must be j1_deg … jN_deg without a gap; to fix: add it"
        )
    if robot and len(found) != robot.n_joints:
        mend = f"add {told}" if missing else "leave out those beyond, or correct [robot] in session.toml"
        raise InputError(
            f"{file} line 1: {len(found)} joint columns, but the robot has {robot.n_joints}; to fix: {mend}"
        )
    return found


def require_no_hidden_joints(
    file: Path, cells: Sequence[tuple[int, dict[str, str]]], poses: Sequence[Array], robot: Robot | None
) -> None:
    """Refuse columns whose names and numbers are those of joint angles, and that would count as covariates.

    Args:
        poses: (4, 4) T_base_flange of every row; columns that do not lead there are covariates, whatever their names.

    Raises:
        InputError: names the columns, and what to call them.
    """
    header = [*cells[0][1]] if cells else []
    names = [] if any(map(JOINT.match, header)) else _otherwise_named_joints(header)
    if robot is None or not names or len(names) != robot.n_joints:
        return
    rows = [([row[name] for name in names], T) for (_, row), T in zip(cells, poses, strict=True)]
    table = [([float(cell) for cell in row], T) for row, T in rows if all(map(is_number, row))]
    for unit, factor in (("", np.pi / 180), (", in degrees", 1.0)):
        if table and all(_reaches_pose(robot, factor * np.array(joints), T) for joints, T in table):
            raise InputError(
                f"{file} line 1: columns {', '.join(names)} hold the joint angles of the robot; to fix: call them "
                f"j1_deg … j{len(names)}_deg{unit}"
            )


def _otherwise_named_joints(header: Sequence[str]) -> list[str]:
    """Columns J1, J2 …, in the order of their numbers; none where one is missing or twice."""
    found = {name: int(m.group(1)) for name in header if (m := _OTHER_JOINT_NAME.fullmatch(name))}
    names = sorted(found, key=lambda name: found[name])
    return names if [found[name] for name in names] == [*range(1, len(names) + 1)] else []


def _reaches_pose(robot: Robot, joints: Array, T: Array) -> bool:
    if not np.isfinite(joints).all():
        return False
    told = forward(robot, joints)
    distance = np.linalg.norm(T[:3, 3] - told[:3, 3])
    return bool(frames.angle_between(T, told) <= _ANGLE and distance <= _REACH * np.linalg.norm(told[:3, 3]))


# points.csv and targets.csv: points that a sensor knows by name, and where a drawing puts them.

_XYZ = ("x", "y", "z")


def read_points(file: Path, known: Sequence[str]) -> dict[str, Sighting]:
    """Read and check points.csv: the sighting of every view that has one.

    Args:
        known: views of views.csv.

    Raises:
        InputError: names the line and how to fix it.
    """
    allowed = set(known)
    rows: dict[str, list[tuple[str, list[float]]]] = {}
    seen: dict[tuple[str, str], int] = {}
    for line, row in _table_rows(file, ("view", "target", *_XYZ)):
        view, target = row["view"], row["target"]
        if view not in allowed:
            raise InputError(
                f"{file} line {line}: view {shortened(view)} is not in views.csv; add it there or remove the row"
            )
        if (view, target) in seen:
            raise InputError(
                f"{file} line {line}: view {view} shows target {target} on line {seen[view, target]} already; "
                "leave one out, or name it otherwise"
            )
        seen[view, target] = line
        rows.setdefault(view, []).append((target, _point_numbers(file, line, row)))
    table = {view: np.array([numbers for _, numbers in found]) for view, found in rows.items()}
    return {
        view: Sighting(tuple(name for name, _ in found), table[view][:, :3], table[view][:, 3])
        for view, found in rows.items()
    }


def read_targets(file: Path, sighted: Sequence[str]) -> NominalTargets:
    """Read and check targets.csv.

    Args:
        sighted: targets of points.csv; one of them at least must be here.

    Raises:
        InputError: names the line and how to fix it.
    """
    lines: dict[str, int] = {}
    table = []
    for line, row in _table_rows(file, ("target", *_XYZ)):
        name = row["target"]
        if name in lines:
            raise InputError(f"{file} line {line}: target {name} stands on line {lines[name]} already; leave one out")
        lines[name] = line
        table.append(_point_numbers(file, line, row))
    if not set(lines) & set(sighted):
        raise InputError(
            f"{file}: none of its targets ({', '.join(list(lines)[:4])}) is seen in points.csv "
            f"({', '.join(list(sighted)[:4])}); use the same names, or remove the file"
        )
    numbers = np.array(table)
    return NominalTargets(tuple(lines), numbers[:, :3], numbers[:, 3])


def _table_rows(file: Path, needed: Sequence[str]) -> list[tuple[int, dict[str, str]]]:
    """Line number and cells by column of every row."""
    header, cells = read_csv_lines(file)
    missing = [name for name in needed if name not in header]
    if missing:
        raise InputError(f"{file} line 1: no column {missing[0]!r}; columns are {', '.join(header) or 'none'}")
    if not cells:
        raise InputError(f"{file}: no rows; write {','.join(needed)}[,sigma] a row")
    out = []
    for line, row in cells:
        out.append((line, dict(zip(header, (cell.strip() for cell in row), strict=True))))
        if not out[-1][1]["target"]:
            raise InputError(f"{file} line {line}: target is empty; give it a name")
        require_name(f"{file} line {line}", out[-1][1]["target"], "target")
    return out


def _point_numbers(file: Path, line: int, row: dict[str, str]) -> list[float]:
    """x, y, z and sigma, NaN where its cell is empty or the column absent."""
    out = []
    for column in (*_XYZ, "sigma"):
        cell = row.get(column, "")
        if column == "sigma" and not cell:
            out.append(float("nan"))
            continue
        out.append(finite_number(file, line, column, cell))
    if out[3] <= 0:
        raise InputError(f"{file} line {line}: sigma is {out[3]:g}; write a positive number or leave it empty")
    return out


# The pose of the flange in a row of views.csv: as it is reported, or from the joints.

POSE_COLUMNS = ("x", "y", "z", "qx", "qy", "qz", "qw")
# A quaternion with six digits is unit within 1e-6; beyond 1e-3 something else is written there.
_FLANGE_QUATERNION_TOLERANCE = 1e-3
# Joints and reported pose of a nominal model differ by the calibration (mm, tenths of a degree);
# degrees and percents of the reach are another convention.
_ANGLE_TOLERANCE = np.radians(2.0)
_REACH_TOLERANCE = 0.02


def has_reported_poses(file: Path) -> bool:
    """True if some row of a views.csv that was read before reports a pose; False where there is no such file."""
    if not file.is_file():
        return False
    header, rows = read_csv_lines(file)
    columns = [k for k, name in enumerate(header) if name in POSE_COLUMNS]
    return any(cells[k].strip() for _, cells in rows for k in columns)


def flange_pose(
    file: Path, line: int, name: str, row: dict[str, str], joints: Array | None, robot: Robot | None
) -> Array:
    """(4, 4) T_base_flange of a view; a reported pose is used where it stands, and must agree with the joints.

    Args:
        row: cells by their column.
        joints: (n,) rad.

    Raises:
        InputError: neither stands there, or what stands there is no pose, or not that of the joints.
    """
    from_joints = forward(robot, joints) if robot and joints is not None else None
    given = [row.get(column, "") for column in POSE_COLUMNS]
    if not any(given):
        if from_joints is None:
            raise InputError(
                f"{file} line {line}: view {name} has no pose; fill {','.join(POSE_COLUMNS)} or the joints, or "
                "remove the row"
            )
        return from_joints
    values = np.array([finite_number(file, line, c, cell) for c, cell in zip(POSE_COLUMNS, given, strict=True)])
    norm = float(np.linalg.norm(values[3:]))
    if abs(norm - 1) > _FLANGE_QUATERNION_TOLERANCE:
        raise InputError(
            f"{file} line {line}: view {name}: qx,qy,qz,qw has length {norm:.4f}, not a rotation; "
            "write a unit quaternion, w last"
        )
    reported = frames.from_quaternion(values[:3], values[3:] / norm)
    if robot is not None and from_joints is not None:
        require_agreement(f"{file} line {line}: view {name}", reported, from_joints, robot.metres_per_unit)
    return reported


def require_agreement(where: str, reported: Array, from_joints: Array, metres: float) -> None:
    """Refuse a reported pose (4, 4) that is not that of the joints.

    Args:
        where: row and view, for messages.
        metres: in one length_unit.

    Raises:
        InputError: by how much they differ, and what to check.
    """
    angle = float(frames.angle_between(reported, from_joints))
    distance = float(np.linalg.norm(reported[:3, 3] - from_joints[:3, 3]))
    reach = float(np.linalg.norm(from_joints[:3, 3]))
    if angle > _ANGLE_TOLERANCE or distance > _REACH_TOLERANCE * reach:
        raise InputError(
            f"{where}: joints and reported pose differ by {1e3 * metres * distance:.4g} mm and "
            f"{np.degrees(angle):.3g}°; check robot.dh, theta_deg, length_unit, or leave one of them out"
        )


_APPROACH = re.compile(r"j([1-9]\d*)_approach$")


@dataclass(frozen=True)
class ViewRow:
    """One row, checked; lengths in length_unit, joints in rad."""

    line: int
    name: str
    cloud: str
    T_base_flange: Array
    joints: Array | None
    approach: Array | None
    time_s: float | None
    covariates: dict[str, float]


def read_views(file: Path, robot: Robot | None) -> list[ViewRow]:
    """Read and check views.csv.

    Columns that hold text in every row (notes) are left alone. Where joints and a reported pose both
    stand, the reported pose is used and must agree with the joints.

    Raises:
        InputError: names the line and how to fix it.
    """
    require_file(file, "a session needs a row per scan there")
    header, lines = read_csv_lines(file)
    _check_header(file, header, robot)
    if not lines:
        raise InputError(f"{file}: no views; write one row per scan")
    cells = [(line, _row_cells(header, row)) for line, row in lines]
    covariates = covariate_names(header, cells)
    joints = [_row_joints(file, line, row, header) for line, row in cells]
    require_loads(file, header, cells, sum(bool(JOINT.match(name)) for name in header))
    rows: list[ViewRow] = []
    seen: dict[str, int] = {}
    latest = -np.inf
    for i, (line, row) in enumerate(cells):
        name = row.get("view", "")
        if not name or name in seen:
            mend = f"is used on line {seen[name]} already" if name else "is empty"
            raise InputError(f"{file} line {line}: view {name!r} {mend}; every view needs an id of its own")
        seen[require_name(f"{file} line {line}", name, "view")] = line
        time_s = finite_number(file, line, "time_s", row["time_s"]) if row.get("time_s") else None
        if time_s is not None:
            _require_later(file, line, time_s, latest)
            latest = time_s
        values = {c: finite_number(file, line, c, row[c]) for c in covariates if row[c]}
        cloud = row.get("cloud", "")
        T_base_flange = flange_pose(file, line, name, row, joints[i], robot)
        approach = _row_approach(file, line, row, joints, i)
        rows.append(ViewRow(line, name, cloud, T_base_flange, joints[i], approach, time_s=time_s, covariates=values))
    require_no_hidden_joints(file, cells, [row.T_base_flange for row in rows], robot)
    return rows


def row_at(file: Path, robot: Robot | None, joints: Array) -> ViewRow:
    """The row of a view that stands in no table, at joint angles (n,) rad.

    Args:
        file: session.toml.

    Raises:
        InputError: no robot, or one with another number of joints.
    """
    if robot is None:
        raise InputError(f"{file}: no [robot], so that joint angles mean nothing; to fix: state its DH rows or URDF")
    if len(joints) != robot.n_joints:
        raise InputError(
            f"{file}: {len(joints)} joint angles, but the robot has {robot.n_joints}; to fix: give one a joint"
        )
    return ViewRow(0, "start", "", forward(robot, joints), joints, np.zeros(len(joints)), time_s=None, covariates={})


def _require_later(file: Path, line: int, time_s: float, latest: float) -> None:
    """Refuse rows out of order: direction of approach, settling and drifts count on it."""
    if time_s < latest:
        raise InputError(
            f"{file} line {line}: time_s {time_s:g} stands below {latest:g}; sort the rows by time, or let it go on "
            "counting"
        )


def _check_header(file: Path, header: Sequence[str], robot: Robot | None) -> None:
    if "view" not in header:
        raise InputError(f"{file} line 1: no column 'view'; columns are {', '.join(header) or 'none'}")
    double = sorted({name for name in header if header.count(name) > 1})
    if double:
        raise InputError(f"{file} line 1: column {double[0]!r} stands twice; rename one")
    numbers = require_joint_columns(file, header, robot)
    pose = [name for name in POSE_COLUMNS if name in header]
    if pose and len(pose) < len(POSE_COLUMNS):
        missing = ", ".join(name for name in POSE_COLUMNS if name not in header)
        raise InputError(f"{file} line 1: a pose needs {', '.join(POSE_COLUMNS)}; missing {missing}")
    if not pose and not numbers:
        raise InputError(
            f"{file} line 1: neither joints (j1_deg …) nor poses ({','.join(POSE_COLUMNS)}); one of them is needed"
        )
    if numbers and not pose and not robot:
        raise InputError(f"{file} line 1: joints without poses need a [robot] in session.toml")


def _row_cells(header: Sequence[str], row: Sequence[str]) -> dict[str, str]:
    return {name: cell.strip() for name, cell in zip(header, row, strict=True)}


def covariate_names(header: Sequence[str], cells: Sequence[tuple[int, dict[str, str]]]) -> list[str]:
    """Columns of numbers that are neither poses nor joints: what errors may follow."""
    known = {"view", "cloud", "time_s", *POSE_COLUMNS}
    rest = [n for n in header if n not in known and not JOINT.match(n) and not _APPROACH.match(n)]
    return [name for name in rest if any(is_number(row[name]) for _, row in cells)]


def _row_joints(file: Path, line: int, row: dict[str, str], header: Sequence[str]) -> Array | None:
    names = [f"j{i}_deg" for i in range(1, sum(bool(JOINT.match(n)) for n in header) + 1)]
    if not names or not any(row[name] for name in names):
        return None
    return np.radians([finite_number(file, line, name, row[name]) for name in names])


def _row_approach(file: Path, line: int, row: dict[str, str], joints: Sequence[Array | None], i: int) -> Array | None:
    q = joints[i]
    if q is None:
        return None
    before = joints[i - 1] if i else None
    out = np.zeros(len(q)) if before is None else np.sign(q - before)
    for k in range(len(q)):
        cell = row.get(f"j{k + 1}_approach", "")
        if cell:
            out[k] = finite_number(file, line, f"j{k + 1}_approach", cell)
            if out[k] not in (-1, 0, 1):
                raise InputError(f"{file} line {line}: j{k + 1}_approach is {cell}; use -1, 0 or 1")
    return out
