"""session.toml: every key checked, tables turned to what they describe."""

import shlex
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from stitch.errors import InputError
from stitch.measurement.robot import Robot
from stitch.measurement.session import StatedRepeatability
from stitch.reading.dh_rows import require_known_keys, robot_from_dh, table_numbers
from stitch.reading.names import require_folder_name, require_name
from stitch.reading.text_file import shortened
from stitch.reading.toml_file import optional_text, read_toml, table_choice
from stitch.reading.urdf import robot_from_urdf
from stitch.units import METRES

SESSION_FORMAT = "stitch-session/1"

_KEYS = {
    "": {"format", "name", "length_unit", "cloud_unit", "mount", "scanner", "robot", "sphere", "part"},
    "scanner": {"pose", "noise", "standoff", "optical_axis", "kind", "within"},
    "robot": {"name", "dh", "joints", "urdf", "base_link", "flange_link", "payload", "gravity", "repeatability"},
    "sphere": {"radius"},
    "part": {"cad", "cad_unit"},
}
# No length of a cell is larger in any unit; beyond, squares overflow.
LARGEST = 1e12


def read_session_document(file: Path) -> dict[str, Any]:
    """The document with known tables and keys only.

    Raises:
        InputError: missing, not TOML, of another format, or with a key that nobody knows.
    """
    hint = "a session is a folder with session.toml and views.csv"
    if file.parent.is_dir():
        # Whoever names the folder of the raw scans comes here first.
        hint += f"; to fix: `stitch init {shlex.quote(str(file.parent))}` makes one of scans and poses as they are"
    elif file.parent.exists():
        hint += f"; to fix: name a folder, {shlex.quote(str(file.parent))} is a file"
    else:
        hint += f"; to fix: name a folder that exists, {shlex.quote(str(file.parent))} does not"
    document = read_toml(file, hint)
    if document.get("format") != SESSION_FORMAT:
        raise InputError(f'{file}: format is {shortened(document.get("format"))}; expected "{SESSION_FORMAT}"')
    for table, known in _KEYS.items():
        entries = document if not table else document.get(table, {})
        if not isinstance(entries, dict):
            raise InputError(f"{file}: [{table}] must be a table")
        for key in entries:
            if key not in known:
                close = get_close_matches(key, known, 1)
                raise InputError(
                    f"{file}: unknown key {f'{table}.{key}' if table else key!r}"
                    + (f"; did you mean {close[0]!r}?" if close else f"; known are {', '.join(sorted(known))}")
                )
    return document


def session_name(file: Path, document: dict[str, Any]) -> str:
    """What the session is called: its name, or that of its folder.

    Raises:
        InputError: a name that cannot be that of its run's folder.
    """
    stated = optional_text(file, document, "", "name")
    return require_folder_name(str(file), file.resolve().parent.name if stated is None else stated, "name")


def positive_number(file: Path, table: dict[str, Any], name: str, key: str) -> float | None:
    """A positive number, or None where it is absent.

    Raises:
        InputError: anything else.
    """
    value = table.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < LARGEST:
        raise InputError(f"{file}: {name}.{key} is {shortened(value)}; use a positive number")
    return float(value)


def read_robot(file: Path, table: dict[str, Any] | None, unit: str) -> Robot | None:
    """[robot] by its DH rows or URDF; None without one.

    Raises:
        InputError: a value that cannot be, and how to fix it.
    """
    if not table:
        return None
    name = require_name(f"{file}: robot", optional_text(file, table, "robot", "name") or "robot", "name")
    gravity = table_numbers(f"{file}: robot", {"gravity": [0.0, 0.0, -9.81]} | table, "gravity", (3,))
    payload = table.get("payload")
    urdf, base, flange = (optional_text(file, table, "robot", key) for key in ("urdf", "base_link", "flange_link"))
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
    """[robot] repeatability = { position, rotation_mrad }; position in length_unit.

    Raises:
        InputError: another key, or no positive number.
    """
    stated = (table or {}).get("repeatability")
    if stated is None:
        return StatedRepeatability()
    where = f"{file}: robot.repeatability"
    require_known_keys(where, stated, ("position", "rotation_mrad"))
    position, turn = (
        positive_number(file, stated, "robot.repeatability", key) for key in ("position", "rotation_mrad")
    )
    return StatedRepeatability(position, None if turn is None else turn / 1e3)


def cad_file(file: Path, table: dict[str, Any]) -> tuple[Path | None, str | None]:
    """Path and unit of the CAD file of [part]; None where they are absent.

    Raises:
        InputError: no such file, or another unit.
    """
    name = optional_text(file, table, "part", "cad")
    path = None if name is None else file.parent / name
    if path is not None and not path.is_file():
        raise InputError(f"{file}: part.cad names {path}, which is no file; to fix: correct the path")
    return path, table_choice(file, table, "cad_unit", tuple(METRES)) if "cad_unit" in table else None
