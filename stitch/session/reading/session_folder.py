"""A session folder on disk as `SessionData`, checked; and a hash that tells one measurement from another.

Every check of input is made here or in the readers called: session.toml, tables, scans, and whether the scale is right.
"""

import csv
import hashlib
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np

from stitch.errors import InputError, NothingMeasuredError
from stitch.numerics.frames import Array
from stitch.numerics.units import CLOUD_METRES, METRES
from stitch.session.axes import Axis
from stitch.session.axis_poses import place_stated_axes
from stitch.session.moving_scanner import deskew_session
from stitch.session.reading.clouds import read_cloud
from stitch.session.reading.csv_files import read_csv_rows
from stitch.session.reading.scale_checks import check_scale, require_near
from stitch.session.reading.session_toml import (
    cad_file,
    positive_number,
    read_axes,
    read_crop_box,
    read_repeatability,
    read_robot,
    read_scanner,
    read_session_document,
    session_name,
    usual_guesses,
)
from stitch.session.reading.target_tables import read_frames, read_points, read_targets
from stitch.session.reading.text_files import readable, require_file, table_choice
from stitch.session.reading.views_table import ViewRow, has_pose_columns, read_views, row_at
from stitch.session.session import Cloud, Mount, NominalTargets, Scanner, SessionData, Sighting, View
from stitch.session.thinning import MAX_POINTS, distinct_points, points_within, thin_cloud
from stitch.system.threads import parallel

TABLES = ("session.toml", "views.csv", "points.csv", "frames.csv", "targets.csv")
_BLOCK = 1 << 20
UNKNOWN = "–"
# Fewer points span no surface.
_FEWEST_POINTS = 3


@readable()
def load_session(
    path: Path | str,
    scans: bool = True,
    start: Array | None = None,
    at_most: int | None = MAX_POINTS,
    memory: float | None = None,
    only: str | None = None,
) -> SessionData:
    """Return the session of a folder, checked; lengths in its length_unit.

    Args:
        path: the folder.
        scans: False reads neither clouds nor labelled points, for questions about the arm alone.
        start: (n,) joint angles, rad, of a single view that stands in for the rows of views.csv; None: these count.
        at_most: points of a view that stay in memory, the others in their files until they are fused; None: all.
        memory: bytes for a run of the session; may allow fewer points than `at_most`; None: not limited.
        only: name of the single view that is read; None: all.

    Raises:
        InputError: anything missing, contradictory or implausible; names file, line or view, and how to fix it.
    """
    path = Path(path)
    file = path / "session.toml"
    document = read_session_document(file)
    unit = table_choice(file, document, "length_unit", tuple(METRES))
    mount = table_choice(file, document, "mount", get_args(Mount))
    cloud_unit = table_choice(file, {"cloud_unit": unit} | document, "cloud_unit", tuple(CLOUD_METRES))
    robot = read_robot(file, document.get("robot"), unit)
    scanner = read_scanner(file, document.get("scanner", {}))
    axes, has_poses = _read_axes(file, document.get("axis", []), mount)
    rows = read_views(path / "views.csv", robot, axes, unit) if start is None else [row_at(file, robot, start)]
    rows = [row for row in rows if only is None or row.view.name == only]
    within = read_crop_box(file, document.get("scanner", {}))
    views = [row.view for row in rows]
    if scans:
        in_memory = _points_in_memory(at_most, memory, len(rows), scanner)
        clouds = read_scans(path, rows, unit, cloud_unit, scanner, within=within, at_most=in_memory)
        views = _measured_views(path, rows, clouds)
    cad, cad_unit = cad_file(file, document.get("part", {}))
    session = SessionData(
        path=path,
        name=session_name(file, document),
        length_unit=unit,
        mount=mount,  # type: ignore[arg-type]
        scanner=scanner,
        robot=robot,
        sphere_radius=positive_number(file, document.get("sphere", {}), "sphere", "radius"),
        cad=cad,
        cad_unit=cad_unit,
        views=tuple(views),
        nominal=_read_nominal(path, views) if scans else None,
        repeatability=read_repeatability(file, document.get("robot")),
        usual=usual_guesses(file, document),
    )
    if axes:
        session = place_stated_axes(replace(session, has_poses=has_poses), axes)
    if scans:
        check_scale(session, cloud_unit)
    # One view alone says nothing of how the robot moved.
    return deskew_session(session) if scanner.moving and scans and only is None else session


def _read_axes(file: Path, tables: Any, mount: str) -> tuple[tuple[Axis, ...], bool]:
    """Return the external axes of [[axis]], and whether a robot moves beside them: views.csv has poses or joints.

    Args:
        file: session.toml; views.csv lies beside it.
        tables: entry `axis` of the document.
        mount: eye_to_hand or eye_in_hand.
    """
    has_poses = not tables or has_pose_columns(read_csv_rows(file.with_name("views.csv"))[0])
    return read_axes(file, tables, mount, has_poses), has_poses


def _points_in_memory(at_most: int | None, memory: float | None, views: int, scanner: Scanner) -> int | None:
    """Return how many points of a view stay in memory; None: all. Arguments as of `load_session`."""
    # How a moving scanner moved is found from all points of its scans, where there is room for them.
    most = None if scanner.moving else at_most
    return most if memory is None else min(most or MAX_POINTS, points_within(memory, views))


def _read_sightings(path: Path, known: Collection[str]) -> dict[str, Sighting]:
    """Return view -> its labelled points from points.csv, or its probe or board from frames.csv; empty without either.

    Args:
        known: names of the views of views.csv.

    Raises:
        InputError: both tables are there, or one cannot be read.
    """
    points = path / "points.csv"
    frames = path / "frames.csv"
    for optional in (points, frames, path / "targets.csv"):
        if optional.exists() or optional.is_symlink():
            require_file(optional, "write the table, or remove it")
    if points.is_file() and frames.is_file():
        raise InputError(f"{path}: has points.csv and frames.csv; keep one of them: a session has one kind of target")
    if points.is_file():
        return read_points(points, known)
    return read_frames(frames, known) if frames.is_file() else {}


def _measured_views(path: Path, rows: Sequence[ViewRow], clouds: Iterable[Cloud | None]) -> list[View]:
    """Return the views of rows with their clouds, and with their labelled points from points.csv or frames.csv.

    Args:
        path: the session's folder.
        clouds: the scan of each row; None: it has none.

    Raises:
        InputError: a table that cannot be read, or a view without a cloud in a session without labelled points.
    """
    sightings = _read_sightings(path, {row.view.name for row in rows})
    views = []
    for row, cloud in zip(rows, clouds, strict=True):
        if cloud is None and not sightings:
            raise InputError(
                f"{path / 'views.csv'} line {row.line}: view {row.view.name} names no cloud; fill the column "
                "cloud, or put points.csv or frames.csv beside it"
            )
        views.append(replace(row.view, cloud=cloud, sighting=sightings.get(row.view.name)))
    return views


def _read_nominal(path: Path, views: Sequence[View]) -> NominalTargets | None:
    """Return the nominal positions of targets.csv, part frame; None without that file.

    Raises:
        InputError: no points.csv beside it, or no target in common.
    """
    file = path / "targets.csv"
    if not file.is_file():
        return None
    if not (path / "points.csv").is_file():
        raise InputError(f"{file}: there is no points.csv that names its targets; write it, or remove targets.csv")
    sightings = (view.sighting for view in views if view.sighting is not None)
    return read_targets(file, sorted({name for sighting in sightings for name in sighting.targets}))


def read_scans(
    path: Path,
    rows: Sequence[ViewRow],
    length_unit: str,
    cloud_unit: str,
    scanner: Scanner,
    *,
    within: Array | None,
    at_most: int | None,
) -> Iterator[Cloud | None]:
    """Yield the scans of a session folder, in the order of its rows; None where a row names none. Read on all cores.

    Args:
        path: the folder; the rows' files are relative to it.
        length_unit: of the clouds that are returned.
        cloud_unit: of the files.
        within: (2, 3) lowest and highest corner of the box that counts, scanner frame, length_unit; None: all counts.
        at_most: points of a view that stay in memory; None: all.

    Raises:
        InputError: a file missing, broken, with too few points or in another unit; names the view and its line.
    """
    metres = METRES[length_unit]

    def scan_of(row: ViewRow) -> Cloud | None:
        """Return the checked cloud of a row of views.csv; None where it has no scan.

        Raises:
            InputError: names view and line.
        """
        if not row.cloud:
            return None
        file = path / row.cloud
        read = partial(_read_cropped, file, CLOUD_METRES[cloud_unit] / metres, within)
        try:
            return checked_scan(row.view.name, str(file), read, metres=metres, scanner=scanner, at_most=at_most)
        except InputError as error:
            kind = NothingMeasuredError if isinstance(error, NothingMeasuredError) else InputError
            raise kind(f"view {row.view.name} (views.csv line {row.line}): {error}") from None

    return parallel(scan_of, rows, "reading scans")


def _read_cropped(file: Path, scale: float, within: Array | None) -> Cloud:
    """Return the points of a scan file inside a box, lengths times `scale`.

    Args:
        scale: length_unit per unit of the file.
        within: (2, 3) lowest and highest corner, scanner frame, length_unit; None: all points.

    Raises:
        InputError: no point is inside.
    """
    cloud = read_cloud(file, scale)
    if within is None:
        return cloud
    inside = cloud.within(within)
    if not len(inside.points):
        middle = ", ".join(f"{x:.3g}" for x in np.median(cloud.points, axis=0))
        raise NothingMeasuredError(
            f"{file}: none of its {len(cloud.points)} points is in the box scanner.within of session.toml, their "
            f"middle lies at ({middle}); to fix: make the box larger, or leave this view out of views.csv"
        )
    return inside


def checked_scan(
    name: str, where: str, read: Callable[[], Cloud], *, metres: float, scanner: Scanner, at_most: int | None
) -> Cloud:
    """Return one scan, read and checked, with at most `at_most` of its points in memory; repeated points left out.

    Args:
        name: of the view.
        where: file, or name of the scan, for messages.
        read: returns the whole scan in length_unit; it is called again when the scan is fused.
        metres: in one length_unit.
        at_most: points that stay in memory; None: all.

    Raises:
        InputError: too few points, or one farther away than any sensor sees.
    """
    whole = read()
    cloud = distinct_points(whole)
    if len(cloud.points) < _FEWEST_POINTS:
        raise NothingMeasuredError(
            f"{where}: {len(cloud.points)} of at least {_FEWEST_POINTS} points; leave this view out of views.csv or "
            "scan it again"
        )
    # Looked at before some are taken: each of them will be fused.
    require_near(where, cloud.points * metres)
    if at_most is None:
        return cloud
    return thin_cloud(name, cloud, at_most, scanner, read if cloud is whole else lambda: distinct_points(read()))


def session_hash(session: SessionData) -> str:
    """Return the first 16 digits of SHA-256 over the session's tables and the clouds that they name, in this order.

    A dash where the session is not on disk any more. Of a joined session those of its parts, with + between them.
    """
    if session.parts:
        return "+".join(map(session_hash, session.parts))
    try:
        files = measured_files(session.path)
    except (OSError, ValueError, csv.Error):
        return UNKNOWN
    return content_hash(session.path, files)


def measured_files(folder: Path) -> list[Path]:
    """Return the tables of a session's folder and the clouds that they name.

    Raises:
        OSError, ValueError, csv.Error: views.csv cannot be read.
    """
    files = [folder / name for name in TABLES if (folder / name).is_file()]
    with open(folder / "views.csv", encoding="utf-8-sig", newline="") as file:
        rows = list(csv.DictReader(file, skipinitialspace=True))
    return files + [folder / row["cloud"].strip() for row in rows if row.get("cloud")]


def content_hash(folder: Path, files: Sequence[Path]) -> str:
    """Return the first 16 digits of SHA-256 over names and contents of files, in this order.

    A dash where one cannot be read, or is not inside the folder.
    """
    digest = hashlib.sha256()
    try:
        for path in files:
            digest.update(path.relative_to(folder).as_posix().encode() + b"\0")
            with open(path, "rb") as file:
                while block := file.read(_BLOCK):
                    digest.update(block)
    except (OSError, ValueError):
        return UNKNOWN
    return digest.hexdigest()[:16]
