"""How well the parameters of all effects in use are known together: errors of one go with errors of another."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from stitch.frames import Array, Mask
from stitch.model.term import Term

# A person may edit the sigmas of model.toml; then the matrix of the fit is no longer theirs.
_SAME_SIGMA = 1e-6


@dataclass(frozen=True)
class EffectsCovariance:
    """Covariance of K fitted parameters, each in its own unit."""

    names: tuple[str, ...] = ()  # effect.parameter
    matrix: Array = field(default_factory=lambda: np.zeros((0, 0)))  # (K, K)

    def root(self, terms: Sequence[Term]) -> Array:
        """(P, K) L with L·Lᵀ the covariance of all parameters of some terms, zero where nothing is known of one.

        Where the sigma of a parameter is another than the matrix has, its sigma counts, alone.
        """
        rows = [(f"{term.name}.{p.name}", p) for term in terms for p in term.parameters]
        at = {name: k for k, name in enumerate(self.names)}
        sigma = np.sqrt(np.diag(self.matrix))
        known = [
            (i, at[name])
            for i, (name, p) in enumerate(rows)
            if name in at and p.fitted and abs(p.sigma - sigma[at[name]]) <= _SAME_SIGMA * sigma[at[name]]
        ]
        together = {i for i, _ in known}
        alone = [i for i, (_, p) in enumerate(rows) if p.fitted and i not in together]
        out = np.zeros((len(rows), len(known) + len(alone)))
        if known:
            own, theirs = (list(index) for index in zip(*known, strict=True))
            size = sigma[theirs]
            values, vectors = np.linalg.eigh(self.matrix[np.ix_(theirs, theirs)] / np.outer(size, size))
            out[own, : len(known)] = size[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
        for k, i in enumerate(alone, len(known)):
            out[i, k] = rows[i][1].sigma
        return out


def kept_root(terms: Sequence[Term], covariance: EffectsCovariance) -> Array:
    """(P, K) the same root for what another run's arm brought, zero rows for the rest."""
    kept = np.array([p.kept for term in terms for p in term.parameters], bool)
    root = covariance.root(terms)
    root = root * kept[:, None]
    return np.asarray(root[:, (root != 0).any(axis=0)])


def covariance_of_fit(terms: Sequence[Term], fitted: Mask, matrix: Array, kept: Array) -> EffectsCovariance:
    """Of the fitted parameters (K of P, bool) with their matrix (K, K), beside those kept, with their root (P, L)."""
    names = [f"{term.name}.{p.name}" for term in terms for p in term.parameters]
    whole = kept @ kept.T
    whole[np.ix_(fitted, fitted)] += matrix
    known = np.diag(whole) > 0
    return EffectsCovariance(tuple(n for n, k in zip(names, known, strict=True) if k), whole[np.ix_(known, known)])
