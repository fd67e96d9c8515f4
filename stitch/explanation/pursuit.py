"""Orthogonal matching pursuit over addends of one or several columns (Pati, Rezaiifar & Krishnaprasad 1993, ACSSC;
groups: Lozano, Świrszcz & Abe 2009, NIPS 22)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.frames import Array, Indices
from stitch.statistics.tails import f_tail

_AT_MOST = 4  # numbers of a sum, unless one addend has more
_CHANCE = 0.05  # that an addend which is none is added, all of them counted
# Columns shorter than this share of the longest lie almost wholly in what the model explains; of a column's length less
# is another's.
_FAINT, _LEFT = 1e-6, 0.1
_WHOLE = 1 - 1e-12  # of what is left, no more is believed to be explained


def sums_of(seen: Array, z: Array, free: int, addends: Sequence[tuple[int, ...]], starts: int) -> set[tuple[int, ...]]:
    """Sums that explain z (n,), of which so many numbers are free: numbers of their columns in `seen` (n, M).

    One for each of the best addends to begin with, and each with a further addend as long as the next explains more
    than the best of all would by chance. Addends of different size are compared by the Bayesian information criterion
    (Schwarz 1978), with the scatter unknown.
    """
    strength = np.linalg.norm(seen, axis=0)
    usable = strength > _FAINT * strength.max(initial=0.0)
    unit = np.where(usable, seen / np.maximum(strength, 1e-300), 0.0)
    groups, out = _by_size(addends), set[tuple[int, ...]]()
    gains, ranks = _explained(unit, z, groups, len(addends))
    first = np.argsort(-_worth(gains, ranks, z, free))[:starts]
    for k in first[ranks[first] > 0]:
        out |= set(_begun_with(int(k), unit, z, free, addends, groups))
    return out


@dataclass(frozen=True)
class _Group:
    """Addends of one size."""

    which: Indices  # (g,)
    columns: Indices  # (g, k)


def _by_size(addends: Sequence[tuple[int, ...]]) -> list[_Group]:
    sizes = np.array([len(own) for own in addends])
    every = [np.flatnonzero(sizes == size) for size in np.unique(sizes)]
    return [_Group(which, np.array([addends[int(k)] for k in which], np.int64)) for which in every]


def _begun_with(
    k: int, unit: Array, rest: Array, free: int, addends: Sequence[tuple[int, ...]], groups: Sequence[_Group]
) -> list[tuple[int, ...]]:
    """The sum of one addend, of that and the best further one, and so on."""
    sums = [addends[k]]
    while len(sums[-1]) < _AT_MOST:
        basis = _basis(unit[:, addends[k]])
        unit, rest, free = unit - basis @ (basis.T @ unit), rest - basis @ (basis.T @ rest), free - basis.shape[1]
        gains, ranks = _explained(unit, rest, groups, len(addends))
        k = int(_worth(gains, ranks, rest, free).argmax())
        left, rank = free - int(ranks[k]), int(ranks[k])
        if not rank or left < 1:
            break
        F = gains[k] / rank / max((float(rest @ rest) - gains[k]) / left, 1e-300)
        if f_tail(F, rank, left) > _CHANCE / len(addends):
            break
        sums.append((*sums[-1], *addends[k]))
    return sums


def _worth(gains: Array, ranks: Indices, z: Array, free: int) -> Array:
    """(G,) Bayesian information criterion of every addend, less that of none."""
    shares = np.minimum(gains / max(float(z @ z), 1e-300), _WHOLE)
    worth = -free * np.log1p(-shares) - np.log(max(free, 2)) * ranks
    return np.asarray(np.where(ranks > 0, worth, -np.inf))


def _explained(unit: Array, z: Array, groups: Sequence[_Group], count: int) -> tuple[Array, Indices]:
    """(G,) squares of z that every addend explains, and its rank; directions of which little is left do not count."""
    gains, ranks, along = np.zeros(count), np.zeros(count, np.int64), unit.T @ z
    for group in groups:
        if group.columns.shape[1] == 1:
            k = group.columns[:, 0]
            squares = np.einsum("nk,nk->k", unit[:, k], unit[:, k])
            told = squares > _LEFT**2
            gains[group.which] = np.where(told, along[k] ** 2 / np.maximum(squares, 1e-300), 0.0)
            ranks[group.which] = told
            continue
        own = np.moveaxis(unit[:, group.columns], 0, 1)  # (g, n, k)
        values, vectors = np.linalg.eigh(own.transpose(0, 2, 1) @ own)
        told = values > _LEFT**2
        shares = np.einsum("gk,gkr->gr", along[group.columns], vectors) ** 2 / np.maximum(values, 1e-300)
        gains[group.which], ranks[group.which] = np.where(told, shares, 0.0).sum(axis=1), told.sum(axis=1)
    return gains, ranks


def _basis(columns: Array) -> Array:
    """(n, r) orthonormal, of columns (n, k) that had unit length."""
    U, left, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(U[:, left > _LEFT])
