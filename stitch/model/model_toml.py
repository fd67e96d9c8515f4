"""The model of a cell: hand-eye and effects in use; `model.toml` is its form for people."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from stitch.errors import InputError
from stitch.frames import Array, is_rigid
from stitch.reading.toml_file import choice, read_toml, text
from stitch.units import METRES

FORMAT = "stitch-model/1"
_HEADER = """# The model of this cell. hand_eye.corrected is {frame}: it maps scanner
# coordinates into the {carrier} frame. sigma and covariance belong to a right perturbation
# T·exp(ξ), ξ = (rotation in rad, translation in {unit}), in the scanner frame.
"""


@dataclass(frozen=True)
class Fitted:
    """One parameter of an effect; sigma NaN where the views cannot see it (it stays at its value)."""

    value: float
    sigma: float
    unit: str


@dataclass(frozen=True)
class Target:
    """A labelled point in the reference frame, or a probe with its orientation."""

    position: Array  # (3,) length_unit
    sigma: Array  # (3,)
    orientation: Array | None = None  # (3, 3) R_reference_probe


@dataclass(frozen=True)
class Model:
    """Hand-eye (4, 4) in length_unit with its covariance, and the effects with their parameters."""

    length_unit: str
    mount: str  # eye_to_hand | eye_in_hand
    T_mount: Array  # (4, 4) T_base_scanner or T_flange_scanner
    T_mount_coarse: Array  # (4, 4)
    covariance: Array  # (6, 6)
    effects: dict[str, dict[str, Fitted]] = field(default_factory=dict)
    effects_file: str | None = None  # Python file with effects of the user's own
    targets: dict[str, Target] = field(default_factory=dict)  # of a session with labelled points


def write_model(model: Model, path: Path) -> None:
    """Write `model.toml`, commented, with all digits."""
    carrier = "base" if model.mount == "eye_to_hand" else "flange"
    document = {
        "format": FORMAT,
        "length_unit": model.length_unit,
        "mount": model.mount,
        "hand_eye": {
            "corrected": model.T_mount.tolist(),
            "coarse": model.T_mount_coarse.tolist(),
            "sigma": np.sqrt(np.diag(model.covariance)).tolist(),
            "covariance": model.covariance.tolist(),
        },
        "effects": {name: {p: _written(f) for p, f in fitted.items()} for name, fitted in model.effects.items()},
    }
    if model.targets:
        document["targets"] = {name: _told(target) for name, target in model.targets.items()}
    if model.effects_file:
        document["effects_file"] = model.effects_file
    header = _HEADER.format(frame=f"T_{carrier}_scanner", carrier=carrier, unit=model.length_unit)
    path.write_text(header + tomli_w.dumps(document), encoding="utf-8")


def read_model(path: Path) -> Model:
    """Read `model.toml`, or that of a run folder.

    Raises:
        InputError: the file is missing, not a model, or a value cannot be: a hand-eye that is not a rigid motion.
    """
    path = path / "model.toml" if path.is_dir() else path
    document = read_toml(path, "name a run folder that `stitch run` wrote")
    if document.get("format") != FORMAT:
        raise InputError(f'{path}: format is {document.get("format")!r}, expected "{FORMAT}"')
    hand_eye = document.get("hand_eye", {})
    corrected = _matrix(path, hand_eye, "corrected", 4)
    coarse = _matrix(path, hand_eye, "coarse", 4) if "coarse" in hand_eye else corrected
    for name, T in (("corrected", corrected), ("coarse", coarse)):
        if not is_rigid(T):
            raise InputError(f"{path}: hand_eye.{name} is not a rigid motion; its 3x3 part must be a rotation")
    covariance = _matrix(path, hand_eye, "covariance", 6) if "covariance" in hand_eye else np.zeros((6, 6))
    return Model(
        choice(path, document, "length_unit", tuple(METRES)), str(document.get("mount")), corrected, coarse, covariance,
        _effects(path, document.get("effects", {})), text(path, document, "", "effects_file"),
        _targets(path, document.get("targets", {})),
    )  # fmt: skip


def _told(target: Target) -> dict[str, Any]:
    told = {"position": target.position.tolist(), "sigma": target.sigma.tolist()}
    return told if target.orientation is None else told | {"orientation": target.orientation.tolist()}


def _targets(path: Path, table: Any) -> dict[str, Target]:
    out = {}
    try:
        for name, t in table.items():
            orientation = np.array(t["orientation"], float) if "orientation" in t else None
            out[str(name)] = Target(np.array(t["position"], float), np.array(t["sigma"], float), orientation)
            if out[name].position.shape != (3,) or (orientation is not None and orientation.shape != (3, 3)):
                raise ValueError
    except (AttributeError, KeyError, TypeError, ValueError):
        raise InputError(
            f"{path}: targets must be tables such as [targets.ball1] with position and sigma, three numbers each"
        ) from None
    return out


def _written(fitted: Fitted) -> dict[str, Any]:
    """TOML has a nan, but who reads it expects a word."""
    known = {"sigma": fitted.sigma} if np.isfinite(fitted.sigma) else {"observable": False}
    return {"value": fitted.value, **known, "unit": fitted.unit}


def _effects(path: Path, table: Any) -> dict[str, dict[str, Fitted]]:
    try:
        return {
            str(name): {
                str(p): Fitted(float(f["value"]), float(f.get("sigma", np.nan)), str(f.get("unit", "")))
                for p, f in parameters.items()
            }
            for name, parameters in table.items()
        }
    except (AttributeError, KeyError, TypeError, ValueError):
        raise InputError(
            f"{path}: effects must be tables such as [effects.joint_compliance.c2] with value, sigma, unit"
        ) from None


def _matrix(path: Path, table: dict[str, Any], key: str, size: int) -> Array:
    try:
        matrix = np.array(table[key], float)
    except (KeyError, TypeError, ValueError):
        raise InputError(f"{path}: hand_eye.{key} must be a {size}x{size} list of numbers") from None
    if matrix.shape != (size, size) or not np.isfinite(matrix).all():
        raise InputError(f"{path}: hand_eye.{key} must be {size}x{size} finite numbers, is {matrix.shape}")
    return matrix


def in_unit(model: Model, length_unit: str) -> Model:
    """The model with lengths in another unit."""
    if model.length_unit == length_unit:
        return model
    factor = METRES[model.length_unit] / METRES[length_unit]
    scale = np.array([1.0] * 3 + [factor] * 3)
    moved = []
    for T in (model.T_mount, model.T_mount_coarse):
        T = T.copy()
        T[:3, 3] *= factor
        moved.append(T)
    effects = {name: {p: _rescaled(f, model.length_unit, length_unit, factor) for p, f in fitted.items()}
               for name, fitted in model.effects.items()}  # fmt: skip
    return Model(
        length_unit, model.mount, moved[0], moved[1], model.covariance * np.outer(scale, scale), effects,
        model.effects_file,
        {name: Target(t.position * factor, t.sigma * factor, t.orientation) for name, t in model.targets.items()},
    )  # fmt: skip


def _rescaled(fitted: Fitted, old: str, new: str, factor: float) -> Fitted:
    """A unit counts lengths where `old` stands alone in it: mm, mm/h, 1/mm, but not rad/(N m)."""
    above, _, below = fitted.unit.partition("/")
    power = (above.strip() == old) - (below.strip() == old)
    unit = "/".join(new if part.strip() == old else part for part in fitted.unit.split("/"))
    return Fitted(fitted.value * factor**power, fitted.sigma * factor**power, unit)
