"""The CSV files of a panel job, checked."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stitch import frames
from stitch.cells.csv_table import CsvColumns, read_columns
from stitch.cells.panel.global_model import ReflectorReadings
from stitch.cells.panel.laser_tracker import LaserTracker
from stitch.cells.panel.rigid_fit import rigid_fit
from stitch.cells.pose_table import POSE_COLUMNS, poses_from_columns
from stitch.errors import InputError, NoResultError
from stitch.frames import Array, Indices

# Twice a triangle's area against the sum of two squared sides: below, it is a line.
_FLAT = 1e-3


@dataclass(frozen=True)
class PanelPoints:
    """Targets on the panel and where the tracker sees them, mm."""

    names: list[str]
    nominal: Array  # (K, 3) panel frame
    measured: Array  # (K, 3) world frame
    clamp: Indices  # (K,) index of the robot; −1 where the file has none


def read_calibration(
    file: Path, names: tuple[str, ...], tracker: LaserTracker, T_world_tracker: Array
) -> tuple[ReflectorReadings, ...]:
    """Each robot's poses and reflectors; the tracker's readings brought into the world.

    Raises:
        InputError: a column or robot is missing, or reflectors lie on one line.
    """
    columns = read_columns(file, "robot", f"{POSE_COLUMNS} x1 y1 z1 x2 y2 z2 x3 y3 z3")
    poses, seen = poses_from_columns(columns), columns.stack("x1 y1 z1 x2 y2 z2 x3 y3 z3").reshape(-1, 3, 3)
    seen = frames.transform(T_world_tracker, seen)
    robot = np.array(columns.texts["robot"])
    require_known_robots(file, columns, names)
    sides = seen[:, 1:] - seen[:, :1]
    flat = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) < _FLAT * (sides**2).sum(axis=(1, 2))
    if flat.any():
        raise InputError(f"{file}: data row {np.argmax(flat) + 1}: the reflectors lie on one line; read them again")
    for name in names:
        if not (robot == name).any():
            raise InputError(f"{file}: robot {name} has no row; measure its poses, or leave it out of the job")
    return tuple(
        ReflectorReadings(n, poses[robot == n], seen[robot == n], tracker.sigma(seen[robot == n])) for n in names
    )


def read_per_robot(file: Path, names: tuple[str, ...], column_names: str) -> Array:
    """(N, k) one row of numbers for each robot, in the order of `names`.

    Raises:
        InputError: a column is missing, or a robot is missing, unknown or there twice.
    """
    columns = read_columns(file, "robot", column_names)
    require_known_robots(file, columns, names)
    listed = columns.texts["robot"]
    for name in names:
        if listed.count(name) != 1:
            raise InputError(f"{file}: robot {name} stands in {listed.count(name)} rows; give each robot one")
    return columns.stack(column_names)[[listed.index(name) for name in names]]


def read_panel_points(file: Path, robots: tuple[str, ...] | None, T_world_tracker: Array) -> PanelPoints:
    """Targets (robots None) or control points, which name the robot whose clamp they lie beside.

    Raises:
        InputError: a column is missing, a robot unknown or without a point.
    """
    columns = read_columns(file, "point robot" if robots else "point", "x y z seen_x seen_y seen_z")
    clamp = np.full(columns.rows, -1)
    if robots:
        require_known_robots(file, columns, robots)
        clamp = np.array([robots.index(name) for name in columns.texts["robot"]])
        for i, name in enumerate(robots):
            if not (clamp == i).any():
                raise InputError(f"{file}: robot {name} has no control point; measure one or more beside its clamp")
    seen = frames.transform(T_world_tracker, columns.stack("seen_x seen_y seen_z"))
    return PanelPoints(columns.texts["point"], columns.stack("x y z"), seen, clamp)


def read_world(file: Path, tracker: LaserTracker) -> Array:
    """T_world_tracker (4, 4) from reference points; the tracker sits at its own frame's origin.

    Raises:
        InputError: a column is missing, the points fix no frame, or one contradicts the others.
    """
    columns = read_columns(file, "point", "x y z seen_x seen_y seen_z")
    seen = columns.stack("seen_x seen_y seen_z")
    sigma = replace(tracker, position=np.zeros(3)).sigma(seen)
    try:
        found = rigid_fit(columns.stack("x y z"), seen, sigma)
    except NoResultError as error:
        raise InputError(f"{file}: {error}") from None
    worst = int(np.argmax(np.linalg.norm(found.residuals, axis=1)))
    # With few points much of an error hides in the fit; ten sigmas beyond it are no noise.
    if np.linalg.norm(found.residuals[worst]) > 10 * np.sqrt(3) * sigma[worst]:
        size = float(np.linalg.norm(found.residuals[worst]))
        raise InputError(
            f"{file}: point {columns.texts['point'][worst]} is {size:.3f} mm off the others; measure it anew"
        )
    return frames.inverse(found.T)


def require_known_robots(file: Path, columns: CsvColumns, names: tuple[str, ...]) -> None:
    """Refuse robots that the job does not name.

    Raises:
        InputError: an unknown name.
    """
    for name in columns.texts["robot"]:
        if name not in names:
            raise InputError(f"{file}: robot {name!r} is not in the job's robots {', '.join(names)}; correct its name")
