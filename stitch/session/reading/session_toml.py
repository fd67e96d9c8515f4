"""session.toml: every key checked, tables turned to what they describe."""

import re
import shlex
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.units import METRES
from stitch.session.axes import KINDS, Axis
from stitch.session.reading.robot_description import (
    LARGEST,
    robot_from_dh,
    robot_from_urdf,
    table_numbers,
)
from stitch.session.reading.text_files import (
    optional_text,
    read_toml,
    require_folder_name,
    require_known_keys,
    require_name,
    shortened,
    table_choice,
)
from stitch.session.robot import Robot
from stitch.session.session import Scanner, SensorKind, StatedRepeatability

SESSION_FORMAT = "stitch-session/1"
# Keys by the table that they stand in; "" for the document itself.
TABLE_KEYS = {
    "": ("format", "name", "length_unit", "cloud_unit", "mount", "scanner", "robot", "sphere", "part", "axis"),
    "scanner": ("pose", "noise", "standoff", "optical_axis", "kind", "within", "moving", "name"),
    "robot": ("name", "dh", "joints", "urdf", "base_link", "flange_link", "payload", "gravity", "repeatability"),
    "sphere": ("radius",),
    "part": ("cad", "cad_unit"),
}
_AXIS_KEYS = ("name", "kind", "carries", "direction", "point", "stated")
# What an axis may carry beside a robot that carries the scanner, or the part, and without a robot.
_CARRIED = {"eye_in_hand": ("part", "robot"), "eye_to_hand": ("scanner", "robot"), "": ("part", "scanner")}
_AXIS_NAME = re.compile(r"[A-Za-z][A-Za-z0-9]*(?:_[A-Za-z0-9]+)*")
# Effects of the scanner count its field as x/z and y/z: they know no scanner that looks along x or y.
_AXES = {"+z": np.array([0.0, 0.0, 1.0]), "-z": np.array([0.0, 0.0, -1.0])}


def read_session_document(file: Path) -> dict[str, Any]:
    """Return the content of session.toml; all its tables and keys are known ones.

    Raises:
        InputError: missing, not TOML, of another format, or with an unknown key; says what the folder looks like.
    """
    hint = "a session is a folder with session.toml and views.csv"
    if any(file.parent.glob("*/session.toml")):
        hint += f"; to fix: name the sessions in it, {shlex.quote(str(file.parent))}/*"
    elif file.parent.is_dir():
        # Whoever names the folder of the raw scans comes here first.
        hint += f"; to fix: `stitch init {shlex.quote(str(file.parent))}` makes one of scans and poses as they are"
    elif file.parent.exists():
        hint += f"; to fix: name a folder, {shlex.quote(str(file.parent))} is a file"
    else:
        hint += f"; to fix: name a folder that exists, {shlex.quote(str(file.parent))} does not"
    document = read_toml(file, hint)
    if document.get("format") != SESSION_FORMAT:
        raise InputError(f'{file}: format is {shortened(document.get("format"))}; expected "{SESSION_FORMAT}"')
    for table, known in TABLE_KEYS.items():
        require_known_keys(file, document if not table else document.get(table, {}), known, table)
    return document


def usual_guesses(file: Path, document: dict[str, Any]) -> dict[str, str]:
    """Return key -> value of what `stitch init` guessed, since nothing in the data shows it.

    It writes such values as comments "# ? KEY: VALUE". A key to which the document now gives another value is no guess.

    Args:
        file: session.toml.
        document: its content.
    """
    found = re.findall(r"^# \? (\w+): ([^;,\n]+)", file.read_text(encoding="utf-8"), re.MULTILINE)
    return {what: value for what, value in found if document.get(what, value) == value}


def session_name(file: Path, document: dict[str, Any]) -> str:
    """Return what the session is called: its name, or that of its folder.

    Raises:
        InputError: a name that cannot be that of its run's folder.
    """
    stated = optional_text(file, document, "", "name")
    return require_folder_name(str(file), file.resolve().parent.name if stated is None else stated)


def read_scanner(file: Path, table: dict[str, Any]) -> Scanner:
    """Return the scanner that the table [scanner] describes; lengths in length_unit. Missing keys have their defaults.

    Raises:
        InputError: a value that cannot be, and how to fix it.
    """
    axis = table.get("optical_axis", "+z")
    if axis not in tuple(_AXES):
        raise InputError(
            f"{file}: scanner.optical_axis is {shortened(axis)}; turn the clouds until their scanner looks along z, "
            'and write the side: "+z" or "-z"'
        )
    T_mount = _read_pose(file, table["pose"]) if "pose" in table else None
    noise = positive_number(file, table, "scanner", "noise")
    standoff = positive_number(file, table, "scanner", "standoff")
    kind = table_choice(file, table, "kind", get_args(SensorKind)) if "kind" in table else None
    moving = table.get("moving", False)
    if not isinstance(moving, bool):
        raise InputError(f"{file}: scanner.moving is {shortened(moving)}; use true or false")
    name = optional_text(file, table, "scanner", "name") or ""
    if name and not _AXIS_NAME.fullmatch(name):
        raise InputError(f'{file}: scanner.name is {shortened(name)}; to fix: letters and digits, as name = "left"')
    return Scanner(T_mount, noise, standoff, _AXES[axis], cast(SensorKind | None, kind), moving, name)


def _read_pose(file: Path, value: Any) -> Array:
    """Return scanner.pose as a rigid motion (4, 4), its rotation made exactly orthonormal.

    Raises:
        InputError: no 4×4 matrix, or one that is no rigid motion within 1e-3.
    """
    try:
        T = np.array(value, float)
    except (TypeError, ValueError, OverflowError):
        T = np.empty(0)
    if T.shape != (4, 4) or not (np.abs(T) < LARGEST).all():
        raise InputError(f"{file}: scanner.pose is no 4×4 matrix; to fix: write four rows of four numbers")
    deviation = float(np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max())
    if deviation > 1e-3 or np.linalg.det(T[:3, :3]) < 0 or np.abs(T[3] - [0, 0, 0, 1]).max() > 1e-9:
        raise InputError(
            f"{file}: scanner.pose is not a rigid motion (R·Rᵀ differs from 1 by {deviation:.2g}, "
            f"det {np.linalg.det(T[:3, :3]):+.3f}); write a rotation, and 0 0 0 1 in the last row"
        )
    return frames.make(frames.nearest_rotation(T[:3, :3]), T[:3, 3])


def read_axes(file: Path, tables: Any, mount: str, has_poses: bool) -> tuple[Axis, ...]:
    """Return the external axes of [[axis]], in the order of the chain; lengths in length_unit.

    Args:
        mount: eye_to_hand or eye_in_hand.
        has_poses: a robot moves too.

    Raises:
        InputError: a value that cannot be, or an axis that carries what this mount leaves still.
    """
    if not isinstance(tables, list):
        raise InputError(f"{file}: axes are tables [[axis]], one an axis; to fix: write the brackets twice")
    if tables and not has_poses and mount != "eye_to_hand":
        raise InputError(
            f'{file}: axes without a robot carry the part or the scanner; to fix: write mount = "eye_to_hand", or '
            "add the robot's poses to views.csv"
        )
    axes = [_read_axis(file, f"axis {k + 1}", table, mount if has_poses else "") for k, table in enumerate(tables)]
    for axis in axes:
        if [other.name for other in axes].count(axis.name) > 1:
            raise InputError(f"{file}: two axes are called {axis.name}; to fix: give each a name of its own")
    return tuple(axes)


def _read_axis(file: Path, where: str, table: Any, mount: str) -> Axis:
    """Return one axis of [[axis]], in the frame in which the table states it.

    Args:
        where: names the table until its own name is known.
        mount: eye_to_hand | eye_in_hand; "" without a robot. It says what an axis may carry.

    Raises:
        InputError: a value that cannot be, and how to fix it.
    """
    require_known_keys(f"{file}: {where}", table, _AXIS_KEYS)
    name = table.get("name")
    if not isinstance(name, str) or not _AXIS_NAME.fullmatch(name):
        raise InputError(f'{file}: {where} needs a name of letters and digits; to fix: write name = "table"')
    where = f"{file}: axis {name}"
    kind = table_choice(where, table, "kind", KINDS)
    carries = table_choice(where, table, "carries", _CARRIED[mount])
    direction = None
    if "direction" in table:
        direction = table_numbers(where, table, "direction", (3,))
        if not np.linalg.norm(direction) > 0:
            raise InputError(f"{where}: direction is zero; to fix: write three numbers, [0, 0, 1] for upwards")
        direction = direction / np.linalg.norm(direction)
    if "point" in table and kind == "linear":
        raise InputError(f"{where}: a linear axis has a direction alone; to fix: take the point out")
    point = table_numbers(where, table, "point", (3,)) if "point" in table else None
    stated = table.get("stated", False)
    if not isinstance(stated, bool):
        raise InputError(f"{where}: stated is {shortened(stated)}; use true or false")
    axis = Axis(name, kind, carries, direction, point, stated)
    if stated and not axis.is_placed:
        needs = "direction and point" if axis.is_rotary else "a direction"
        raise InputError(f"{where}: stated = true needs {needs}; to fix: write them, or leave stated out")
    return axis


def read_crop_box(file: Path, table: dict[str, Any]) -> Array | None:
    """Return scanner.within: lowest and highest corner (2, 3) of a box, scanner frame, length_unit; None without one.

    Points outside it are left out of the scans.

    Raises:
        InputError: not two corners, or the second one not above the first.
    """
    if "within" not in table:
        return None
    try:
        box = np.array(table["within"])
    except ValueError:
        box = np.zeros(0)
    # Words and true are numbers to NumPy; integers of hundreds of digits are objects.
    is_box = box.shape == (2, 3) and box.dtype.kind in "if" and bool(np.isfinite(box).all())
    if not is_box or not (box[0] < box[1]).all():
        raise InputError(
            f"{file}: scanner.within is {shortened(table['within'])}; state the lowest and the highest corner of the "
            "box that counts, in the scanner's frame: [[-200, -200, 300], [200, 200, 600]]"
        )
    return box.astype(float)


def read_robot(file: Path, table: dict[str, Any] | None, unit: str) -> Robot | None:
    """Return the robot that [robot] describes by DH rows or a URDF; lengths in the unit `unit`.

    None without such a table, and where it states the repeatability alone.

    Raises:
        InputError: a value that cannot be, and how to fix it.
    """
    if not table:
        return None
    name = require_name(f"{file}: robot", optional_text(file, table, "robot", "name") or "robot", "name")
    gravity = table_numbers(f"{file}: robot", {"gravity": [0.0, 0.0, -9.81]} | table, "gravity", (3,))
    payload = table.get("payload")
    urdf = optional_text(file, table, "robot", "urdf")
    base = optional_text(file, table, "robot", "base_link")
    flange = optional_text(file, table, "robot", "flange_link")
    if urdf is not None:
        return robot_from_urdf(file.parent / urdf, base, flange, unit, gravity, payload)
    if "joints" not in table and "repeatability" in table:
        return None
    if "joints" not in table:
        raise InputError(f"{file}: [robot] needs joints (DH rows) or urdf")
    try:
        return robot_from_dh(name, str(table.get("dh", "standard")), table["joints"], payload, gravity, unit)
    except InputError as error:
        raise InputError(f"{file}: {error}") from None
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(f"{file}: robot.joints: {error}; every row is {{ a, alpha_deg, d, theta_deg }}") from None


def read_repeatability(file: Path, table: dict[str, Any] | None) -> StatedRepeatability:
    """Return the repeatability that [robot] states as { position, rotation_mrad }, in length_unit and rad.

    What it does not state is None.

    Raises:
        InputError: another key, or no positive number.
    """
    stated = (table or {}).get("repeatability")
    if stated is None:
        return StatedRepeatability()
    where = f"{file}: robot.repeatability"
    require_known_keys(where, stated, ("position", "rotation_mrad"))
    position = positive_number(file, stated, "robot.repeatability", "position")
    rotation_mrad = positive_number(file, stated, "robot.repeatability", "rotation_mrad")
    return StatedRepeatability(position, None if rotation_mrad is None else rotation_mrad / 1e3)


def cad_file(file: Path, table: dict[str, Any]) -> tuple[Path | None, str | None]:
    """Return path and length unit of the CAD file of [part]; None for what is not stated.

    Raises:
        InputError: no such file, or another unit.
    """
    name = optional_text(file, table, "part", "cad")
    path = None if name is None else file.parent / name
    if path is not None and not path.is_file():
        raise InputError(f"{file}: part.cad names {path}, which is no file; to fix: correct the path")
    return path, table_choice(file, table, "cad_unit", tuple(METRES)) if "cad_unit" in table else None


def positive_number(file: Path, table: dict[str, Any], name: str, key: str) -> float | None:
    """Return the positive number at `key` of the table that is called `name`; None where it is absent.

    Raises:
        InputError: anything else.
    """
    value = table.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < LARGEST:
        raise InputError(f"{file}: {name}.{key} is {shortened(value)}; use a positive number")
    return float(value)
