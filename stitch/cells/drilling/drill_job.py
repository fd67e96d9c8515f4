"""A drilling job on disk (TOML and CSV) -> `Job`; every check of the input is made here."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stitch.cells.csv_table import CsvColumns, read_columns, require_unique
from stitch.cells.drilling.camera_model import HoleObservations
from stitch.cells.job_toml import choice, finite, read_job_file, resolve_file, vectors
from stitch.cells.pose_table import POSE_COLUMNS, poses_from_columns
from stitch.errors import InputError
from stitch.frames import Array
from stitch.units import METRES

DRILL_FORMAT = "stitch-drill/1"
_FILES = {"plate", "holes", "placed", "rangers", "joint1", "joint6", "checks"}
_KEYS = {"format", "length_unit", "height", "image_size", *_FILES}
# Cosine of the largest angle between tool and hole that a small error explains.
_ALONG = float(np.cos(np.radians(30)))
_NEEDED = ("plate", "holes", "placed")


@dataclass(frozen=True)
class Hole:
    """One hole as the part's drawing puts it in the base frame."""

    name: str
    group: str
    reference: bool
    position: Array  # (3,)
    direction: Array  # (3,) unit vector into the part


@dataclass(frozen=True)
class PlacedTool:
    """Where the servo loop ended on a reference hole, and what the camera and the rangers saw there."""

    T_base_tool: Array  # (4, 4) reported
    uv: Array  # (2,) pixels
    height: float  # of the hole along the flange's z, h' of the source


@dataclass(frozen=True)
class DrillJob:
    """Everything of one drilling job. Lengths in length_unit."""

    length_unit: str
    height: float
    plate_xyz: Array  # (N, 3) flange frame
    plate_uv: Array  # (N, 2)
    holes: tuple[Hole, ...]
    placed: dict[str, PlacedTool]  # by the reference hole
    rangers: dict[str, tuple[Array, Array]]  # planes (M, 4), readings (M,)
    marker_paths: tuple[Array, Array] | None  # joint 6, joint 1, in the measuring system
    checks: HoleObservations | None  # plate and check holes together
    file: Path | None = None  # that was read


def read_drill_job(file: Path | str) -> DrillJob:
    """Read a job file and the tables it names, whose paths are relative to it.

    Raises:
        InputError: anything missing, unknown, contradictory or not a number; names the file, the place and what to do.
    """
    file = Path(file)
    document = read_job_file(file, DRILL_FORMAT, _KEYS, "examples/drilling/job.toml")
    paths = {key: resolve_file(file, key, document[key]) for key in _FILES if key in document}
    for key in _NEEDED:
        if key not in paths:
            raise InputError(f"{file}: {key} is missing; name the CSV file")
    plate = read_columns(paths["plate"], "", "x y z u v")
    holes = _read_holes(paths["holes"])
    return DrillJob(
        length_unit=choice(file, "length_unit", document.get("length_unit"), tuple(METRES)),
        height=finite(file, "height", document.get("height"), positive=True),
        plate_xyz=plate.stack("x y z"),
        plate_uv=plate.stack("u v"),
        holes=holes,
        placed=_read_placed_tools(paths["placed"], holes),
        rangers=_read_ranger_tables(paths.get("rangers")),
        marker_paths=_read_marker_paths(file, paths),
        checks=_read_check_holes(file, document, paths, plate),
        file=file,
    )


def _read_holes(file: Path) -> tuple[Hole, ...]:
    table = read_columns(file, "hole group kind", "x y z i j k")
    positions, directions = table.stack("x y z"), table.stack("i j k")
    holes = []
    for row, (name, group, kind) in enumerate(zip(*(table.texts[c] for c in ("hole", "group", "kind")), strict=True)):
        size = np.linalg.norm(directions[row])
        if abs(size - 1) > 0.01:
            raise InputError(f"{file}: direction of hole {name} has length {size:.4f}; i, j, k must be a unit vector")
        if kind not in ("reference", "drill"):
            raise InputError(f"{file}: kind of hole {name} is {kind!r}; write reference or drill")
        holes.append(Hole(name, group, kind == "reference", positions[row], directions[row] / size))
    pairs = [(hole.name, hole.group) for hole in holes]
    for pair in pairs:
        if pairs.count(pair) > 1:
            raise InputError(f"{file}: hole {pair[0]} stands twice in group {pair[1]}; leave one of them out")
    return tuple(holes)


def _read_placed_tools(file: Path, holes: tuple[Hole, ...]) -> dict[str, PlacedTool]:
    table = read_columns(file, "hole", f"{POSE_COLUMNS} u v height")
    poses, names = poses_from_columns(table), table.texts["hole"]
    require_unique(file, "hole", names)
    for hole in holes:
        if hole.reference and hole.name not in names:
            raise InputError(f"{file}: reference hole {hole.name} is missing; add where the robot ended on it")
        if hole.reference and poses[names.index(hole.name), :3, 2] @ hole.direction < _ALONG:
            raise InputError(
                f"{file}: on hole {hole.name} the tool's z lies more than 30° off the hole's direction; directions "
                "point into the part, and a, b, c turn about z, y', x''"
            )
    seen = zip(names, poses, table.stack("u v"), table.numbers["height"].tolist(), strict=True)
    return {name: PlacedTool(T_base_tool, uv, height) for name, T_base_tool, uv, height in seen}


def _read_ranger_tables(file: Path | None) -> dict[str, tuple[Array, Array]]:
    if file is None:
        return {}
    table = read_columns(file, "ranger", "a b c d reading")
    planes, readings, names = table.stack("a b c d"), table.numbers["reading"], np.array(table.texts["ranger"])
    if (np.linalg.norm(planes[:, :3], axis=1) == 0).any():
        raise InputError(f"{file}: a plane has a = b = c = 0; write its normal there")
    return {str(name): (planes[names == name], readings[names == name]) for name in dict.fromkeys(names)}


def _read_marker_paths(file: Path, paths: dict[str, Path]) -> tuple[Array, Array] | None:
    if ("joint1" in paths) != ("joint6" in paths):
        raise InputError(f"{file}: joint1 and joint6 belong together; name both marker paths or neither")
    if "joint1" not in paths:
        return None
    return tuple(read_columns(paths[key], "", "x y z").stack("x y z") for key in ("joint6", "joint1"))  # type: ignore[return-value]


def _read_check_holes(
    file: Path, document: dict[str, Any], paths: dict[str, Path], plate: CsvColumns
) -> HoleObservations | None:
    """Holes of the plate and check holes together."""
    if "checks" not in paths:
        return None
    form = "[width, height] in pixels, which the checks need"
    size = vectors(file, "image_size", document.get("image_size"), (2,), form)
    width, height = (finite(file, "image_size", value, positive=True) for value in size.tolist())
    tables = plate, read_columns(paths["checks"], "", "x y z u v")
    return HoleObservations(
        xyz=np.vstack([table.stack("x y z") for table in tables]),
        uv=np.vstack([table.stack("u v") for table in tables]),
        on_plate=np.repeat([True, False], [table.rows for table in tables]),
        image_size=(width, height),
    )
