"""Effects in use, between the model's file and the chain."""

from collections.abc import Sequence

import numpy as np

from stitch.effects.contract import EFFECTS, Effect
from stitch.errors import InputError
from stitch.frames import Array
from stitch.measurement.measurement import Measurement, Term
from stitch.model.model_toml import Fitted, Model


def known(name: str) -> Effect:
    """An effect of the library or of a user's file.

    Raises:
        InputError: no such effect.
    """
    if name not in EFFECTS:
        raise InputError(f"no effect {name!r}; there are {', '.join(EFFECTS)} (your own: --effects-file)")
    return EFFECTS[name]


def require(measurement: Measurement, effect: Effect) -> None:
    """Refuse an effect that a session cannot have.

    Raises:
        InputError: names what is missing.
    """
    missing = measurement.lacks(effect)
    if missing:
        words = [_MENDS.get(need, f"a column {need} in views.csv") for need in missing]
        raise InputError(
            f"effect {effect.name} needs {' and '.join(words)}, which session {measurement.capture.name} does not have"
        )


_MENDS = {
    "joints": "joint angles in views.csv and the robot's DH rows or URDF",
    "torque": "joint angles and the robot's geometry",
    "velocity": "columns j1_velocity_deg_s … in views.csv",
    "time": "a column time_s in views.csv",
    "intensity": "an intensity for every point",
}


def empty_term(measurement: Measurement, effect: Effect) -> Term:
    """The effect at zero; gridded parameters in the middle of their grid."""
    parameters = measurement.parameters(effect)
    return Term(effect, np.array([p.grid[len(p.grid) // 2] if p.grid else 0.0 for p in parameters]))


def terms_of(model: Model, measurement: Measurement) -> list[Term]:
    """The terms of a model in a session, a parameter that the model does not name at zero.

    Raises:
        InputError: an effect that is not known or that the session cannot have, or a parameter that it does not have
            or counts in another unit.
    """
    out = []
    for name, fitted in model.effects.items():
        effect = known(name)
        require(measurement, effect)
        parameters = measurement.parameters(effect)
        _require_same(measurement, effect, fitted, {p.name: p.unit for p in parameters})
        out.append(Term(effect, np.array([fitted[p.name].value if p.name in fitted else 0.0 for p in parameters])))
    return out


def sigmas_of(model: Model, measurement: Measurement) -> tuple[Array, ...]:
    """Per term of `terms_of` the sigmas (P,) of its parameters, NaN where the model states none."""
    return tuple(
        np.array([fitted[p.name].sigma if p.name in fitted else np.nan for p in measurement.parameters(known(name))])
        for name, fitted in model.effects.items()
    )


def _require_same(measurement: Measurement, effect: Effect, fitted: dict[str, Fitted], units: dict[str, str]) -> None:
    """Refuse what a model knows of an effect where this session would have to drop it or read it otherwise."""
    where = f"session {measurement.capture.name}"
    lost = [name for name in fitted if name not in units]
    if lost:
        raise InputError(
            f"the model's {effect.name} has {', '.join(lost)}, but in {where} it has {', '.join(units)}; state the arm "
            "and its link masses under [robot] as the session that was fitted does, or fit the effect anew"
        )
    for name, f in fitted.items():
        if f.unit != units[name]:
            mend = f"a column {' or '.join(effect.prefers)} there as here" if effect.prefers else "that unit"
            raise InputError(
                f"the model's {effect.name}.{name} is in {f.unit!r}, but {where} counts it in {units[name]!r}; "
                f"it needs {mend}"
            )


def fitted_of(measurement: Measurement, terms: Sequence[Term], sigmas: Sequence[Array]) -> dict[str, dict[str, Fitted]]:
    """Values with sigmas and units by effect and parameter."""
    return {
        term.effect.name: {
            p.name: Fitted(float(value), float(sigma), p.unit)
            for p, value, sigma in zip(measurement.parameters(term.effect), term.values, own, strict=True)
        }
        for term, own in zip(terms, sigmas, strict=True)
    }
