"""FEATURES.toml: what is to be measured, in the frame of the part, with nominal values, tolerances and calibrations."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from stitch.errors import InputError, did_you_mean
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.units import METRES
from stitch.plugins.metrology.features import NUMBERS, Feature, nearest_on_mesh
from stitch.session.reading.text_files import read_toml, reason_of, require_known_keys, shortened

# Points count within so many spacings of the nominal surface, and a patch is so wide, where nobody says so.
_WITHIN = 10.0
_PATCH = 15.0
_TOP = ("length_unit", "frame", "datum", "cad", "feature", "contribution", "limits")
_COMMON = ("name", "kind", "tolerance", "calibrated", "U")
_KEYS = {
    "point": ("at", "normal", "radius", "within"),
    "deviation": ("at", "radius", "within"),
    "plane": ("at", "normal", "radius", "within"),
    "sphere": ("at", "diameter", "within"),
    "cylinder": ("at", "axis", "diameter", "length", "within"),
    "circle": ("at", "axis", "diameter", "within"),
    "distance": ("between", "nominal"),
}
# A part moves in six directions.
_DATUM = 6
_PLACED = {kind for kind in NUMBERS if kind != "distance"}


@dataclass(frozen=True)
class Contribution:
    """Something that may be wrong which the run does not show, as a person states it: one sigma."""

    source: str
    relative: float = 0.0  # of distances and diameters, together
    length: float = 0.0  # of every number by itself, length_unit
    degrees: float = np.inf  # of freedom


@dataclass(frozen=True)
class FeatureList:
    """Features in the reference frame and unit of a run."""

    features: tuple[Feature, ...]
    contributions: tuple[Contribution, ...] = ()
    limits: dict[str, float] | None = None  # largest permissible errors of a verification: form, size, distance, place
    datum: tuple[str, ...] = ()  # six numbers that are nominal in the part's frame; empty: the run's reference frame


def read_features(file: Path, length_unit: str, spacing: float) -> FeatureList:
    """Read what is to be measured.

    Args:
        length_unit: of the run; the file may state another.
        spacing: of the run's points, length_unit.

    Raises:
        InputError: the file is missing or malformed, a key is unknown, or a feature lacks what it needs.
    """
    document = read_toml(file, "write one with a [[feature]] for each thing to measure: see docs/measure.md")
    require_known_keys(str(file), document, _TOP)
    unit = document.get("length_unit", length_unit)
    if unit not in METRES:
        raise InputError(f"{file}: length_unit is {shortened(unit)}; to fix: write {' or '.join(METRES)}")
    reader = _Reader(file, METRES[unit] / METRES[length_unit], spacing, document)
    rows = document.get("feature", [])
    if not isinstance(rows, list) or not rows:
        raise InputError(f"{file}: asks for nothing; to fix: write a table [[feature]] for each thing to measure")
    features = tuple(reader.feature(i, row) for i, row in enumerate(rows))
    names = [feature.name for feature in features]
    if len(set(names)) < len(names):
        raise InputError(f"{file}: two features are named {max(names, key=names.count)!r}; to fix: name each once")
    known = {f.name for f in features if f.kind in _PLACED - {"deviation"}}
    for feature in features:
        if feature.kind == "distance" and not set(feature.between) <= known:
            raise InputError(
                f"{file}: {feature.name}: between is {list(feature.between)}; to fix: name two points, planes, "
                "spheres, cylinders or circles of this file"
            )
    contributions = tuple(reader.contribution(i, row) for i, row in enumerate(document.get("contribution", [])))
    return FeatureList(features, contributions, reader.limits(), reader.datum(features))


def feature_list(
    features: Sequence[Feature] | FeatureList | Path | str, length_unit: str, spacing: float
) -> FeatureList:
    """Return features of a program, or those of a file, as they are measured: with their reach, and unit directions.

    Raises:
        InputError: as of `read_features`; or none, a kind that is not known, or two of one name.
    """
    if isinstance(features, FeatureList):
        return features
    if isinstance(features, str | Path):
        return read_features(Path(features), length_unit, spacing)
    odd = next((f for f in features if f.kind not in NUMBERS), None)
    if odd is not None:
        close = did_you_mean(odd.kind, NUMBERS)
        raise InputError(f"{odd.name}: kind is {odd.kind!r}{close}; to fix: one of {', '.join(NUMBERS)}")
    names = [feature.name for feature in features]
    if not names or len(set(names)) < len(names):
        raise InputError("features: none, or two of one name; to fix: pass some, and name each once")
    return FeatureList(tuple(_completed(feature, spacing) for feature in features))


def _completed(feature: Feature, spacing: float) -> Feature:
    """Return a feature with a unit axis, and with the usual reach where nobody states one."""
    axis = np.asarray(feature.axis, float)
    is_patch = feature.kind in ("point", "plane", "deviation")
    return replace(
        feature,
        at=np.asarray(feature.at, float),
        axis=axis / np.linalg.norm(axis),
        within=feature.within or _WITHIN * spacing,
        radius=feature.radius or (_PATCH * spacing if is_patch else 0.0),
    )


@dataclass(frozen=True)
class _Reader:
    file: Path
    scale: float  # of the file's lengths into the run's unit
    spacing: float
    document: dict[str, Any]

    def feature(self, i: int, row: Any) -> Feature:
        """Return one feature in the reference frame."""
        where = f"{self.file}: feature {i + 1}"
        kind = row.get("kind") if isinstance(row, dict) else None
        if kind not in NUMBERS:
            raise InputError(f"{where}: kind is {shortened(kind)}; to fix: write one of {', '.join(NUMBERS)}")
        where = f"{self.file}: {row.get('name') or f'feature {i + 1}'}"
        require_known_keys(where, row, (*_COMMON, *_KEYS[kind]))
        name = row.get("name", f"{kind} {i + 1}")
        if not isinstance(name, str) or not name.isprintable():
            raise InputError(f"{where}: name is {shortened(name)}; to fix: write a word in quotes")
        lengths = {
            key: self.scale * float(self._numbers(where, row, key, ()))
            for key in ("nominal", "calibrated", "U")
            if key in row
        }
        stated = Feature(
            name,
            kind,
            tolerance=self._tolerance(where, row),
            nominal=lengths.get("nominal"),
            calibrated=lengths.get("calibrated"),
            calibrated_U=lengths.get("U", 0.0),
        )
        if kind == "distance":
            between = row.get("between")
            if not isinstance(between, list) or len(between) != 2 or between[0] == between[1]:
                raise InputError(f"{where}: between is {shortened(between)}; to fix: name two features")
            return replace(stated, between=(str(between[0]), str(between[1])))
        return self._placed(where, row, stated)

    def _placed(self, where: str, row: dict[str, Any], stated: Feature) -> Feature:
        """Return a feature with its place and size."""
        kind = stated.kind
        T = self.T_reference_part
        at = frames.transform(T, self.scale * self._numbers(where, row, "at", (3,))[None])[0]
        sizes = {
            key: self.scale * float(self._numbers(where, row, key, ())) if key in row else 0.0
            for key in ("radius", "within", "diameter", "length")
        }
        for key in ("diameter", "length"):
            if key in _KEYS[kind] and not sizes[key] > 0:
                raise InputError(f"{where}: {key} is {shortened(row.get(key))}; to fix: write a length above zero")
        cad = None
        axis = np.array([0.0, 0.0, 1.0])
        for direction in {"normal", "axis"} & set(_KEYS[kind]):
            axis = frames.rotate(T, self._numbers(where, row, direction, (3,))[None])[0]
            if not np.linalg.norm(axis) > 0:
                raise InputError(f"{where}: {direction} has no direction; to fix: write [x, y, z]")
        if kind == "deviation":
            cad = self.cad(where)
            places, normals = nearest_on_mesh(cad, at[None])
            at, axis = places[0], normals[0]
        radius = sizes["length"] / 2 if kind == "cylinder" else sizes["radius"]
        placed = replace(
            stated, at=at, axis=axis, size=sizes["diameter"], radius=radius, within=sizes["within"], cad=cad
        )
        return _completed(placed, self.spacing)

    @property
    def T_reference_part(self) -> Array:
        """(4, 4) in which the file's places are given; the reference frame itself where it says nothing."""
        frame = self.document.get("frame", {})
        require_known_keys(f"{self.file}: frame", frame, ("pose",))
        if "pose" not in frame:
            return np.eye(4)
        T = self._numbers(f"{self.file}: frame", frame, "pose", (4, 4))
        T[:3, 3] *= self.scale
        if not frames.is_rigid(T):
            raise InputError(f"{self.file}: frame.pose is no rigid motion; to fix: write T_reference_part, four rows")
        return T

    def cad(self, where: str) -> Any:
        """Return the mesh that deviations count from, reference frame."""
        name = self.document.get("cad")
        if not isinstance(name, str) or not (self.file.parent / name).is_file():
            raise InputError(
                f'{where}: cad is {shortened(name)}; to fix: write cad = "part.stl" at the top of the file'
            )
        try:
            mesh = trimesh.load_mesh(self.file.parent / name)
        except Exception as error:  # every reader of trimesh fails in its own way
            raise InputError(
                f"{self.file}: {name}: cannot be read ({reason_of(error)}); to fix: export it again"
            ) from None
        mesh.apply_scale(self.scale)
        return mesh.apply_transform(self.T_reference_part)

    def contribution(self, i: int, row: Any) -> Contribution:
        """Return something that a person says may be wrong."""
        where = f"{self.file}: contribution {i + 1}"
        require_known_keys(where, row, ("source", "relative", "length", "degrees"))
        numbers = {
            key: float(self._numbers(where, row, key, ())) for key in ("relative", "length", "degrees") if key in row
        }
        if not isinstance(row.get("source"), str) or min(numbers.values(), default=-1.0) < 0:
            raise InputError(f'{where}: to fix: write source = "…" and one sigma, relative = 1e-5 or length = 0.002')
        degrees = max(numbers.get("degrees", np.inf), 1.0)
        return Contribution(
            row["source"], numbers.get("relative", 0.0), self.scale * numbers.get("length", 0.0), degrees
        )

    def datum(self, features: Sequence[Feature]) -> tuple[str, ...]:
        """Return the six numbers that the part is aligned by; none where the file asks for no alignment."""
        if "datum" not in self.document:
            return ()
        numbers = self.document["datum"]
        known = {f"{f.name}.{quantity}" for f in features if f.kind in _PLACED for quantity in NUMBERS[f.kind]}
        if not isinstance(numbers, list) or not len(numbers) == len(known.intersection(map(str, numbers))) == _DATUM:
            raise InputError(
                f"{self.file}: datum is {shortened(numbers)}; to fix: name six numbers of points, planes, spheres, "
                'cylinders or circles, as "face.offset" or "ball 1.x"'
            )
        return tuple(numbers)

    def limits(self) -> dict[str, float] | None:
        """Return the largest permissible errors of a verification."""
        table = self.document.get("limits")
        if table is None:
            return None
        where = f"{self.file}: limits"
        require_known_keys(where, table, ("form", "size", "distance", "place"))
        return {key: self.scale * float(self._numbers(where, table, key, ())) for key in table}

    def _tolerance(self, where: str, row: dict[str, Any]) -> tuple[float, float] | None:
        value = row.get("tolerance")
        if value is None:
            return None
        shape = (2,) if isinstance(value, list) else ()
        numbers = self.scale * self._numbers(where, row, "tolerance", shape)
        low, high = map(float, numbers if shape else (-abs(numbers), abs(numbers)))
        if not low < high:
            raise InputError(f"{where}: tolerance is {shortened(value)}; to fix: write one number, or [lower, upper]")
        return low, high

    def _numbers(self, where: str, row: dict[str, Any], key: str, shape: tuple[int, ...]) -> Array:
        try:
            numbers = np.array(row[key], float)
        except (KeyError, TypeError, ValueError, OverflowError):
            numbers = np.full(shape or (1,), np.nan)
        if numbers.shape != shape or not np.isfinite(numbers).all():
            form = {(): "a number", (3,): "[x, y, z]", (2,): "[lower, upper]", (4, 4): "four rows of four"}[shape]
            raise InputError(f"{where}: {key} is {shortened(row.get(key))}; to fix: write {form}")
        return numbers
