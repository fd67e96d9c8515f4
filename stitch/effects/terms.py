"""Effects in use, between the model's file and the chain."""

from collections.abc import Sequence

import numpy as np

from stitch.effects.chain import Chain, Term
from stitch.effects.contract import EFFECTS, Effect
from stitch.errors import InputError
from stitch.frames import Array
from stitch.model import Fitted, Model


def known(name: str) -> Effect:
    """An effect of the library or of a user's file.

    Raises:
        InputError: no such effect.
    """
    if name not in EFFECTS:
        raise InputError(f"no effect {name!r}; there are {', '.join(EFFECTS)} (your own: --effects-file)")
    return EFFECTS[name]


def require(chain: Chain, effect: Effect) -> None:
    """Refuse an effect that a session cannot have.

    Raises:
        InputError: names what is missing.
    """
    missing = chain.lacks(effect)
    if missing:
        words = [_MENDS.get(need, f"a column {need} in views.csv") for need in missing]
        raise InputError(f"effect {effect.name} needs {' and '.join(words)}, which this session does not have")


_MENDS = {
    "joints": "joint angles in views.csv and the robot's DH rows or URDF",
    "torque": "joint angles and the robot's geometry",
    "velocity": "columns j1_velocity_deg_s … in views.csv",
    "time": "a column time_s in views.csv",
    "intensity": "an intensity for every point",
}


def empty_term(chain: Chain, effect: Effect) -> Term:
    """The effect at zero; gridded parameters in the middle of their grid."""
    parameters = chain.parameters(effect)
    return Term(effect, np.array([p.grid[len(p.grid) // 2] if p.grid else 0.0 for p in parameters]))


def terms_of(model: Model, chain: Chain) -> list[Term]:
    """The terms of a model in a session.

    Raises:
        InputError: an effect that is not known, or that the session cannot have.
    """
    out = []
    for name, fitted in model.effects.items():
        effect = known(name)
        require(chain, effect)
        values = [fitted[p.name].value if p.name in fitted else 0.0 for p in chain.parameters(effect)]
        out.append(Term(effect, np.array(values)))
    return out


def fitted_of(chain: Chain, terms: Sequence[Term], sigmas: Sequence[Array]) -> dict[str, dict[str, Fitted]]:
    """Values with sigmas and units by effect and parameter."""
    return {
        term.effect.name: {
            p.name: Fitted(float(value), float(sigma), p.unit)
            for p, value, sigma in zip(chain.parameters(term.effect), term.values, own, strict=True)
        }
        for term, own in zip(terms, sigmas, strict=True)
    }
