"""Orthogonal matching pursuit over addends of one or several columns (Pati, Rezaiifar & Krishnaprasad 1993, ACSSC;
groups: Lozano, Świrszcz & Abe 2009, NIPS 22)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from stitch.frames import Array, Indices
from stitch.statistics.tails import f_tail

_AT_MOST = 4  # numbers of a sum, unless one addend has more
_CHANCE = 0.05  # that an addend which is none is added, all of them counted
# Columns shorter than this share of the longest lie almost wholly in what the model explains; of a column's length less
# is another's.
_MIN_COLUMN_NORM, _INDEPENDENT_SHARE = 1e-6, 0.1
_WHOLE = 1 - 1e-12  # of what is left, no more is believed to be explained

# Columns (n, k) of a sum, by its numbers.
SumColumns = Callable[[tuple[int, ...]], Array]


def pursue_sums(
    design: Array,
    z: Array,
    free: int,
    addends: Sequence[tuple[int, ...]],
    starts: int,
    refined_columns: SumColumns | None = None,
) -> set[tuple[int, ...]]:
    """Sums that explain z (n,), of which so many numbers are free: numbers of their columns in `design` (n, M).

    One for each of the best addends to begin with, and each with a further addend as long as the next explains more
    than the best of all would by chance. Addends of different size are compared by the Bayesian information criterion
    (Schwarz 1978), with the scatter unknown.

    Args:
        refined_columns: columns in the place of those in `design`, which tell what is left for the next addend.
    """
    strength = np.linalg.norm(design, axis=0)
    usable = strength > _MIN_COLUMN_NORM * strength.max(initial=0.0)
    unit = np.where(usable, design / np.maximum(strength, 1e-300), 0.0)
    asked = _PursuitProblem(unit, z, free, addends, _group_by_size(addends))
    worth, _, ranks, _ = asked.score_addends(np.zeros((len(z), 0)))
    first = np.argsort(-worth)[:starts]
    every = [asked.sums_from(int(k), refined_columns or (lambda own: design[:, own])) for k in first[ranks[first] > 0]]
    return {sum_ for sums in every for sum_ in sums}


@dataclass(frozen=True)
class _AddendGroup:
    """Addends of one size."""

    which: Indices  # (g,)
    columns: Indices  # (g, k)


def _group_by_size(addends: Sequence[tuple[int, ...]]) -> list[_AddendGroup]:
    sizes = np.array([len(own) for own in addends])
    every = [np.flatnonzero(sizes == size) for size in np.unique(sizes)]
    return [_AddendGroup(which, np.array([addends[int(k)] for k in which], np.int64)) for which in every]


@dataclass(frozen=True)
class _PursuitProblem:
    """What is to be explained, and by which addends."""

    unit: Array  # (n, M) columns of unit length
    z: Array  # (n,)
    free: int
    addends: Sequence[tuple[int, ...]]
    groups: Sequence[_AddendGroup]

    def sums_from(self, k: int, refined: SumColumns) -> list[tuple[int, ...]]:
        """The sum of one addend, of that and the best further one, and so on."""
        sums = [self.addends[k]]
        while len(sums[-1]) < _AT_MOST:
            worth, gains, ranks, rest = self.score_addends(_basis(refined(sums[-1])))
            # What it holds may have moved, and would seem to be wanted once more where it stood.
            inside = set(sums[-1])
            held = [inside.issuperset(own) for own in self.addends]
            worth, ranks = np.where(held, -np.inf, worth), np.where(held, 0, ranks)
            k = int(worth.argmax())
            rank = int(ranks[k])
            left = self.free - len(sums[-1]) - rank
            if not rank or left < 1:
                break
            F = gains[k] / rank / max((rest - gains[k]) / left, 1e-300)
            if f_tail(F, rank, left) > _CHANCE / len(self.addends):
                break
            # Addends may share a number: a spring stands alone and with how it stiffens.
            sums.append(tuple(dict.fromkeys((*sums[-1], *self.addends[k]))))
        return sums

    def score_addends(self, basis: Array) -> tuple[Array, Array, Indices, float]:
        """(G,) worth, gain and rank of every addend beside what lies in a basis (n, r), and the square that is left."""
        unit, rest = self.unit - basis @ (basis.T @ self.unit), self.z - basis @ (basis.T @ self.z)
        gains, ranks = _explained_squares(unit, rest, self.groups, len(self.addends))
        return _information_criterion(gains, ranks, rest, self.free - basis.shape[1]), gains, ranks, float(rest @ rest)


def _information_criterion(gains: Array, ranks: Indices, z: Array, free: int) -> Array:
    """(G,) Bayesian information criterion of every addend, less that of none."""
    shares = np.minimum(gains / max(float(z @ z), 1e-300), _WHOLE)
    worth = -free * np.log1p(-shares) - np.log(max(free, 2)) * ranks
    return np.asarray(np.where(ranks > 0, worth, -np.inf))


def _explained_squares(unit: Array, z: Array, groups: Sequence[_AddendGroup], count: int) -> tuple[Array, Indices]:
    """(G,) squares of z that every addend explains, and its rank; directions of which little is left do not count."""
    gains, ranks, along = np.zeros(count), np.zeros(count, np.int64), unit.T @ z
    for group in groups:
        if group.columns.shape[1] == 1:
            k = group.columns[:, 0]
            squares = np.einsum("nk,nk->k", unit[:, k], unit[:, k])
            told = squares > _INDEPENDENT_SHARE**2
            gains[group.which] = np.where(told, along[k] ** 2 / np.maximum(squares, 1e-300), 0.0)
            ranks[group.which] = told
            continue
        own = np.moveaxis(unit[:, group.columns], 0, 1)  # (g, n, k)
        values, vectors = np.linalg.eigh(own.transpose(0, 2, 1) @ own)
        told = values > _INDEPENDENT_SHARE**2
        shares = np.einsum("gk,gkr->gr", along[group.columns], vectors) ** 2 / np.maximum(values, 1e-300)
        gains[group.which], ranks[group.which] = np.where(told, shares, 0.0).sum(axis=1), told.sum(axis=1)
    return gains, ranks


def _basis(columns: Array) -> Array:
    """(n, r) orthonormal."""
    unit = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    U, left, _ = np.linalg.svd(unit, full_matrices=False)
    return np.asarray(U[:, left > _INDEPENDENT_SHARE / 2])  # of a column of which so much is left beside another
