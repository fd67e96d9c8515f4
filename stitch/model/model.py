"""The model of a cell in memory: hand-eye with covariance, effects in use, places of targets."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from stitch.frames import Array
from stitch.model.effects_covariance import EffectsCovariance
from stitch.model.term import Term


@dataclass(frozen=True)
class Target:
    """A labelled point in the reference frame, or a probe with its orientation."""

    position: Array  # (3,) length_unit
    sigma: Array  # (3,)
    orientation: Array | None = None  # (3, 3) R_reference_probe


@dataclass(frozen=True)
class Model:
    """Fitted parameters of a cell: hand-eye, effects, targets. Lengths in the session's length_unit, angles in rad.

    Example:
        >>> run.model.T_mount.shape, run.model.covariance.shape, run.model.effects
        ((4, 4), (6, 6), [])
    """

    T_mount: Array  # (4, 4) T_base_scanner or T_flange_scanner
    terms: tuple[Term, ...] = ()
    covariance: Array = field(default_factory=lambda: np.zeros((6, 6)))  # of T·exp(ξ), scanner frame, rotation first
    targets: dict[str, Target] = field(default_factory=dict)
    effects_covariance: EffectsCovariance = field(default_factory=EffectsCovariance)

    @property
    def effects(self) -> list[str]:
        """Names of the effects in use."""
        return [term.name for term in self.terms]

    def with_terms(self, terms: Sequence[Term]) -> "Model":
        """The model with other effects in use."""
        return replace(self, terms=tuple(terms))

    def without(self, name: str) -> "Model":
        """The model without one effect."""
        return self.with_terms([term for term in self.terms if term.name != name])

    def with_term(self, term: Term) -> "Model":
        """The model with a term in place of its own of the same effect, as the last."""
        return self.with_terms([*self.without(term.name).terms, term])

    def __repr__(self) -> str:
        effects = ", ".join(self.effects) or "no effects"
        position = ", ".join(f"{x:.4g}" for x in self.T_mount[:3, 3])
        return f"Model(hand-eye at ({position}), {effects}, {len(self.targets)} targets)"
