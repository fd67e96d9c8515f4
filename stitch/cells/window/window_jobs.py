"""Job files of `stitch fit` and `stitch seam` (TOML); every check of the input is made here."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from stitch import frames
from stitch.cells.csv_table import read_columns, require_unique
from stitch.cells.job_toml import check_keys, choice, finite, read_job_file, resolve_file, vectors
from stitch.cells.pose_table import POSE_COLUMNS, pose_from_table, poses_from_columns
from stitch.cells.window.allowance import AllowancePrior
from stitch.cells.window.cad import CadSurface, read_cad
from stitch.cells.window.joined_scans import (
    JoinedScans,
    PlacedScans,
    assemble_scans,
    read_placed_session,
    read_scan_table,
)
from stitch.cells.window.regions import Box, Regions
from stitch.cells.window.seam import Limits, Station
from stitch.errors import InputError
from stitch.frames import Array

FIT_FORMAT, SEAM_FORMAT = "stitch-fit/1", "stitch-seam/1"
_SCANS = {"scans", "session", "hand_eye"}
_FIT_KEYS = {"format", *_SCANS, "cad", "length_unit"}
_FIT_KEYS |= {"instances", "tolerance", "cell", "region", "nominal", "path", "coverage"}
_SEAM_KEYS = {"format", *_SCANS, "stations", "fit", "part", "limits", "pose_sigma"}


@dataclass(frozen=True)
class FitJob:
    """Scans onto one CAD model; lengths in the CAD's unit, `length_unit` where somebody says which that is."""

    placed: PlacedScans
    scan: JoinedScans  # the same as one cloud
    cad: CadSurface
    cad_file: Path
    instances: int
    tolerance: float
    cell: float
    regions: Regions
    coverage: float  # share of every expected region that must be seen
    T_base_part_nominal: Array | None  # (4, 4)
    path: tuple[list[str], Array] | None  # names and T_base_tool (N, 4, 4)
    file: Path | None = None  # that was read
    allowance_prior: AllowancePrior = field(default_factory=AllowancePrior)  # of the stock on the part
    length_unit: str | None = None


@dataclass(frozen=True)
class SeamJob:
    """Scans of a seam, where the part lies and where to measure; mm."""

    placed: PlacedScans
    scan: JoinedScans  # the same as one cloud
    T_base_part: Array  # (4, 4)
    stations: tuple[Station, ...]
    limits: Limits
    pose_sigma: float
    file: Path | None = None  # that was read


def read_fit_job(file: Path | str) -> FitJob:
    """Read and check a job of `stitch fit`.

    Raises:
        InputError: a file is missing or malformed; an entry is missing, unknown or impossible.
    """
    file = Path(file)
    document = read_job_file(file, FIT_FORMAT, _FIT_KEYS, "examples/window/fit.toml")
    nominal = pose_from_table(file, "nominal", document["nominal"]) if "nominal" in document else None
    if "path" in document and nominal is None:
        raise InputError(f"{file}: path needs [nominal]: the part's pose for which the path was programmed")
    path = None
    if "path" in document:
        rows = read_columns(resolve_file(file, "path", document["path"]), "name", POSE_COLUMNS)
        path = (rows.texts["name"], poses_from_columns(rows))
    instances = document.get("instances", 1)
    if not isinstance(instances, int) or isinstance(instances, bool) or instances < 1:
        raise InputError(f"{file}: instances is {instances!r}; write how many parts are in the scan, 1 or more")
    cad_file = resolve_file(file, "cad", document.get("cad"))
    cad, placed = read_cad(cad_file), _read_scans(file, document)
    unit = placed.length_unit if "session" in document else None  # else neither scans nor CAD name it
    if "length_unit" in document:
        unit = choice(file, "length_unit", document["length_unit"], (unit,) if unit else ("mm", "m"))
    return FitJob(
        placed=placed,
        scan=assemble_scans(placed),
        cad=cad,
        cad_file=cad_file,
        instances=instances,
        tolerance=finite(file, "tolerance", document.get("tolerance", 0.5), positive=True),
        cell=finite(file, "cell", document.get("cell", cad.size / 60), positive=True),
        regions=_read_regions(file, document.get("region", [])),
        coverage=finite(file, "coverage", document.get("coverage", 0.5)),
        T_base_part_nominal=nominal,
        path=path,
        file=file,
        length_unit=unit,
    )


def read_seam_job(file: Path | str) -> SeamJob:
    """Read and check a job of `stitch seam`.

    Raises:
        InputError: a file is missing or malformed; an entry is missing, unknown or impossible.
    """
    file = Path(file)
    document = read_job_file(file, SEAM_FORMAT, _SEAM_KEYS, "examples/window/seam.toml")
    if ("part" in document) == ("fit" in document):
        raise InputError(f"{file}: say where the part lies: either [part] with its pose, or fit = the fit.json of it")
    T_base_part = (
        pose_from_table(file, "part", document["part"]) if "part" in document else _fitted_pose(file, document["fit"])
    )
    limits = document.get("limits", {})
    check_keys(file, "limits", limits, set(Limits.__dataclass_fields__))
    values = {key: finite(file, f"limits.{key}", value, positive="tolerance" in key) for key, value in limits.items()}
    placed = _read_scans(file, document)
    return SeamJob(
        placed=placed,
        scan=assemble_scans(placed),
        T_base_part=T_base_part,
        stations=_read_stations(resolve_file(file, "stations", document.get("stations"))),
        limits=Limits(**values),
        pose_sigma=abs(finite(file, "pose_sigma", document.get("pose_sigma", 0.0))),
        file=file,
    )


def _read_scans(file: Path, document: dict[str, Any]) -> PlacedScans:
    """From a table of scanner poses, or from a session and a hand-eye."""
    if ("scans" in document) == ("session" in document):
        raise InputError(f"{file}: say where the scans are: scans = a table of them, or session = a session folder")
    if "scans" in document and "hand_eye" in document:
        raise InputError(f"{file}: hand_eye goes with session; the poses of a table of scans are the scanner's own")
    if "scans" in document:
        return read_scan_table(resolve_file(file, "scans", document["scans"]))
    if "hand_eye" not in document:
        raise InputError(f"{file}: session needs hand_eye = what `stitch calibrate sphere -o` wrote")
    return read_placed_session(*(resolve_file(file, key, document[key]) for key in ("session", "hand_eye")))


def _read_regions(file: Path, entries: Any) -> Regions:
    boxes: dict[str, list[Box]] = {"expected": [], "forbidden": []}
    if not isinstance(entries, list):
        raise InputError(f"{file}: region must be written as [[region]], one for each box")
    for i, entry in enumerate(entries):
        place = f"region[{i + 1}]"
        check_keys(file, place, entry, {"name", "kind", "low", "high"})
        kind = choice(file, f"{place}.kind", entry.get("kind"), tuple(boxes))
        form = "[x, y, z] in the part's frame"
        low, high = (vectors(file, f"{place}.{key}", entry.get(key), (3,), form) for key in ("low", "high"))
        if (low >= high).any():
            raise InputError(f"{file}: {place}.low must lie below its high in x, y and z; the box is empty")
        boxes[kind].append(Box(str(entry.get("name", place)), low, high))
    return Regions(tuple(boxes["expected"]), tuple(boxes["forbidden"]))


def _fitted_pose(job: Path, name: Any) -> Array:
    """T_base_part (4, 4) of the first part of a fit.json."""
    file = resolve_file(job, "fit", name)
    try:
        T = np.array(json.loads(file.read_text(encoding="utf-8"))["parts"][0]["T_base_part"], float)
    except FileNotFoundError:
        raise InputError(f"{file}: not found; run stitch fit with -o first, or give [part]") from None
    except (ValueError, KeyError, IndexError, TypeError):
        raise InputError(f"{file}: holds no parts[0].T_base_part; name the fit.json that stitch fit wrote") from None
    if not frames.is_rigid(T):
        raise InputError(f"{file}: parts[0].T_base_part is no rigid motion; run stitch fit again")
    return T


def _read_stations(file: Path) -> tuple[Station, ...]:
    columns = read_columns(file, "station", "x y z across_x across_y across_z out_x out_y out_z")
    names = columns.texts["station"]
    middle = columns.stack("x y z")
    across, out = columns.stack("across_x across_y across_z"), columns.stack("out_x out_y out_z")
    require_unique(file, "station", names)
    for i, name in enumerate(names):
        if np.linalg.norm(np.cross(across[i], out[i])) < 0.5 or abs(np.linalg.norm(out[i]) - 1) > 0.05:
            raise InputError(f"{file}: station {name}: across and out must be unit vectors at right angles")
    return tuple(Station(n, m, a, o) for n, m, a, o in zip(names, middle, across, out, strict=True))
