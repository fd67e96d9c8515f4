"""A session folder on disk -> `Session`; every check of input is made here or in the readers it calls."""

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import get_args

import numpy as np

from stitch.errors import InputError
from stitch.frames import Array
from stitch.measurement.cloud import Cloud
from stitch.measurement.labelled_points import Nominal, Sighting
from stitch.measurement.session import Mount, Session, View
from stitch.measurement.thinning import ENOUGH, points_within, thinned_cloud
from stitch.reading import scanner_toml, session_toml
from stitch.reading.clouds import read_cloud
from stitch.reading.frames_csv import read_frames
from stitch.reading.plausible import check_scale, require_near
from stitch.reading.points_csv import read_points, read_targets
from stitch.reading.text_file import require_file
from stitch.reading.toml_file import choice
from stitch.reading.views_csv import Row, read_views, row_at
from stitch.system.threads import parallel
from stitch.units import METRES

# Fewer points span no surface.
_FEWEST = 3


def load_session(
    path: Path | str,
    scans: bool = True,
    start: Array | None = None,
    at_most: int | None = ENOUGH,
    memory: float | None = None,
) -> Session:
    """Read and check a session folder.

    Args:
        scans: False reads neither clouds nor labelled points, for questions about the arm alone.
        at_most: points of a view that stay in memory, the others in their files until they are fused; None: all.
        memory: bytes within which a run of the session has to stay; may be less than `at_most` asks for.
        start: (n,) rad: joint angles of the only view, where nobody has planned any and there is no views.csv.

    Raises:
        InputError: anything missing, contradictory or implausible; names file, line or view, and the mend.
    """
    path = Path(path)
    file = path / "session.toml"
    document = session_toml.document(file)
    unit = choice(file, document, "length_unit", tuple(METRES))
    mount = choice(file, document, "mount", get_args(Mount))
    robot = session_toml.robot(file, document.get("robot"), unit)
    rows = read_views(path / "views.csv", robot) if start is None else [row_at(file, robot, start)]
    cloud_unit = choice(file, {"cloud_unit": unit} | document, "cloud_unit", tuple(METRES))
    sightings = _sightings(path, [row.name for row in rows]) if scans else {}
    if memory is not None:
        at_most = min(at_most or ENOUGH, points_within(memory, len(rows)))
    within = scanner_toml.within(file, document.get("scanner", {}))
    cloud = partial(_read, scale=METRES[cloud_unit] / METRES[unit], within=within)
    read = partial(_cloud, path, read=cloud, metres=METRES[unit], at_most=at_most)
    clouds = parallel(read, rows, "reading scans") if scans else [None] * len(rows)
    views = _views(path, rows, clouds, sightings, scans)
    cad, cad_unit = session_toml.cad(file, document.get("part", {}))
    session = Session(
        path=path,
        name=session_toml.name_of(file, document),
        length_unit=unit,
        mount=mount,  # type: ignore[arg-type]
        scanner=scanner_toml.scanner(file, document.get("scanner", {})),
        robot=robot,
        sphere_radius=session_toml.positive(file, document.get("sphere", {}), "sphere", "radius"),
        cad=cad,
        cad_unit=cad_unit,
        views=views,
        nominal=_nominal(path, sightings),
        repeatability=session_toml.repeatability(file, document.get("robot")),
    )
    if scans:
        check_scale(session, cloud_unit)
    return session


def _sightings(path: Path, known: list[str]) -> dict[str, Sighting]:
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


def _nominal(path: Path, sightings: dict[str, Sighting]) -> Nominal | None:
    file = path / "targets.csv"
    if not file.is_file():
        return None
    if not (path / "points.csv").is_file():
        raise InputError(f"{file}: there is no points.csv that names its targets; write it, or remove targets.csv")
    return read_targets(file, sorted({name for s in sightings.values() for name in s.targets}))


def _views(
    path: Path, rows: list[Row], clouds: Iterable[Cloud | None], sightings: dict[str, Sighting], scans: bool
) -> tuple[View, ...]:
    """The rows with what was seen."""
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


def _cloud(path: Path, row: Row, read: Callable[[Path], Cloud], metres: float, at_most: int | None) -> Cloud | None:
    if not row.cloud:
        return None
    file = path / row.cloud
    try:
        cloud = read(file)
        if len(cloud.points) < _FEWEST:
            raise InputError(
                f"{file}: {len(cloud.points)} of at least {_FEWEST} points; leave this view out of views.csv or scan "
                "it again"
            )
        # Looked at before some are taken: each of them will be fused.
        require_near(str(file), cloud.points * metres)
    except InputError as error:
        raise InputError(f"view {row.name} (views.csv line {row.line}): {error}") from None
    return cloud if at_most is None else thinned_cloud(row.name, cloud, at_most, partial(read, file))


def _read(file: Path, scale: float, within: Array | None) -> Cloud:
    """A scan in length_unit, what counts of it."""
    cloud = read_cloud(file, scale)
    if within is None:
        return cloud
    inside = cloud.within(within)
    if not len(inside.points):
        raise InputError(f"{file}: none of its {len(cloud.points)} points is in the box scanner.within of session.toml")
    return inside
