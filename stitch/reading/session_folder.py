"""A session folder on disk -> `Session`; every check of input is made here or in the readers it calls."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, get_args

import numpy as np

from stitch.errors import InputError
from stitch.frames import Array
from stitch.measurement.cloud import Cloud
from stitch.measurement.labelled_points import NominalTargets, Sighting
from stitch.measurement.session import Mount, Scanner, Session, View
from stitch.measurement.thinning import MAX_POINTS, points_within
from stitch.reading import scanner_toml, session_toml
from stitch.reading.frames_csv import read_frames
from stitch.reading.plausible import check_scale
from stitch.reading.points_csv import read_points, read_targets
from stitch.reading.rights import readable
from stitch.reading.session_scans import read_scans
from stitch.reading.text_file import require_file
from stitch.reading.toml_file import table_choice
from stitch.reading.views_csv import ViewRow, read_views, row_at
from stitch.units import METRES


@readable()
def load_session(
    path: Path | str,
    scans: bool = True,
    start: Array | None = None,
    at_most: int | None = MAX_POINTS,
    memory: float | None = None,
) -> Session:
    """Read and check a session folder.

    Args:
        scans: False reads neither clouds nor labelled points, for questions about the arm alone.
        at_most: points of a view that stay in memory, the others in their files until they are fused; None: all.
        memory: bytes within which a run of the session has to stay; may be less than `at_most` asks for.
        start: (n,) rad: joint angles of the only view, where nobody has planned any and there is no views.csv.

    Raises:
        InputError: anything missing, contradictory or implausible; names file, line or view, and how to fix it.
    """
    path = Path(path)
    file = path / "session.toml"
    document = session_toml.read_session_document(file)
    unit = table_choice(file, document, "length_unit", tuple(METRES))
    mount = table_choice(file, document, "mount", get_args(Mount))
    robot = session_toml.read_robot(file, document.get("robot"), unit)
    rows = read_views(path / "views.csv", robot) if start is None else [row_at(file, robot, start)]
    cloud_unit = table_choice(file, {"cloud_unit": unit} | document, "cloud_unit", tuple(METRES))
    scanner = scanner_toml.read_scanner(file, document.get("scanner", {}))
    views = _read_session_views(path, document, rows, scanner, scans=scans, at_most=at_most, memory=memory)
    cad, cad_unit = session_toml.cad_file(file, document.get("part", {}))
    session = Session(
        path=path,
        name=session_toml.session_name(file, document),
        length_unit=unit,
        mount=mount,  # type: ignore[arg-type]
        scanner=scanner,
        robot=robot,
        sphere_radius=session_toml.positive_number(file, document.get("sphere", {}), "sphere", "radius"),
        cad=cad,
        cad_unit=cad_unit,
        views=views,
        nominal=_read_nominal(path, views),
        repeatability=session_toml.read_repeatability(file, document.get("robot")),
    )
    if scans:
        check_scale(session, cloud_unit)
    return session


def _read_sightings(path: Path, known: list[str]) -> dict[str, Sighting]:
    """By view, from points.csv or frames.csv."""
    points, frames_file = path / "points.csv", path / "frames.csv"
    for optional in (points, frames_file, path / "targets.csv"):
        if optional.exists() or optional.is_symlink():
            require_file(optional, "write the table, or remove it")
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


def _read_nominal(path: Path, views: tuple[View, ...]) -> NominalTargets | None:
    file = path / "targets.csv"
    if not file.is_file():
        return None
    if not (path / "points.csv").is_file():
        raise InputError(f"{file}: there is no points.csv that names its targets; write it, or remove targets.csv")
    seen = (view.sighting.targets for view in views if view.sighting is not None)
    return read_targets(file, sorted({name for names in seen for name in names}))


def _read_session_views(
    path: Path,
    document: dict[str, Any],
    rows: list[ViewRow],
    scanner: Scanner,
    *,
    scans: bool,
    at_most: int | None,
    memory: float | None,
) -> tuple[View, ...]:
    """The rows with what was seen."""
    sightings = _read_sightings(path, [row.name for row in rows]) if scans else {}
    if memory is not None:
        at_most = min(at_most or MAX_POINTS, points_within(memory, len(rows)))
    within = scanner_toml.read_crop_box(path / "session.toml", document.get("scanner", {}))
    unit = document["length_unit"]
    clouds: Iterable[Cloud | None] = [None] * len(rows)
    if scans:
        cloud_unit = document.get("cloud_unit", unit)
        clouds = read_scans(path, rows, unit, cloud_unit, scanner, within=within, at_most=at_most)
    views = []
    for row, cloud in zip(rows, clouds, strict=True):
        if scans and cloud is None and not sightings:
            raise InputError(
                f"{path / 'views.csv'} line {row.line}: view {row.name} names no cloud; fill the column "
                "cloud, or put points.csv or frames.csv beside it"
            )
        views.append(
            View(
                name=row.name,
                cloud=cloud,
                T_base_flange=row.T_base_flange,
                joints=row.joints,
                approach=row.approach,
                time_s=row.time_s,
                covariates=row.covariates,
                sighting=sightings.get(row.name),
            )
        )
    return tuple(views)
