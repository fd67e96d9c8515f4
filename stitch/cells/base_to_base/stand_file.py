"""A stand file (TOML) -> `Stand`; every check of the input is made here."""

from pathlib import Path
from typing import Any

import numpy as np

from stitch.cells.base_to_base.stand import Stand, TouchedPoints, cylinder_covariance, cylinder_points, rail_direction
from stitch.cells.job_toml import check_keys, choice, finite, read_job_file, table, vectors
from stitch.errors import InputError
from stitch.frames import Array
from stitch.units import METRES

STAND_FORMAT = "stitch-base/1"
# Sigmas of a careful operator where the file states none: the source sees 0.1 to 0.2 mm as the smallest distance
# that an eye can tell, and calls its distance and angle sensors better than that.
_POINT, _SLIDE, _LENGTH, _ANGLE, _LEVEL = 1e-4, 1e-4, 1e-4, 1e-4, 1e-3

_KEYS = {"format", "length_unit", "angle_unit", "main", "second", "rod", "level"}
_TURN = {"clockwise": 1.0, "anticlockwise": -1.0}
_CYLINDER = ("joint1", "radius", "height")


def read_stand(file: Path | str) -> Stand:
    """Read and check a stand file.

    Raises:
        InputError: the file is missing, not TOML, or an entry is missing, unknown, not a number or impossible.
    """
    file = Path(file)
    document = read_job_file(file, STAND_FORMAT, _KEYS, "examples/base_to_base.toml")
    unit, to_rad = _units(file, document)
    main, second = table(file, document, "main"), table(file, document, "second")
    rail, rail_entries = _touched_points(file, "main", main, unit, to_rad)
    rod, rod_entries = _touched_points(file, "second", second, unit, to_rad)
    settings = table(file, document, "rod")
    check_keys(file, "rod", settings, {"turn", "sigma_slide", "sigma_angle", "sigma_length"})
    turn = choice(file, "rod.turn", settings.get("turn", "clockwise"), tuple(_TURN))
    level = document.get("level", {})
    check_keys(file, "level", level, {"stand", "second_base"})
    base = finite(file, "level.second_base", level["second_base"], positive=True) if "second_base" in level else None
    stand = Stand(
        length_unit=str(document["length_unit"]),
        rail=rail,
        rail_slide=_column(file, "main", rail_entries, "slide", optional=True),
        rod=rod,
        slide=_column(file, "second", rod_entries, "slide"),
        angle=_column(file, "second", rod_entries, "angle") * to_rad,
        length=_column(file, "second", rod_entries, "length", positive=True),
        turn=_TURN[turn],
        sigma_slide=_sigma(file, "rod", settings, "sigma_slide", _SLIDE / unit),
        sigma_angle=_sigma(file, "rod", settings, "sigma_angle", _ANGLE / to_rad) * to_rad,
        sigma_length=_sigma(file, "rod", settings, "sigma_length", _LENGTH / unit),
        sigma_level_stand=_sigma(file, "level", level, "stand", _LEVEL / to_rad) * to_rad,
        sigma_level_base=None if base is None else base * to_rad,
        file=file,
    )
    _check_geometry(file, stand)
    return stand


def _units(file: Path, document: dict[str, Any]) -> tuple[float, float]:
    """Metres per length unit and rad per angle unit."""
    length = choice(file, "length_unit", document.get("length_unit"), tuple(METRES))
    angle = choice(file, "angle_unit", document.get("angle_unit"), ("rad", "deg"))
    return METRES[length], 1.0 if angle == "rad" else float(np.pi / 180)


def _touched_points(
    file: Path, name: str, robot: dict[str, Any], unit: float, to_rad: float
) -> tuple[TouchedPoints, list[dict[str, Any]]]:
    """The points of one robot, from coordinates or from joint 1, radius and height."""
    check_keys(file, name, robot, {"points", "sigma"})
    entries = robot.get("points")
    if not isinstance(entries, list) or len(entries) < 2:
        raise InputError(f"{file}: [[{name}.points]] needs at least two entries")
    readings = {"slide"} if name == "main" else {"slide", "angle", "length"}
    sigma = robot.get("sigma", {})
    check_keys(file, f"{name}.sigma", sigma, {"point", *_CYLINDER})
    points: list[Array] = []
    covariances: list[Array] = []
    for i, entry in enumerate(entries):
        place = f"{name}.points[{i + 1}]"
        check_keys(file, place, entry, {"name", "point", *_CYLINDER, *readings})
        if "point" in entry:
            form = "three numbers [x, y, z] in the robot's base frame"
            points.append(vectors(file, f"{place}.point", entry["point"], (3,), form))
            covariances.append(np.eye(3) * _sigma(file, f"{name}.sigma", sigma, "point", _POINT / unit) ** 2)
            continue
        joint1, radius, height = (_entry(file, place, entry, key) for key in _CYLINDER)
        points.append(cylinder_points(np.array(joint1 * to_rad), np.array(radius), np.array(height)))
        default = sigma.get("point", _POINT / unit)
        spread = (
            _sigma(file, f"{name}.sigma", sigma, "joint1", default / radius / to_rad) * to_rad,
            _sigma(file, f"{name}.sigma", sigma, "radius", default),
            _sigma(file, f"{name}.sigma", sigma, "height", default),
        )
        covariances.append(cylinder_covariance(np.array(joint1 * to_rad), np.array(radius), spread))
    names = tuple(str(entry.get("name", f"{name} {i + 1}")) for i, entry in enumerate(entries))
    return TouchedPoints(names, np.array(points, float), np.array(covariances, float)), entries


def _entry(file: Path, place: str, entry: dict[str, Any], key: str) -> float:
    if key not in entry:
        raise InputError(f"{file}: {place}.{key} is missing; give point = [x, y, z] or joint1, radius and height")
    return finite(file, f"{place}.{key}", entry[key], positive=key == "radius")


def _column(
    file: Path, name: str, entries: list[dict[str, Any]], key: str, optional: bool = False, positive: bool = False
) -> Array:
    values = []
    for i, entry in enumerate(entries):
        place = f"{name}.points[{i + 1}].{key}"
        if key not in entry and not optional:
            raise InputError(f"{file}: {place} is missing; every point of the rod needs slide, angle and length")
        values.append(finite(file, place, entry[key], positive) if key in entry else np.nan)
    return np.array(values, float)


def _sigma(file: Path, place: str, entries: dict[str, Any], key: str, default: float) -> float:
    return finite(file, f"{place}.{key}", entries.get(key, default), positive=True)


def _check_geometry(file: Path, stand: Stand) -> None:
    """Points that leave the rail without a line, a zero or a level."""
    rail = stand.rail.points
    extent = float(np.linalg.norm(rail - rail.mean(axis=0), axis=1).max())
    if extent < 100 * np.sqrt(np.trace(stand.rail.covariance[0]) / 3):
        raise InputError(f"{file}: main.points lie within {2 * extent:.3g}; a rail's direction needs points far apart")
    if not np.isfinite(stand.rail_slide).any():
        raise InputError(f"{file}: no main point has a slide reading; write slide = 0 at the one that sets the zero")
    x = rail_direction(rail)
    read = stand.rail_slide[np.isfinite(stand.rail_slide)]
    if np.isnan(stand.rail_slide[-1]) or (np.diff(rail @ x) <= 0).any() or (np.diff(read) <= 0).any():
        raise InputError(
            f"{file}: main.points must be listed in the direction in which the slide grows, the last with its slide "
            "reading; reorder them, or correct a slide reading"
        )
    if abs(x[2]) > 0.9:
        raise InputError(f"{file}: the rail stands upright in the main base; it must lie, or the rod has no level")
