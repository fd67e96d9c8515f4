"""A session folder on disk -> `Session`; every check of input is made here or in the readers it calls."""

from difflib import get_close_matches
from pathlib import Path
from typing import Any, get_args

import numpy as np

from stitch import frames
from stitch.errors import InputError
from stitch.frames import Array
from stitch.reading.clouds import read_cloud
from stitch.reading.frames_csv import read_frames
from stitch.reading.plausible import check_scale
from stitch.reading.points_csv import Nominal, Sighting, read_points, read_targets
from stitch.reading.toml_file import read_toml
from stitch.reading.urdf import robot_from_urdf
from stitch.reading.views_csv import Row, read_views
from stitch.robot import METRES, Robot, robot_from_dh
from stitch.session import Mount, Scanner, Session, View

FORMAT = "stitch-session/1"

_KEYS = {
    "": {"format", "name", "length_unit", "cloud_unit", "mount", "scanner", "robot", "sphere", "part"},
    "scanner": {"pose", "noise", "standoff", "optical_axis"},
    "robot": {"name", "dh", "joints", "urdf", "base_link", "flange_link", "payload", "gravity"},
    "sphere": {"radius"},
    "part": {"cad", "cad_unit"},
}
_AXES = {sign + axis: s * np.eye(3)[i] for i, axis in enumerate("xyz") for sign, s in (("+", 1.0), ("-", -1.0))}


def load_session(path: Path | str) -> Session:
    """Read and check a session folder.

    Raises:
        InputError: anything missing, contradictory or implausible; names file, line or view, and the mend.
    """
    path = Path(path)
    file = path / "session.toml"
    document = _parse(file)
    unit = _choice(file, document, "length_unit", tuple(METRES))
    mount = _choice(file, document, "mount", get_args(Mount))
    robot = _robot(file, document.get("robot"), unit)
    rows = read_views(path / "views.csv", robot)
    cloud_unit = _choice(file, {"cloud_unit": unit} | document, "cloud_unit", tuple(METRES))
    sightings = _sightings(path, [row.name for row in rows])
    views = _views(path, rows, METRES[cloud_unit] / METRES[unit], sightings)
    part, sphere = document.get("part", {}), document.get("sphere", {})
    cad = path / part["cad"] if "cad" in part else None
    if cad is not None and not cad.is_file():
        raise InputError(f"{file}: part.cad names {cad}, which does not exist")
    session = Session(
        path, str(document.get("name", path.name)), unit, mount,  # type: ignore[arg-type]
        _scanner(file, document.get("scanner", {})), robot, _positive(file, sphere, "sphere", "radius"),
        cad, part.get("cad_unit"), views, nominal=_nominal(path, sightings),
    )  # fmt: skip
    check_scale(session, cloud_unit)
    return session


def _parse(file: Path) -> dict[str, Any]:
    document = read_toml(file, "a session is a folder with session.toml and views.csv")
    if document.get("format") != FORMAT:
        raise InputError(f'{file}: format is {document.get("format")!r}; expected "{FORMAT}"')
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


def _choice(file: Path, table: dict[str, Any], key: str, allowed: tuple[str, ...]) -> str:
    value = table.get(key)
    if value not in allowed:
        raise InputError(f"{file}: {key} is {value!r}; use {' or '.join(repr(a) for a in allowed)}")
    return str(value)


def _positive(file: Path, table: dict[str, Any], name: str, key: str) -> float | None:
    value = table.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < np.inf:
        raise InputError(f"{file}: {name}.{key} is {value!r}; use a positive number")
    return float(value)


def _scanner(file: Path, table: dict[str, Any]) -> Scanner:
    axis = table.get("optical_axis", "+z")
    if axis not in _AXES:
        raise InputError(f"{file}: scanner.optical_axis is {axis!r}; use one of {', '.join(_AXES)}")
    T_mount = None
    if "pose" in table:
        T_mount = _pose(file, table["pose"])
    noise, standoff = (_positive(file, table, "scanner", key) for key in ("noise", "standoff"))
    return Scanner(T_mount, noise, standoff, _AXES[axis])


def _pose(file: Path, value: Any) -> Array:
    try:
        T = np.array(value, float)
    except (TypeError, ValueError):
        T = np.empty(0)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise InputError(f"{file}: scanner.pose must be four rows of four numbers")
    off = float(np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max())
    if off > 1e-3 or np.linalg.det(T[:3, :3]) < 0 or np.abs(T[3] - [0, 0, 0, 1]).max() > 1e-9:
        raise InputError(
            f"{file}: scanner.pose is not a rigid motion (R·Rᵀ differs from 1 by {off:.2g}, "
            f"det {np.linalg.det(T[:3, :3]):+.3f}); write a rotation, and 0 0 0 1 in the last row"
        )
    return frames.make(frames.nearest_rotation(T[:3, :3]), T[:3, 3])


def _robot(file: Path, table: dict[str, Any] | None, unit: str) -> Robot | None:
    if not table:
        return None
    gravity = np.array(table.get("gravity", [0.0, 0.0, -9.81]), float)
    name, payload = str(table.get("name", "robot")), table.get("payload")
    if "urdf" in table:
        urdf = file.parent / table["urdf"]
        return robot_from_urdf(urdf, table.get("base_link"), table.get("flange_link"), unit, gravity, payload)
    if "joints" not in table:
        raise InputError(f"{file}: [robot] needs joints (DH rows) or urdf")
    try:
        return robot_from_dh(name, str(table.get("dh", "standard")), table["joints"], payload, gravity, unit)
    except InputError as error:
        raise InputError(f"{file}: {error}") from None
    except (TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{file}: robot.joints: {error}; every row is {{ a, alpha_deg, d, theta_deg }}") from None


def _sightings(path: Path, known: list[str]) -> dict[str, Sighting]:
    """By view, from points.csv or frames.csv."""
    points, frames_file = path / "points.csv", path / "frames.csv"
    if points.is_file() and frames_file.is_file():
        raise InputError(f"{path}: has points.csv and frames.csv; keep one of them: a session has one kind of target")
    if points.is_file():
        return read_points(points, known)
    if not frames_file.is_file():
        return {}
    measured = read_frames(frames_file, known)
    unknown = np.full(len(measured.views), np.nan)
    sigma = unknown if measured.sigma is None else measured.sigma
    turn = unknown if measured.sigma_rotation is None else measured.sigma_rotation
    return {
        view: Sighting(("probe",), T[None, :3, 3], sigma[v : v + 1], T[:3, :3], float(turn[v]))
        for v, (view, T) in enumerate(zip(measured.views, measured.T_sensor_probe, strict=True))
    }


def _nominal(path: Path, sightings: dict[str, Sighting]) -> Nominal | None:
    file = path / "targets.csv"
    if not file.is_file():
        return None
    if not (path / "points.csv").is_file():
        raise InputError(f"{file}: there is no points.csv that names its targets; write it, or remove targets.csv")
    return read_targets(file, sorted({name for s in sightings.values() for name in s.targets}))


def _views(path: Path, rows: list[Row], scale: float, sightings: dict[str, Sighting]) -> tuple[View, ...]:
    views = []
    for row in rows:
        cloud = None
        if row.cloud:
            try:
                cloud = read_cloud(path / row.cloud, scale)
            except InputError as error:
                raise InputError(f"view {row.name} (views.csv line {row.line}): {error}") from None
        elif not sightings:
            raise InputError(
                f"{path / 'views.csv'} line {row.line}: view {row.name} names no cloud; fill the column "
                "cloud, or put points.csv or frames.csv beside it"
            )
        views.append(
            View(row.name, cloud, row.T_base_flange, row.joints, row.approach, row.time_s, row.covariates,
                 sightings.get(row.name))
        )  # fmt: skip
    return tuple(views)
