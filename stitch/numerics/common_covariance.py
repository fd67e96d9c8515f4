"""Sums over blocks that have one covariance but for a turn: made once for all variances, and for every set of columns.

Where every view shows the same targets on its flange, what the flange's scatter does to them is the same but for the
flange's orientation. In numbers turned accordingly all these views have one covariance of a few numbers, and a sum
XᵀV⁻¹Y over the views is a sum over pairs of those numbers, each times what V⁻¹ says of the pair.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from stitch.numerics.frames import Array, Indices, Mask
from stitch.numerics.least_squares import invert_covariance

# Numbers of turned columns that are kept: 50 MB. Their products are small.
_KEPT_NUMBERS = 6_000_000


@dataclass(frozen=True, eq=False)
class SelectedColumns:
    """Some of P columns of the n numbers of all blocks."""

    whole: Array  # (n, P); what is summed of it is kept: the same object each time
    keep: Mask | None = None  # (P,); None: all of them, asked once, so that nothing of them is kept

    @property
    def columns(self) -> Array:
        """(n, p) those that are selected."""
        return self.whole if self.keep is None or self.keep.all() else self.whole[:, self.keep]

    @property
    def count(self) -> int:
        """How many are selected."""
        return self.whole.shape[1] if self.keep is None else int(self.keep.sum())

    @property
    def key(self) -> tuple[int, bytes]:
        """What tells them from others; for as long as something holds the whole set, where sums of it are kept."""
        return (hash(self.whole.tobytes()), b"") if self.keep is None else (id(self.whole), self.keep.tobytes())

    def of(self, values: Array, axis: int) -> Array:
        """What is selected of values for all of them, along an axis."""
        return values if self.keep is None or self.keep.all() else values.compress(self.keep, axis)


@dataclass(frozen=True)
class CovarianceGroup:
    """n blocks whose covariances are one after a turn of their m numbers: r of these scatter, the rest is noise."""

    blocks: Indices  # (n,)
    turn: Array  # (n, r, m) orthonormal rows, of numbers in units of the sensor's noise
    components: Array  # (c, r, r) of the covariance of the turned numbers, the sensor's noise last

    @cached_property
    def pairs(self) -> tuple[Indices, Indices]:
        """The numbers of every pair, and of each with itself, in the order of `pair_products`."""
        first, second = np.triu_indices(self.turn.shape[1])
        return first, second


@dataclass(frozen=True)
class PairWeights:
    """At some variances what every pair of turned numbers counts in sums over blocks, and what that gives."""

    logdet: float  # of the covariance
    pairs: Array  # (t,)
    slopes: Array  # (c, t) of the pairs in the variances, negative
    traces: Array  # (c,) tr(V⁻¹C_i)
    curvature: Array  # (c, c) tr(V⁻¹C_iV⁻¹C_j)


@dataclass(frozen=True)
class CommonCovariance:
    """B blocks of m numbers in groups of one covariance each, and the sums over them that were asked for."""

    groups: Sequence[CovarianceGroup]
    per_noise: Array  # (B, m) one over the sensor's noise; 0 where the number has none
    per_known: Array  # (B, m) one over a standard deviation that is known; 0 for all others
    noise_alone: int  # numbers in all beyond those that scatter
    logdet: float  # of the units
    # What is kept, by the identity of the whole set of columns, which is kept with it.
    _wholes: dict[int, Array] = field(default_factory=dict, repr=False)
    _turned: dict[int, list[Array]] = field(default_factory=dict, repr=False)
    _products: dict[tuple[int, int], Array] = field(default_factory=dict, repr=False)

    def weights(self, variances: Array) -> PairWeights:
        """At variances (c,), the sensor's noise last; of those that have no inverse `logdet` is infinite."""
        noise, count = variances[-1], len(variances)
        logdet, pairs, slopes = self.logdet + self.noise_alone * float(np.log(noise)), [], []
        traces, curvature = np.zeros(count), np.zeros((count, count))
        for group in self.groups:
            inverse = invert_covariance(np.tensordot(variances, group.components, axes=1)[None])
            W, n, upper = inverse.matrix[0], len(group.blocks), group.pairs
            shares = W @ group.components
            logdet += n * inverse.logdet
            pairs.append(W[upper])
            slopes.append((shares @ W)[:, *upper])
            traces += n * shares.trace(axis1=1, axis2=2)
            curvature += n * shares.reshape(count, -1) @ shares.transpose(0, 2, 1).reshape(count, -1).T
        of_noise = np.arange(count) == count - 1
        traces[-1] += self.noise_alone / noise
        curvature[-1, -1] += self.noise_alone / noise**2
        slopes.append(np.column_stack([of_noise / noise**2, np.zeros(count)]))
        return PairWeights(logdet, np.concatenate([*pairs, [1 / noise, 1.0]]), np.hstack(slopes), traces, curvature)

    def products(self, a: SelectedColumns, b: SelectedColumns) -> Array:
        """(t, p, q) sums over blocks of the products of two sets of columns, for every pair of turned numbers."""
        if a.keep is None or b.keep is None:
            return pair_products(self.turned(a), self.turned(b))
        return b.of(a.of(self._kept_products(a.whole, b.whole), 1), 2)

    def weighted(self, pairs: Array, a: SelectedColumns, b: SelectedColumns) -> Array:
        """(p, q) sum over the pairs (t,) of kept products, each times its weight."""
        every = self._kept_products(a.whole, b.whole)
        return b.of(a.of((pairs @ every.reshape(len(pairs), -1)).reshape(every.shape[1:]), 0), 1)

    def _kept_products(self, a: Array, b: Array) -> Array:
        found = self._products.get((id(a), id(b)))
        if found is None:
            found = pair_products(self._kept(a), self._kept(b))
            back = np.ascontiguousarray(found.transpose(0, 2, 1))
            self._products.update({(id(a), id(b)): found, (id(b), id(a)): back})
        return found

    def turned(self, columns: SelectedColumns) -> list[Array]:
        """The columns (k, r, n) of each group, the noise beyond them, and what is known, both (k, 1, B·m)."""
        if columns.keep is None:
            return self._turn(columns.whole)
        return [columns.of(own, 0) for own in self._kept(columns.whole)]

    def _kept(self, whole: Array) -> list[Array]:
        found = self._turned.pop(id(whole), None) or self._turn(whole)
        self._wholes[id(whole)] = whole
        self._turned[id(whole)] = found
        # Those that were asked for last stay. Other threads ask as well.
        every = list(self._turned.items())
        left = sum(own.size for _, parts in every for own in parts) - _KEPT_NUMBERS
        for key, parts in every[:-1]:
            if left <= 0:
                break
            self._turned.pop(key, None)
            left -= sum(own.size for own in parts)
        return found

    def _turn(self, columns: Array) -> list[Array]:
        X = columns.reshape(*self.per_noise.shape, columns.shape[1])
        white, parts = self.per_noise[..., None] * X, []
        for group in self.groups:
            own = group.turn @ white[group.blocks]
            white[group.blocks] -= group.turn.transpose(0, 2, 1) @ own
            parts.append(own)
        alone = white if self.noise_alone else white[:0]
        known = (self.per_known[..., None] * X)[self.per_known.any(axis=1)]
        parts += [own.reshape(len(own) * own.shape[1], 1, own.shape[2]) for own in (alone, known)]
        return [np.ascontiguousarray(own.transpose(2, 1, 0)) for own in parts]


def pair_products(X: Sequence[Array], Y: Sequence[Array]) -> Array:
    """(t, k, q) sums over blocks of the products of every pair of turned numbers, of columns X and Y as `turned`.

    Both orders of a pair count as one: V⁻¹ says the same of them.
    """
    out = []
    for x, y in zip(X, Y, strict=True):
        (k, r, n), q = x.shape, len(y)
        every = (x.reshape(k * r, n) @ y.reshape(q * r, n).T).reshape(k, r, q, r).transpose(1, 3, 0, 2)
        for i in range(r):
            own = every[i, i:].copy()
            own[1:] += every[i + 1 :, i]
            out.append(own)
    return np.concatenate(out)


# Matrices of blocks of one covariance differ by rounding, as a share; directions with less than the second share of the
# largest eigenvalue are none, and between that and the third a turn would be imprecise.
_SAME, _NO_DIRECTION, _PRECISE = 1e-9, 1e-13, 1e-5
# Blocks a group at least, on average, and in all: else sums of their own are as fast.
_BLOCKS_A_GROUP, MANY_BLOCKS = 20, 50


def common_covariance(scattered: Sequence[Array], noise: Array, known: Array) -> CommonCovariance | None:
    """Find groups of blocks that have one covariance but for a turn; None where there are none.

    Args:
        scattered: per component of scatter (V, m, 3) what a unit of it does to the numbers of the first V blocks.
        noise: (B, m) variance of a unit of sensor noise; 0 where a number has none.
        known: (B, m) variance that is known; 0 elsewhere.
    """
    per_noise, per_known = (np.where(own > 0, own, np.inf) ** -0.5 for own in (noise, known))
    whole = np.concatenate(scattered, axis=2)
    J = whole * per_noise[: len(whole), :, None]
    patterns, which = np.unique(noise[: len(J)], axis=0, return_inverse=True)
    # A number without noise that scatters all the same fits into no group.
    if len(J) < MANY_BLOCKS or len(patterns) * _BLOCKS_A_GROUP > len(J) or whole[J == 0].any():
        return None
    owner = np.repeat(np.arange(len(scattered)), [own.shape[2] for own in scattered])
    groups = [_group_of(J, np.flatnonzero(which.ravel() == k), owner) for k in range(len(patterns))]
    found = [group for group in groups if group is not None]
    if len(found) < len(groups):
        return None
    scatter = sum(len(group.blocks) * group.turn.shape[1] for group in found)
    log_units = float(np.log(noise[noise > 0]).sum() + np.log(known[known > 0]).sum())
    return CommonCovariance(found, per_noise, per_known, int((noise > 0).sum()) - scatter, log_units)


def _group_of(J: Array, blocks: Indices, owner: Indices) -> CovarianceGroup | None:
    """Some blocks as a group, if they have one covariance.

    Args:
        J: (V, m, s) what a unit of scatter along each of s axes does to their numbers, in units of the noise.
        owner: (s,) the component of each axis.
    """
    every = J[blocks].transpose(0, 2, 1) @ J[blocks]
    size = np.sqrt(np.maximum(np.diag(every[0]), 1e-300))
    if (np.abs(every - every[0]) > _SAME * np.outer(size, size)).any():
        return None
    values, vectors = np.linalg.eigh(every[0] / np.outer(size, size))
    keep = values > _NO_DIRECTION * max(values[-1], 1e-300)
    if not (values[keep] > _PRECISE * values[-1]).all():
        return None
    root = np.sqrt(values[keep]) * vectors[:, keep]  # (s, r), axes of unit size
    of_components = [(root * (size**2 * (owner == i))[:, None]).T @ root for i in range(owner[-1] + 1)]
    turn = J[blocks] @ (vectors[:, keep] / np.sqrt(values[keep]) / size[:, None])
    return CovarianceGroup(blocks, turn.transpose(0, 2, 1), np.array([*of_components, np.eye(int(keep.sum()))]))
