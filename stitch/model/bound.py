"""Between model.toml and a session: units, parameters that mean the same, sigmas."""

from dataclasses import replace

import numpy as np

from stitch.effects.contract import Effect, Parameter
from stitch.effects.in_session import find_effect, parameters_in, require_available
from stitch.errors import InputError
from stitch.measurement.measurement import Measurement
from stitch.model.model import Model, Target
from stitch.model.model_toml import ModelFile
from stitch.model.term import Term
from stitch.units import METRES


def bind_to_session(file: ModelFile, measurement: Measurement) -> Model:
    """The model of a file in a session; a parameter that the file does not name is held at zero.

    Raises:
        InputError: an effect that is not known or that the session cannot have, or a parameter that it does not have
            or counts in another unit.
    """
    terms = []
    for name, stated in file.effects.items():
        effect = find_effect(name)
        require_available(measurement, effect)
        own = parameters_in(measurement, effect)
        _require_same(measurement, effect, stated, {p.name: p.unit for p in own})
        filled = [
            replace(p, value=s.value, sigma=s.sigma, kept=s.kept) if (s := stated.get(p.name)) else p for p in own
        ]
        terms.append(Term(effect, tuple(filled)))
    return Model(file.T_mount, tuple(terms), file.covariance, file.targets, file.effects_covariance)


def _require_same(
    measurement: Measurement, effect: Effect, stated: dict[str, Parameter], units: dict[str, str]
) -> None:
    """Refuse what a model knows of an effect where this session would have to drop it or read it otherwise."""
    where = f"session {measurement.capture.name}"
    lost = [name for name in stated if name not in units]
    if lost:
        raise InputError(
            f"the model's {effect.name} has {', '.join(lost)}, but in {where} it has {', '.join(units)}; state the arm "
            "and its link masses under [robot] as the session that was fitted does, or fit the effect anew"
        )
    for name, p in stated.items():
        if p.unit != units[name]:
            fix = f"a column {' or '.join(effect.prefers)} there as here" if effect.prefers else "that unit"
            raise InputError(
                f"the model's {effect.name}.{name} is in {p.unit!r}, but {where} counts it in {units[name]!r}; "
                f"it needs {fix}"
            )


def convert_unit(file: ModelFile, length_unit: str) -> ModelFile:
    """The model with lengths in another unit."""
    if file.length_unit == length_unit:
        return file
    factor = METRES[file.length_unit] / METRES[length_unit]
    scale = np.array([1.0] * 3 + [factor] * 3)
    moved = []
    for T in (file.T_mount, file.T_mount_coarse):
        T = T.copy()
        T[:3, 3] *= factor
        moved.append(T)
    known = file.effects_covariance
    units = {f"{name}.{key}": p.unit for name, own in file.effects.items() for key, p in own.items()}
    factors = np.array([factor ** _power(units.get(name, ""), file.length_unit) for name in known.names])
    return replace(
        file,
        length_unit=length_unit,
        T_mount=moved[0],
        T_mount_coarse=moved[1],
        covariance=file.covariance * np.outer(scale, scale),
        effects={
            name: {key: _rescaled(p, file.length_unit, length_unit, factor) for key, p in own.items()}
            for name, own in file.effects.items()
        },
        effects_covariance=replace(known, matrix=known.matrix * np.outer(factors, factors)),
        targets={
            name: Target(t.position * factor, t.sigma * factor, t.orientation) for name, t in file.targets.items()
        },
    )


def _rescaled(p: Parameter, old: str, new: str, factor: float) -> Parameter:
    power = _power(p.unit, old)
    unit = "/".join(new if part.strip() == old else part for part in p.unit.split("/"))
    return replace(p, unit=unit, value=p.value * factor**power, sigma=p.sigma * factor**power)


def _power(unit: str, length: str) -> int:
    """A unit counts lengths where `length` stands alone in it: mm, mm/h, 1/mm, but not rad/(N m)."""
    above, _, below = unit.partition("/")
    return (above.strip() == length) - (below.strip() == length)
