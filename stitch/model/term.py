"""An effect in use with its named parameters."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stitch.effects.contract import Effect, Parameter
from stitch.effects.in_session import parameters_in
from stitch.frames import Array, Mask
from stitch.measurement.measurement import Measurement


@dataclass(frozen=True)
class Term:
    """An effect in use; P parameters in the order of the effect's arguments."""

    effect: Effect
    parameters: tuple[Parameter, ...]

    @property
    def name(self) -> str:
        """That of the effect."""
        return self.effect.name

    @property
    def values(self) -> Array:
        """(P,) in each parameter's unit."""
        return values_of([self])

    @property
    def sigmas(self) -> Array:
        """(P,) standard deviations; NaN where a parameter is held."""
        return np.array([p.sigma for p in self.parameters], float)

    @property
    def typical(self) -> Array:
        """(P,) plausible sizes."""
        return sizes_of([self])

    @property
    def gridded(self) -> Mask:
        """(P,) bool: tried value by value instead of fitted."""
        return np.array([bool(p.grid) for p in self.parameters], bool)

    @property
    def arguments(self) -> dict[str, Any]:
        """Keyword arguments of the effect's function."""
        return self.effect.arguments(self.parameters)

    def at(self, values: Array, sigmas: Array | None = None) -> "Term":
        """The term with other values (P,), and sigmas (P,) where they are known."""
        own = [replace(p, value=float(v)) for p, v in zip(self.parameters, values, strict=True)]
        if sigmas is not None:
            own = [replace(p, sigma=float(s)) for p, s in zip(own, sigmas, strict=True)]
        return replace(self, parameters=tuple(own))


def term_of(measurement: Measurement, effect: Effect) -> Term:
    """The effect at zero; parameters that are tried value by value in the middle of their grid."""
    found = parameters_in(measurement, effect)
    return Term(effect, tuple(replace(p, value=p.grid[len(p.grid) // 2] if p.grid else 0.0) for p in found))


def stack_parameters(terms: Sequence[Term]) -> tuple[Parameter, ...]:
    """All parameters of all terms in one row."""
    return tuple(p for term in terms for p in term.parameters)


def values_of(terms: Sequence[Term]) -> Array:
    """(P,) values of all parameters of all terms, each in its unit."""
    return np.array([p.value for p in stack_parameters(terms)], float)


def sizes_of(terms: Sequence[Term]) -> Array:
    """(P,) plausible sizes of the same."""
    return np.array([p.typical for p in stack_parameters(terms)], float)


def known_sigmas(terms: Sequence[Term], fitted: Mask, sigmas: Array) -> Array:
    """(P,) sigmas: found for the `fitted`, as it came for what another run's arm brought, NaN for the rest."""
    out = np.array([p.sigma if p.kept else np.nan for p in stack_parameters(terms)], float)
    out[fitted] = sigmas
    return out


def with_parameter_values(terms: Sequence[Term], values: Array, sigmas: Array | None = None) -> tuple[Term, ...]:
    """The terms with values (P,), and sigmas (P,), of all their parameters in one row."""
    out, at = [], 0
    for term in terms:
        own = slice(at, at + len(term.parameters))
        out.append(term.at(values[own], None if sigmas is None else sigmas[own]))
        at = own.stop
    return tuple(out)
