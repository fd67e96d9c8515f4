"""A table of poses or joint angles -> the text of views.csv; no scans to ask: what the file does not say, flags say."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.units import METRES
from stitch.output.session_files import table_text
from stitch.plugins.intake.controllers import tracker_csv, universal_robots
from stitch.plugins.intake.controllers.program import POSE_COLUMNS, ImportedTable, numbered_names, pose_cells
from stitch.plugins.intake.layouts import POSE_UNITS, ColumnLayout, covariate_columns, pose_units, possible_layouts
from stitch.plugins.intake.pose_tables import read_number_table
from stitch.plugins.intake.raw_poses import PROGRAMS, STRUCTURED, RawPoses, read_raw_poses
from stitch.plugins.intake.readings import Reading, StatedTable, angle_units, readings
from stitch.session.reading.clouds import CLOUD_SUFFIXES


def is_table_of_poses(file: Path) -> bool:
    """False for robot programs, recordings of a UR and exports of trackers, which have readers of their own."""
    suffix = file.suffix.lower()
    if suffix in STRUCTURED:
        return True
    if suffix in PROGRAMS or not file.is_file():
        return False
    try:
        table = read_number_table(file)
    except InputError:
        return False
    if suffix != ".csv" or table.header is None:
        return True
    told = file.read_text(encoding="utf-8-sig", errors="replace")
    names, _ = tracker_csv.split_header(told)
    return not universal_robots.is_recording(told) and not all(axis in names for axis in "xyz")


def import_table(file: Path, unit: str, stated: StatedTable) -> ImportedTable:
    """Read a table of poses, or of joint angles, or of both.

    Args:
        unit: "mm" or "m", the session's length_unit.

    Raises:
        InputError: no poses, or what the file does not say and no flag states; names the flag.
    """
    if unit not in METRES:
        raise InputError(f"--unit {unit}: use mm or m")
    raw = read_raw_poses([file])
    raw = raw.renamed(stated.columns) if stated.columns else raw
    found = possible_layouts(raw)
    if len(found) > 1:
        ways = "; or ".join(layout.words for layout in found)
        raise InputError(f"{file}: {ways}; to fix: name the columns with --columns, for example x,y,z,rx,ry,rz")
    layout = found[0]
    columns: dict[str, Sequence[str]] = {"view": _view_names(raw)}
    count, words = len(columns["view"]), []
    if (clouds := _cloud_names(raw)) is not None:
        columns["cloud"] = clouds
    if layout.joints is not None:
        degrees = _table_joints(file, layout, stated)
        columns |= {f"j{i}_deg": [f"{q:.9g}" for q in joint] for i, joint in enumerate(degrees.T, 1)}
        words.append("joint angles")
    if layout.rotation.shape[1]:
        reading = _table_reading(file, layout, stated)
        file_unit = _table_unit(file, layout, stated)
        T = frames.inverse(reading.T) if stated.inverse else reading.T
        scale = POSE_UNITS[file_unit] / METRES[unit]
        columns |= zip(POSE_COLUMNS, zip(*(pose_cells(pose, scale) for pose in T), strict=True), strict=True)
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


def _table_reading(file: Path, layout: ColumnLayout, stated: StatedTable) -> Reading:
    found = readings(layout, stated.rotation, stated.angle_unit)
    if len({r.rotation for r in found}) > 1:
        usual = ", ".join(dict.fromkeys(r.rotation for r in found[:4]))
        raise InputError(
            f"{file}: does not say how its {layout.rotation.shape[1]} numbers of rotation are to be read; to fix: "
            f"state --rotation {usual} …, or let the scans tell it: stitch init FOLDER --poses {file.name}"
        )
    if len(found) > 1:
        raise InputError(f"{file}: does not say the unit of its angles; to fix: state --angles deg or --angles rad")
    return found[0]


def _table_joints(file: Path, layout: ColumnLayout, stated: StatedTable) -> np.ndarray:
    assert layout.joints is not None
    units: Sequence[str] = angle_units(layout.joints, stated.angle_unit or layout.angle_unit)
    if len(units) > 1:
        raise InputError(
            f"{file}: does not say the unit of its joint angles; to fix: state --angles deg or --angles rad"
        )
    return np.asarray(layout.joints if units[0] == "deg" else np.degrees(layout.joints))


def _table_unit(file: Path, layout: ColumnLayout, stated: StatedTable) -> str:
    if stated.length_unit or layout.length_unit:
        return str(stated.length_unit or layout.length_unit)
    found = pose_units(layout.position)
    if len(found) > 1:
        raise InputError(f"{file}: positions may be in {' or '.join(found)}; to fix: state --file-unit")
    return found[0]
