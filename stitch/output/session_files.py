"""A session folder on disk: session.toml, views.csv and what the sensor saw; whole or not at all.

The one writer of the format: the cells hand out their readings with it, and simulated cells what they measured.
"""

import csv
import io
import math
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.session.reading.session_toml import SESSION_FORMAT
from stitch.session.robot import Robot
from stitch.session.session import Cloud, StatedRepeatability
from stitch.system import ply_file

TableColumns = Mapping[str, Sequence[object] | Array]  # a table by its header; text as it stands, floats with 12 digits


@dataclass(frozen=True)
class SessionFiles:
    """What one session folder holds. Lengths in length_unit, frames as the sensor's mount has them."""

    name: str
    length_unit: str
    mount: str
    views: TableColumns  # columns of views.csv, the first called `view`
    tables: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # of session.toml, e.g. {"scanner": {…}}
    clouds: Mapping[str, Cloud] = field(default_factory=dict)  # by file, relative to the folder; scanner frame
    points: TableColumns | None = None  # view, target, x, y, z and sigma where it is known
    frames: TableColumns | None = None  # view, x, y, z, qx, qy, qz, qw of a probe in the sensor's frame
    targets: Mapping[str, Array] = field(default_factory=dict)  # nominal places (3,), part frame
    copies: Sequence[Path] = ()  # files that lie beside session.toml, such as the part's CAD
    texts: Mapping[str, str] = field(default_factory=dict)  # by file: others that lie there, such as a URDF
    exact: bool = False  # every digit of tables, and of the scalars of clouds


def pose_columns(T: Array) -> dict[str, Array]:
    """Return columns x, y, z, qx, qy, qz, qw of poses (V, 4, 4)."""
    columns = np.hstack([T[:, :3, 3], frames.to_quaternion(T)])
    return dict(zip(("x", "y", "z", "qx", "qy", "qz", "qw"), columns.T, strict=True))


def write_session(folder: Path, session: SessionFiles, check: Callable[[Path], None] | None = None) -> None:
    """Write one session into a new folder, completely or not at all.

    Args:
        check: is called with the scratch folder once all is written; if it raises, no folder is left.

    Raises:
        InputError: the folder exists and is not empty.
    """
    with whole_folder(folder) as scratch:
        _write(scratch, session)
        if check is not None:
            check(scratch)


def write_sessions(folder: Path, sessions: Sequence[SessionFiles]) -> None:
    """Write one session into `folder`, several into folders of their names below it; all of them or nothing.

    Raises:
        InputError: the folder exists and is not empty, or a name cannot be a folder's.
    """
    with whole_folder(folder) as scratch:
        for session in sessions:
            if session.name != Path(session.name).name:
                raise InputError(f"{folder}: {session.name!r} is no name for a folder; rename the session")
            _write(scratch if len(sessions) == 1 else scratch / session.name, session)


@contextmanager
def whole_folder(folder: Path) -> Iterator[Path]:
    """Yield a scratch folder beside `folder`: it gets that name if the block succeeds, and is deleted if it fails.

    Raises:
        InputError: the folder exists and is not empty.
    """
    if folder.is_symlink() or (folder.exists() and (not folder.is_dir() or any(folder.iterdir()))):
        raise InputError(f"{folder}: exists already; name another folder for the session")
    folder.parent.mkdir(parents=True, exist_ok=True)
    scratch = folder.with_name(f".{folder.name}.writing")
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir()
    try:
        yield scratch
        if folder.exists():
            folder.rmdir()
        scratch.rename(folder)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _write(folder: Path, session: SessionFiles) -> None:
    """Write the files of a session into a folder, which is made if it does not exist."""
    folder.mkdir(exist_ok=True)
    head = {"format": SESSION_FORMAT, "name": session.name, "length_unit": session.length_unit, "mount": session.mount}
    (folder / "session.toml").write_text(tomli_w.dumps({**head, **session.tables}), encoding="utf-8")
    for name, text in session.texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    for file in session.copies:
        shutil.copyfile(file, folder / file.name)
    for name, cloud in session.clouds.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_ply(folder / name, cloud, "<f8" if session.exact else "<f4")
    for name, table in (("views.csv", session.views), ("points.csv", session.points), ("frames.csv", session.frames)):
        if table is not None:
            write_table(folder / name, table, session.exact)
    if session.targets:
        xyz = np.array(list(session.targets.values()))
        write_table(folder / "targets.csv", {"target": list(session.targets), **dict(zip("xyz", xyz.T, strict=True))})


def write_ply(path: Path, cloud: Cloud, scalar: str = "<f4") -> None:
    """Write one scan as binary PLY: points and normals in double precision, scalars in that of `scalar`.

    Args:
        scalar: NumPy type of each scalar, "<f4" or "<f8".
    """
    # Single precision would round to 30 nm at half a metre: all results depend on the points.
    columns = dict(zip("xyz", cloud.points.T, strict=True))
    if cloud.normals is not None:
        columns |= dict(zip(("nx", "ny", "nz"), cloud.normals.T, strict=True))
    layout = [(axis, "<f8") for axis in columns] + [(name, scalar) for name in cloud.scalars]
    vertex = np.empty(len(cloud.points), layout)
    for name, values in (columns | cloud.scalars).items():
        vertex[name] = values
    ply_file.write_ply(path, {"vertex": vertex})


def write_table(file: Path, columns: TableColumns, exact: bool = False) -> None:
    """Write one table of a session."""
    file.write_text(table_text(columns, exact), encoding="utf-8", newline="")


def table_text(columns: TableColumns, exact: bool = False) -> str:
    """Return a table as CSV; floats with 12 digits.

    Args:
        columns: values by name, all columns equally long.
        exact: floats with all digits, so that they read back unchanged; one that is not finite is an empty cell.
    """

    def cell(value: object) -> object:
        if not isinstance(value, float):
            return value
        if not exact:
            return f"{value:.12g}"
        return repr(float(value)) if math.isfinite(value) else ""

    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(map(cell, row) for row in zip(*columns.values(), strict=True))
    return out.getvalue()


def dh_rows(robot: Robot) -> list[dict[str, Any]] | None:
    """Return the Denavit-Hartenberg rows of [robot] in session.toml, one a joint: angles in degrees, length_unit, kg.

    None for a robot that was read from a URDF, which has no such rows.
    """
    if robot.a is None or robot.alpha is None or robot.d is None:
        return None
    rows = []
    for i in range(robot.n_joints):
        row: dict[str, Any] = {
            "a": float(robot.a[i]),
            "alpha_deg": float(np.degrees(robot.alpha[i])),
            "d": float(robot.d[i]),
            "theta_deg": float(np.degrees(robot.theta[i])),
        }
        if robot.mass[i]:
            row |= {"mass": float(robot.mass[i]), "com": robot.com[i].tolist()}
        rows.append(row)
    return rows


def robot_toml(robot: Robot, comments: Sequence[str] = (), stated: StatedRepeatability | None = None) -> str | None:
    """Return the [robot] table of session.toml as text; None for a robot that was read from a URDF.

    Args:
        comments: lines above the table.
        stated: repeatability of the robot, which the table states too; None: it does not.
    """
    rows = dh_rows(robot)
    if rows is None:
        return None
    table: dict[str, Any] = {
        "name": robot.name,
        "dh": robot.convention,
        "gravity": robot.gravity.tolist(),
        "joints": rows,
    }
    # The column payload_kg of views.csv may state the mass; its centre is in this table all the same.
    if robot.payload_mass or not robot.carries_at_flange:
        table["payload"] = {"mass": robot.payload_mass, "com": robot.payload_com.tolist()}
    if stated is not None and (repeatability := repeatability_table(stated)):
        table["repeatability"] = repeatability
    return "".join(f"# {line}\n" for line in comments) + tomli_w.dumps({"robot": table})


def repeatability_table(stated: StatedRepeatability) -> dict[str, float]:
    """Return [robot] repeatability as session.toml writes it: length_unit, mrad; {} where nothing is stated."""
    turn = None if stated.rotation is None else 1e3 * stated.rotation
    return {key: x for key, x in (("position", stated.position), ("rotation_mrad", turn)) if x is not None}
