"""A table of poses or joint angles -> the text of views.csv; no scans to ask: what the file does not say, flags say."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.units import METRES
from stitch.output.session_files import TableColumns, pose_columns, table_text
from stitch.plugins.intake.column_names import bare_name, read_names
from stitch.plugins.intake.controllers.program import ImportedTable, import_file, numbered_names
from stitch.plugins.intake.layouts import POSE_UNITS, covariate_columns, pose_units, possible_layouts
from stitch.plugins.intake.raw_poses import RawPoses, is_program, read_raw_poses
from stitch.plugins.intake.readings import StatedTable, angle_units, readings
from stitch.session.reading.clouds import CLOUD_SUFFIXES

# Of a quaternion with two digits.
_UNIT_LENGTH = 0.02
# Columns that name what was measured; how trackers turn their probes.
_NAMES = ("name", "point", "pointname", "target", "id", "view", "measurement")
_OF_TRACKERS = (
    "quaternion by its letters, or Rx, Ry, Rz in degrees about fixed x, y, z: Rz·Ry·Rx; mm or m by the header"
)


def import_export(
    file: Path, unit: str, stated: StatedTable, frame: str | None = None, tool: str | None = None
) -> ImportedTable:
    """Read a robot program, or a table: of measured places where it is a .csv with x, y, z, else of poses or joints.

    Args:
        unit: "mm" or "m", the session's length_unit.
        frame, tool: of a program, see `import_file`.

    Raises:
        InputError: as the reader does.
    """
    if unit not in METRES:
        raise InputError(f"--unit {unit}: use mm or m")
    if not file.is_file():
        raise InputError(f"{file}: no such file; to fix: name an export of the controller")
    if stated == StatedTable() and (is_program(file) or file.suffix.lower() == ".jbi"):
        return import_file(file, unit, frame, tool)
    raw = read_raw_poses([file])
    plain = [bare_name(name)[0] for name in raw.header or ()]
    if stated == StatedTable() and file.suffix.lower() == ".csv" and {*"xyz"} <= {*plain}:
        return _import_measured(file, raw, unit)
    return import_table(file, raw, unit, stated)


def _import_measured(file: Path, raw: RawPoses, unit: str) -> ImportedTable:
    """Return frames.csv of 6D probes, or points.csv of reflectors, a new view whenever a name comes again."""
    named = read_names(raw.header or ())
    if len(named.rotation) == 3 and named.angle_unit is None:
        raise InputError(
            f"{file}: rx, ry, rz may be degrees or a rotation vector; to fix: write Rx (deg) … for a tracker's angles, "
            "actual_TCP_pose_0 … for a UR's pose"
        )
    numbered = next(
        (x for name, x in zip(raw.header or (), raw.numbers.T, strict=True) if name.lower() in _NAMES), None
    )
    counted = range(1, len(raw.numbers) + 1) if numbered is None else numbered
    names = [texts[0] if texts else f"{i:g}" for texts, i in zip(raw.labels, counted, strict=True)]
    position = raw.numbers[:, named.position] * (POSE_UNITS[named.length_unit or "mm"] / METRES[unit])
    if named.rotation:
        layout = replace(possible_layouts(raw)[0], position=position)
        size = np.linalg.norm(layout.rotation, axis=1)
        if layout.rotation.shape[1] == 4 and np.abs(size - 1).max() > _UNIT_LENGTH:
            odd = int(np.abs(size - 1).argmax())
            raise InputError(f"{file} row {odd + 1}: quaternion of length {size[odd]:.5g}; to fix: write a unit one")
        angles = "xyz-extrinsic" if layout.rotation.shape[1] == 3 else None
        T = readings(layout, angles, layout.angle_unit)[0].T
        columns: TableColumns = {"view": numbered_names(names), **pose_columns(T)}
        return ImportedTable("frames.csv", table_text(columns), len(T), _OF_TRACKERS, ())
    views = [f"v{names[: i + 1].count(name)}" for i, name in enumerate(names)]
    columns = {"view": views, "target": names, **dict(zip("xyz", position.T, strict=True))}
    note = (
        "points.csv: the first measurement of every name is view v1, the second v2; name the views in views.csv alike"
    )
    return ImportedTable("points.csv", table_text(columns), len(names), _OF_TRACKERS, (note,))


def import_table(file: Path, raw: RawPoses, unit: str, stated: StatedTable) -> ImportedTable:
    """Return a table of poses, or of joint angles, or of both.

    Raises:
        InputError: no poses, or what the file does not say and no flag states; names the flag.
    """
    raw = raw.renamed(stated.columns) if stated.columns else raw
    layouts = possible_layouts(raw)
    if len(layouts) > 1:
        ways = "; or ".join(layout.words for layout in layouts)
        raise InputError(f"{file}: {ways}; to fix: name the columns with --columns, for example x,y,z,rx,ry,rz")
    layout = layouts[0]
    columns: dict[str, Sequence[object] | Array] = {"view": _view_names(raw)}
    count, words = len(columns["view"]), []
    if (clouds := _cloud_names(raw)) is not None:
        columns["cloud"] = clouds
    if layout.joints is not None:
        units = angle_units(layout.joints, stated.angle_unit or layout.angle_unit)
        in_degrees = _only(file, "the unit of its joint angles", units, "state --angles deg or --angles rad") == "deg"
        degrees = layout.joints if in_degrees else np.degrees(layout.joints)
        columns |= {f"j{i}_deg": [f"{q:.9g}" for q in joint] for i, joint in enumerate(degrees.T, 1)}
        words.append("joint angles")
    if layout.rotation.shape[1]:
        found = readings(layout, stated.rotation, stated.angle_unit)
        advice = f"state --rotation, or let the scans tell it: stitch init FOLDER --poses {file.name}"
        _only(file, "how its numbers of rotation are to be read", [reading.rotation for reading in found], advice)
        angles = [str(reading.angle_unit) for reading in found]
        _only(file, "the unit of its angles", angles, "state --angles deg or --angles rad")
        reading = found[0]
        told = stated.length_unit or layout.length_unit
        lengths = [told] if told else pose_units(layout.position)
        file_unit = _only(file, "the unit of its positions", lengths, "state --file-unit")
        T = frames.inverse(reading.T) if stated.inverse else reading.T
        scale = POSE_UNITS[file_unit] / METRES[unit]
        columns |= pose_columns(frames.make(T[:, :3, :3], T[:, :3, 3] * scale))
        words.append(
            f"{reading.words}, positions in {file_unit}, {'T_flange_base' if stated.inverse else 'T_base_flange'}"
        )
    columns |= covariate_columns(layout, range(count), raw.time_s)
    # How times of day were read, or why they are left out.
    warnings = (raw.clock.words,) if raw.clock is not None and raw.clock.words else ()
    return ImportedTable("views.csv", table_text(columns), count, "; ".join(words), warnings)


def _view_names(raw: RawPoses) -> list[str]:
    """Names of the views: the first text beside each pose, else numbers."""
    return numbered_names(texts[0] if texts else f"v{i + 1:03d}" for i, texts in enumerate(raw.labels))


def _cloud_names(raw: RawPoses) -> list[str] | None:
    """The column of texts that names clouds, if one does."""
    for texts in zip(*raw.labels, strict=False):
        if all(Path(text).suffix.lower() in CLOUD_SUFFIXES for text in texts):
            return [text.replace("\\", "/") for text in texts]
    return None


def _only(file: Path, what: str, found: Sequence[str], advice: str) -> str:
    """The one of several that a file may mean; else a refusal."""
    several = list(dict.fromkeys(found))
    if len(several) > 1:
        raise InputError(f"{file}: does not say {what}, {' or '.join(several[:4])}; to fix: {advice}")
    return several[0]
