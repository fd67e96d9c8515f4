"""What was measured, from a folder or from arrays in memory, checked alike; and back into a folder."""

import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields, replace
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from stitch.errors import InputError, NoResultError, StitchError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.units import METRES
from stitch.output.session_files import (
    SessionFiles,
    TableColumns,
    pose_columns,
    repeatability_table,
    robot_toml,
    table_text,
    write_session,
)
from stitch.output.urdf_file import to_urdf
from stitch.screening.deep_check import refuse_whole
from stitch.session.axis_poses import axis_tables, place_stated_axes, reported_poses, require_readings
from stitch.session.reading import session_folder
from stitch.session.reading.arrays import cloud_of, per_view, poses_of, seconds_of, sighting_of
from stitch.session.reading.scale_checks import check_scale
from stitch.session.reading.session_folder import checked_scan
from stitch.session.reading.session_toml import TABLE_KEYS, read_axes, read_repeatability, read_robot, read_scanner
from stitch.session.reading.text_files import require_folder_name, require_known_keys, require_name, table_choice
from stitch.session.reading.views_table import require_covariate_name, require_same_pose
from stitch.session.robot import Robot, forward
from stitch.session.session import Cloud, Mount, Scanner, SessionData, StatedRepeatability, View
from stitch.session.thinning import MAX_POINTS
from stitch.system.threads import parallel
from stitch.system.values import same

LengthUnit = Literal["mm", "m"]
# Names of views that can be those of files.
_PLAIN = re.compile(r"[\w+-][\w.+-]*")
# No joint of an arm turns four times about itself, rad.
_MOST_TURN = 8 * np.pi
# Of what was written and read back: quaternions and degrees lose their last digits.
_ROUNDED = 1e-9


@dataclass(frozen=True, repr=False, eq=False)
class Session(SessionData):
    """The measured session: views with a scan each, their poses, the scanner and the robot.

    Lengths in `length_unit`, angles in rad. Scans lie in the scanner frame; a view's `T_base_flange` (4, 4) maps flange
    to base. `stitch.load_session` makes one of a folder, `stitch.Session.from_arrays` of arrays in memory.

    Example:
        >>> session = stitch.Session.from_arrays(clouds, poses, mount="eye_in_hand", name="bracket")
        >>> session
        Session('bracket', eye_in_hand, 5 views of clouds)
        >>> session.views[0].name, session.views[0].cloud.points.shape[1], session.views[0].T_base_flange.shape
        ('v000', 3, (4, 4))
    """

    @classmethod
    def from_arrays(
        cls,
        clouds: Sequence[Any] | Mapping[str, Any] | None,
        poses: Any,
        *,
        mount: Mount,
        joints: Any = None,
        robot: Robot | Mapping[str, Any] | Path | str | None = None,
        times: Any = None,
        covariates: Mapping[str, Any] | None = None,
        scanner: Scanner | Mapping[str, Any] | None = None,
        points: Sequence[Any] | None = None,
        axes: Sequence[Mapping[str, Any]] = (),
        unit: LengthUnit = "mm",
        cloud_unit: LengthUnit | None = None,
        name: str = "session",
        check: bool = True,
    ) -> "Session":
        """Return the session of scans and poses in memory, checked as `stitch init` and `stitch check` check a folder.

        The scans tell whether the poses are what they are said to be; a reading of them that brings the scans together
        where the stated one does not is refused, with the sentence of `stitch check --deep`. Scans of more than 39,000
        points are not copied: leave them as they are until the run has ended.

        Args:
            clouds: one scan a view, scanner frame: (N, 3) or (H, W, 3) arrays, mappings such as {"points": (N, 3),
                "normals": (N, 3), "colors": (N, 3), "intensity": (N,)}, `trimesh.PointCloud`, Open3D's PointCloud,
                legacy or of tensors, or (depth image or RGBD image, intrinsics). A mapping names the views. None for
                labelled points alone.
            poses: T_base_flange of every view: (V, 4, 4), scipy's RigidTransform, (Rotation, (V, 3)), or a list of
                one a view; rows of numbers, (V, 7), a DataFrame, as `stitch init` reads a table. None where joints and
                robot give them.
            mount: "eye_to_hand", scanner fixed and part on the flange, or "eye_in_hand", scanner on the flange.
            joints: (V, n) rad.
            robot: a `Robot`, the [robot] table of session.toml as a mapping, or the path of a URDF.
            times: (V,) s, not falling.
            covariates: by name (V,) numbers that errors may follow, such as scanner_temperature_c; NaN: not known.
            scanner: a `Scanner`, or the [scanner] table of session.toml as a mapping: pose (4, 4), noise, standoff.
            points: one mapping a view from a target's name to its place (3,), sensor frame, or None.
            axes: the [[axis]] tables of session.toml as mappings; `covariates` hold the readings (table_deg, E1_mm).
                Without poses and joints the axes alone move what is scanned.
            unit: "mm" or "m", of all lengths.
            cloud_unit: of the scans, where it is another.
            name: of the session, for messages and folders.
            check: False leaves the convention of the poses to the run, for views in their thousands.

        Raises:
            InputError: arrays that do not fit, sizes of another unit, or poses of another convention than stated.

        Example:
            >>> session = stitch.Session.from_arrays(clouds, poses, mount="eye_in_hand", unit="mm")
            >>> inverted = np.linalg.inv(poses)
            >>> try:
            ...     stitch.Session.from_arrays(clouds, inverted, mount="eye_in_hand")
            ... except stitch.InputError as error:
            ...     print(str(error)[:92])
            <session>: the poses contradict what was measured: inverse: the poses are T_flange_base, ...
        """
        cell = cls.empty(mount=mount, robot=robot, scanner=scanner, unit=unit, cloud_unit=cloud_unit, name=name)
        _require_kind("covariates", covariates, Mapping | None)
        _require_kind("clouds", clouds, Mapping | Sequence | np.ndarray | None)
        _require_kind("points", points, Sequence | np.ndarray | None)
        _require_kind("axes", axes, Sequence)
        _require_kind("check", check, bool)
        for k, table in enumerate(axes):
            _require_kind(f"axes, {k}", table, Mapping)
        with _errors_name_arguments(cell.path.name):
            names, scans = _views_of(clouds, poses, joints, points)
            has_poses = poses is not None or joints is not None or not axes
            poses = _read_tables(cell, poses, scans, cloud_unit or unit) if has_poses else poses
            T, q = _arm(cell, names, poses, joints) if has_poses else (np.tile(np.eye(4), (len(names), 1, 1)), None)
            read_scans = _clouds_of(cell, names, scans, points, cloud_unit or unit)
            session = replace(cell, views=_views(names, read_scans, points, T, q, times, covariates or {}))
            session = _with_axes(replace(session, has_poses=has_poses), axes)
            check_scale(session, cloud_unit or unit)
            # Conventions are tried of poses that axes do not change.
            if check and not axes:
                check_convention(session)
        return session

    @classmethod
    def empty(
        cls,
        *,
        mount: Mount,
        robot: Robot | Mapping[str, Any] | Path | str | None = None,
        scanner: Scanner | Mapping[str, Any] | None = None,
        unit: LengthUnit = "mm",
        cloud_unit: LengthUnit | None = None,
        name: str = "session",
    ) -> "Session":
        """Return a session without views, with what is stated of the cell; arguments as of `from_arrays`.

        Raises:
            InputError: as of `from_arrays`.

        Example:
            >>> stitch.Session.empty(mount="eye_in_hand", name="bracket").views
            ()
        """
        _require_kind("name", name, str)
        _require_kind("unit", unit, str)
        _require_kind("mount", mount, str)
        _require_kind("cloud_unit", cloud_unit, str | None)
        _require_kind("scanner", scanner, Scanner | Mapping | None)
        _require_kind("robot", robot, Robot | Mapping | Path | str | None)
        path = Path(f"<{require_folder_name('name', name)}>")
        # Checked as a session.toml with the same entries is.
        toml = path / "session.toml"
        repeatability = StatedRepeatability()
        with _errors_name_arguments(path.name):
            table_choice(toml, {"unit": unit}, "unit", tuple(METRES))
            table_choice(toml, {"cloud_unit": cloud_unit or unit}, "cloud_unit", tuple(METRES))
            table_choice(toml, {"mount": mount}, "mount", get_args(Mount))
            if not isinstance(scanner, Scanner):
                table = dict(scanner or {})
                # Files alone are cut, and moved point by point.
                known = [key for key in TABLE_KEYS["scanner"] if key not in ("within", "moving")]
                require_known_keys(toml, table, known, "scanner")
                scanner = read_scanner(toml, table)
            if robot is not None and not isinstance(robot, Robot):
                table = {"urdf": str(Path(robot).resolve())} if isinstance(robot, str | Path) else dict(robot)
                require_known_keys(toml, table, TABLE_KEYS["robot"], "robot")
                repeatability = read_repeatability(toml, table)
                robot = read_robot(toml, table, unit)
        return cls(
            path=path,
            name=name,
            length_unit=unit,
            mount=mount,
            scanner=scanner,
            robot=robot,
            sphere_radius=None,
            cad=None,
            cad_unit=None,
            views=(),
            repeatability=repeatability,
        )

    @property
    def in_memory(self) -> bool:
        """True if the session lies in no folder."""
        return not (self.path / "session.toml").is_file()

    def save(self, folder: Path | str) -> "Session":
        """Write the session into a new folder, whole or not at all, and return it with that folder as its path.

        `stitch run FOLDER` then does with it what `stitch.run(session)` does. Rotations are written as quaternions,
        whose last digit may differ.

        Raises:
            InputError: the folder exists and is not empty, or what it would hold reads back as another session.

        Example:
            >>> session.save(folder / "bracket").in_memory
            False
            >>> sorted(path.name for path in (folder / "bracket").iterdir())
            ['clouds', 'session.toml', 'views.csv']
        """
        folder = Path(folder)
        write_session(folder, _files_of(self), partial(_require_same, self))
        return replace(self, path=folder)


def load_session(
    path: Path | str,
    scans: bool = True,
    start: Array | None = None,
    at_most: int | None = MAX_POINTS,
    memory: float | None = None,
) -> Session:
    """Return the session of a folder, read and checked.

    Args:
        scans: False reads neither clouds nor labelled points, for questions about the arm alone.
        start: (n,) rad: joint angles of the only view of a folder without views.csv; no poses are planned there yet.
        at_most: number of points of a view that stay in memory; the others are read when they are fused. None: all.
        memory: bytes within which a run of the session has to stay; fewer points than `at_most` may follow from it.

    Raises:
        InputError: anything missing, contradictory or implausible; names file, line or view, and how to fix it.

    Example:
        >>> stitch.load_session(session_folder)
        Session('s', eye_in_hand, 5 views of clouds)
    """
    return public_session(session_folder.load_session(path, scans, start, at_most, memory))


def public_session(session: SessionData) -> Session:
    """Return a session as the public class `Session`, with the same values."""
    if isinstance(session, Session):
        return session
    return Session(**{f.name: getattr(session, f.name) for f in fields(SessionData)})


def _require_kind(argument: str, value: Any, kinds: Any) -> None:
    """Refuse the value of an argument that is of a wrong type.

    Args:
        argument: its name, for the message.
        kinds: a type, or a union of types such as `str | None`.

    Raises:
        InputError: names the argument, and the types that are allowed.
    """
    if not isinstance(value, kinds):
        words = " or ".join(kind.__name__ for kind in get_args(kinds) or (kinds,)).replace("NoneType", "None")
        raise InputError(f"{argument}: is of type {type(value).__name__}; to fix: pass {words}")


def _views_of(clouds: Any, poses: Any, joints: Any, points: Any) -> tuple[list[str], list[Any]]:
    """Return the names of V views, and of each its scan; None for each where there are labelled points alone.

    A mapping of clouds brings its names; otherwise they are v000, v001, …

    Raises:
        InputError: neither clouds nor labelled points.
    """
    if isinstance(clouds, Mapping):
        names = [require_name("clouds", str(key), "view") for key in clouds]
        return names, list(clouds.values())
    if clouds is None and points is None:
        raise InputError("clouds: none, and no labelled points; to fix: pass one of the two, one a view")
    scans = list(clouds) if clouds is not None else [None] * len(points)
    return [f"v{i:03d}" for i in range(len(scans))], scans


def _read_tables(cell: Session, poses: Any, scans: list[Any], cloud_unit: str) -> Any:
    """Return poses given as rows of numbers as (V, 4, 4), where an installed package reads such tables.

    Matrices and None are returned as they are; so is everything where no package offers `stitch.pose_tables`. The scans
    (their lengths in `cloud_unit`) let the reader tell which convention the rows follow.
    """
    # np.shape raises ValueError for lists of unequal lengths, which are no matrices.
    with suppress(ValueError):
        if poses is None or np.shape(poses)[1:] == (4, 4):
            return poses
    for reader in entry_points(group="stitch.pose_tables"):
        poses = reader.load()(poses, scans, cell.length_unit, cloud_unit, cell.mount)
    return poses


def _arm(cell: Session, names: list[str], poses: Any, joints: Any) -> tuple[Array, Array | None]:
    """Return T_base_flange (V, 4, 4) and joint angles (V, n) rad; None in place of the angles where none are given.

    Without poses the robot computes them from the angles; with both they have to agree.

    Raises:
        InputError: a wrong number of poses or angles, degrees in place of rad, or no poses and no robot.
    """
    count = len(names)
    robot = cell.robot
    q = None if joints is None else per_view(joints, count, "joints", 2)
    if q is not None and robot is not None and q.shape[1] != robot.n_joints:
        raise InputError(f"joints: {q.shape[1]} a view, the robot has {robot.n_joints}; to fix: pass one a joint")
    if q is not None and not np.isfinite(q).all():
        raise InputError("joints: some are not finite; to fix: leave those views out")
    if q is not None and np.abs(q).max(initial=0.0) > _MOST_TURN:
        raise InputError(f"joints: one is {np.abs(q).max():.3g} rad, many turns; to fix: pass rad, np.radians(degrees)")
    from_joints = None if q is None or robot is None else forward(robot, q)
    if poses is None:
        if from_joints is None:
            raise InputError("poses: none; to fix: pass them, or joints with the robot")
        return from_joints, q
    T = poses_of(poses, "poses")
    if len(T) != count:
        raise InputError(f"poses: {len(T)} for {count} views; to fix: pass one a view, in the same order")
    if from_joints is not None:
        for name, reported, computed in zip(names, T, from_joints, strict=True):
            require_same_pose(f"view {name}", reported, computed, METRES[cell.length_unit])
    return T, q


def _with_axes(session: Session, tables: Sequence[Mapping[str, Any]]) -> Session:
    """Return the session with the external axes that [[axis]] tables state; without tables as it is.

    The readings of an axis are a covariate of each view, in exactly one of the axis' possible columns.

    Raises:
        InputError: a view without a reading of an axis, or with two.
    """
    axes = read_axes(session.path / "session.toml", [dict(t) for t in tables], session.mount, session.has_poses)
    require_readings(session.views, axes, session.length_unit)
    return public_session(place_stated_axes(session, axes)) if axes else session


def _clouds_of(cell: Session, names: list[str], scans: list[Any], points: Any, cloud_unit: str) -> list[Cloud | None]:
    """Return the checked cloud of each view; None of one that shows labelled points alone.

    Args:
        cell: session without views, for its scanner and length unit.
        scans: V clouds, or None for each.
        points: V mappings of labelled points; None: there are none.
        cloud_unit: length unit of the clouds, "mm" or "m".

    Raises:
        InputError: a view without a scan, or another number of mappings than views.
    """
    if points is not None and len(points) != len(names):
        raise InputError(f"points: {len(points)} for {len(names)} views; to fix: pass one mapping a view, or None")
    empty = next((v for v, scan in enumerate(scans) if scan is None), None)
    if points is None and empty is not None:
        raise InputError(
            f"clouds: that of view {names[empty]}, index {empty}, is None; to fix: leave it out, or pass its points"
        )
    metres = METRES[cell.length_unit]
    scale = METRES[cloud_unit] / metres

    def cloud_of_view(v: int) -> Cloud | None:
        """Return the checked cloud of one view, None where it has no scan."""
        if scans[v] is None:
            return None
        where = f"view {names[v]}"
        read = partial(cloud_of, scans[v], where, scale)
        cloud = checked_scan(names[v], where, read, metres=metres, scanner=cell.scanner, at_most=MAX_POINTS)
        # A small scan is the session's own; a large one stays with whoever holds it.
        return replace(cloud, points=cloud.points.copy()) if cloud.points is scans[v] else cloud

    return list(parallel(cloud_of_view, range(len(names)), "reading scans"))


def _views(
    names: list[str],
    clouds: list[Cloud | None],
    points: Any,
    T: Array,
    q: Array | None,
    times: Any,
    covariates: Mapping[str, Any],
) -> tuple[View, ...]:
    """Return the views: what each shows, its pose, joint angles, directions of approach, time and covariates.

    Args:
        clouds: of each view; None: of one that shows labelled points alone.
        points: V mappings from a target's name to its place (3,) in the sensor frame; None: no labelled points.
        T: (V, 4, 4) T_base_flange, length_unit.
        q: (V, n) joint angles, rad; None: unknown, and the approach too.
        times: (V,) s that never decrease; None: unknown.
        covariates: by name (V,) numbers; one that is not finite is left out of its view.

    Raises:
        InputError: times that decrease or are not finite, or values of another number than views.
    """
    count = len(names)
    time = None if times is None else seconds_of(times, count, "times")
    if time is not None and not (np.isfinite(time).all() and (np.diff(time) >= 0).all()):
        raise InputError(
            "times: not finite, or a later view stands before an earlier one; to fix: sort the views by time"
        )
    columns = {
        require_covariate_name("covariates", str(name)): per_view(values, count, f"covariates {name}")
        for name, values in covariates.items()
    }
    # As in views.csv: the sign of the travel from the view before, 0 in the first view.
    approach = None if q is None else np.sign(np.diff(q, axis=0, prepend=q[:1]))
    return tuple(
        View(
            name=name,
            cloud=clouds[v],
            T_base_flange=T[v],
            joints=None if q is None else q[v],
            approach=None if approach is None else approach[v],
            time_s=None if time is None else float(time[v]),
            covariates={key: float(x[v]) for key, x in columns.items() if np.isfinite(x[v])},
            sighting=None if points is None else sighting_of(points[v], f"view {name}"),
        )
        for v, name in enumerate(names)
    )


def check_convention(session: Session) -> None:
    """Refuse poses that the scans contradict: inverted ones, or with another order of angles or axes.

    An installed package that searches conventions decides (entry-point group `stitch.pose_checks`). Where there is
    none, or it cannot tell, the deep check of `stitch check` does.

    Raises:
        InputError: another reading of the poses brings the scans together, or they lie in one frame already.
    """
    checks = entry_points(group="stitch.pose_checks")
    if session.has_clouds and any(check.load()(session) for check in checks):
        return
    # That nothing overlaps under any reading is for the run to say, which names the mistakes that it knows.
    with suppress(NoResultError):
        refuse_whole(session)


@contextmanager
def _errors_name_arguments(path: str) -> Iterator[None]:
    """Raise errors of the block again with names of arguments in place of those of files and keys.

    The checks are those of a session folder, whose messages name session.toml. `path` is the name of the session.
    """
    try:
        yield
    except StitchError as error:
        text = str(error)
        for in_file, as_argument in ((f"{path}/session.toml", path), (" in session.toml", ""), ("length_unit", "unit")):
            text = text.replace(in_file, as_argument)
        raise type(error)(text) from None


def _files_of(session: SessionData) -> SessionFiles:
    """Return what a session folder has to hold, for a session to be read back from it with every digit.

    Clouds are called after their views; where a name cannot be a file's, all are numbered.
    """
    plain = all(_PLAIN.fullmatch(name) for name in session.names)
    files = [f"clouds/{view.name if plain else f'v{i:03d}'}.ply" for i, view in enumerate(session.views)]
    clouds = {file: view.cloud for file, view in zip(files, session.views, strict=True) if view.cloud is not None}
    points, probes = _labelled_columns(session)
    tables, texts = _tables(session)
    nominal = session.nominal
    if nominal is not None:
        columns = {"target": nominal.targets, **dict(zip("xyz", nominal.points.T, strict=True))}
        texts["targets.csv"] = table_text(columns | _known("sigma", nominal.sigma), exact=True)
    return SessionFiles(
        name=session.name,
        length_unit=session.length_unit,
        mount=session.mount,
        views=_view_columns(session, files if clouds else None),
        tables=tables,
        clouds=_WholeClouds(clouds),
        points=points,
        frames=probes,
        copies=() if session.cad is None else (session.cad,),
        texts=texts,
        exact=True,
    )


class _WholeClouds(Mapping[str, Cloud]):
    """Clouds by file name, each read with all its points only when it is asked for: one is in memory at a time."""

    def __init__(self, clouds: dict[str, Cloud]) -> None:
        self.clouds = clouds

    def __getitem__(self, file: str) -> Cloud:
        cloud = self.clouds[file]
        return cloud if cloud.whole is None else cloud.whole.read()

    def __iter__(self) -> Iterator[str]:
        return iter(self.clouds)

    def __len__(self) -> int:
        return len(self.clouds)


def _view_columns(session: SessionData, files: list[str] | None) -> dict[str, Sequence[object] | Array]:
    """Return the columns of views.csv by name, V entries each; None or "" becomes an empty cell: not known.

    Angles in degrees, lengths in length_unit; poses are those that the robot reported, without external axes.

    Args:
        files: paths of the V scans inside the folder; None where no view has one.
    """
    views = session.views
    columns: dict[str, Sequence[object] | Array] = {"view": session.names}
    if files is not None:
        columns["cloud"] = [file if view.cloud else "" for file, view in zip(files, views, strict=True)]
    if any(view.time_s is not None for view in views):
        columns["time_s"] = [view.time_s for view in views]
    joints = range(next((len(view.joints) for view in views if view.joints is not None), 0))
    for i in joints:
        columns[f"j{i + 1}_deg"] = [None if v.joints is None else float(np.degrees(v.joints[i])) for v in views]
    if session.has_poses:
        columns |= pose_columns(reported_poses(session))
    for i in joints:
        columns[f"j{i + 1}_approach"] = [None if v.approach is None else f"{v.approach[i]:.0f}" for v in views]
    for name in dict.fromkeys(name for view in views for name in view.covariates):
        columns[name] = [view.covariates.get(name) for view in views]
    return columns


def _labelled_columns(session: SessionData) -> tuple[TableColumns | None, TableColumns | None]:
    """Return the columns of points.csv and those of frames.csv; at least one of the two is None.

    A view shows labelled points, (view, target, x, y, z), or one probe with its orientation (view and pose). Both lie
    in the sensor frame, length_unit. A probe of unknown orientation is written without a turn, its sigma_deg empty.
    """
    seen = {view.name: view.sighting for view in session.views if view.sighting is not None}
    if not seen:
        return None, None
    sigma = np.concatenate([sighting.sigma for sighting in seen.values()])
    if all(sighting.rotation is None for sighting in seen.values()):
        views = [name for name, sighting in seen.items() for _ in sighting.targets]
        targets = [target for sighting in seen.values() for target in sighting.targets]
        places = np.concatenate([sighting.points for sighting in seen.values()])
        columns = {"view": views, "target": targets, **dict(zip("xyz", places.T, strict=True))}
        return columns | _known("sigma", sigma), None
    rotations = [np.eye(3) if sighting.rotation is None else sighting.rotation for sighting in seen.values()]
    T = frames.make(np.array(rotations), np.array([sighting.points[0] for sighting in seen.values()]))
    turns = np.degrees([sighting.sigma_rotation for sighting in seen.values()])
    return None, {"view": list(seen), **pose_columns(T), "sigma": sigma, "sigma_deg": turns}


def _known(name: str, values: Array) -> dict[str, Array]:
    """Return a column; none where nobody knows any of its numbers."""
    return {name: values} if np.isfinite(values).any() else {}


def _tables(session: SessionData) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the tables of session.toml below its first keys, and texts of further files by name.

    An arm without Denavit-Hartenberg rows came from a URDF, and is written as one again.
    """
    stated = session.scanner
    scanner: dict[str, Any] = {"optical_axis": "-z" if stated.optical_axis[2] < 0 else "+z"}
    if stated.T_mount is not None and session.has_poses:
        scanner["pose"] = stated.T_mount.tolist()
    known = {"noise": stated.noise, "standoff": stated.standoff, "kind": stated.kind}
    scanner |= {key: value for key, value in known.items() if value is not None}
    tables: dict[str, Any] = {"scanner": scanner}
    texts: dict[str, str] = {}
    if session.robot is not None:
        table = robot_toml(session.robot)
        if table is None:
            texts["robot.urdf"] = to_urdf(session.robot)
            links = {"urdf": "robot.urdf", "base_link": "base_link", "flange_link": "flange"}
            tables["robot"] = {**links, "gravity": session.robot.gravity.tolist()}
        else:
            tables |= tomllib.loads(table)
    if repeatability := repeatability_table(session.repeatability):
        tables.setdefault("robot", {})["repeatability"] = repeatability
    if session.axes:
        tables["axis"] = axis_tables(session)
    if session.sphere_radius is not None:
        tables["sphere"] = {"radius": session.sphere_radius}
    if session.cad is not None:
        tables["part"] = {"cad": session.cad.name, "cad_unit": session.cad_unit or session.length_unit}
    return tables, texts


def _require_same(session: SessionData, folder: Path) -> None:
    """Refuse a folder that reads back as another session than the one that was written.

    Compared are names, poses, joints, times, covariates, labelled points and numbers of scanned points, to 1e-9.

    Raises:
        InputError: the folder cannot be read, or names the view and what differs.
    """
    try:
        reread = session_folder.load_session(folder)
    except InputError as error:
        text = str(error).replace(str(folder), session.name)
        raise InputError(f"it would not be read back: {text}") from None
    if reread.names != session.names:
        raise InputError(f"{session.name}: names of its views cannot be written; to fix: give them plain names")
    fields_of_view = {"pose": "T_base_flange", "joints": "joints", "time": "time_s", "covariates": "covariates"}
    fields_of_view["labelled points"] = "sighting"
    for view, copy in zip(session.views, reread.views, strict=True):
        lost = [what for what, f in fields_of_view.items() if not same(getattr(view, f), getattr(copy, f), _ROUNDED)]
        counts = [None if v.cloud is None else v.cloud.count for v in (view, copy)]
        lost += [] if counts[0] == counts[1] else ["scan"]
        if lost:
            raise InputError(
                f"{session.name}: the {lost[0]} of view {view.name} cannot be written; to fix: correct them"
            )
