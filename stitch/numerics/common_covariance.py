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

# Blocks a group at least, on average, and in all: else sums of their own are as fast.
_BLOCKS_A_GROUP, MANY_BLOCKS = 20, 50
# Matrices of blocks of one covariance differ by rounding, as a share; directions with less than the second share of the
# largest eigenvalue are none, and between that and the third a turn would be imprecise.
_SAME, _NO_DIRECTION, _PRECISE = 1e-9, 1e-13, 1e-5
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
    def key(self) -> tuple[int | bytes, bytes]:
        """What tells them from others; for as long as something holds the whole set, where sums of it are kept."""
        return (self.whole.tobytes(), b"") if self.keep is None else (id(self.whole), self.keep.tobytes())

    def of(self, values: Array, axis: int) -> Array:
        """Return what is selected of values for all of them, along an axis."""
        return values if self.keep is None or self.keep.all() else values.compress(self.keep, axis)


@dataclass(frozen=True)
class CovarianceGroup:
    """n blocks whose covariances are one after a turn of their m numbers: r of these scatter, the rest is noise."""

    blocks: Indices  # (n,)
    turn: Array  # (n, r, m) orthonormal rows, of numbers in units of the sensor's noise
    components: Array  # (c, r, r) of the covariance of the turned numbers, the sensor's noise last


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
    _sizes: dict[int, int] = field(default_factory=dict, repr=False)  # numbers of each
    _products: dict[tuple[int, int], Array] = field(default_factory=dict, repr=False)

    def weights(self, variances: Array) -> PairWeights:
        """Return the weights at variances (c,), the sensor's noise last; `logdet` is infinite if V has no inverse."""
        noise = variances[-1]
        count = len(variances)
        logdet = self.logdet + self.noise_alone * float(np.log(noise))
        pairs, slopes = list[Array](), list[Array]()
        traces, curvature = np.zeros(count), np.zeros((count, count))
        for group in self.groups:
            inverse = invert_covariance(np.tensordot(variances, group.components, axes=1)[None])
            W, n = inverse.matrix[0], len(group.blocks)
            # Every pair of numbers, and each with itself, in the order of `pair_products`.
            upper = np.triu_indices(len(W))
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
        """Return sums (t, p, q) over blocks of the products of two sets of columns, per pair of turned numbers."""
        if a.keep is None or b.keep is None:
            return pair_products(self.turned(a), self.turned(b))
        return b.of(a.of(self._kept_products(a.whole, b.whole), 1), 2)

    def weighted(self, pairs: Array, a: SelectedColumns, b: SelectedColumns) -> Array:
        """Return the sum (p, q) over the pairs (t,) of kept products, each times its weight."""
        products = self._kept_products(a.whole, b.whole)
        return b.of(a.of((pairs @ products.reshape(len(pairs), -1)).reshape(products.shape[1:]), 0), 1)

    def _kept_products(self, a: Array, b: Array) -> Array:
        """Return the products of two sets of columns by pair of turned numbers, made once for either order."""
        products = self._products.get((id(a), id(b)))
        if products is None:
            products = pair_products(self._kept(a), self._kept(b))
            back = np.ascontiguousarray(products.transpose(0, 2, 1))
            self._products.update({(id(a), id(b)): products, (id(b), id(a)): back})
        return products

    def turned(self, columns: SelectedColumns) -> list[Array]:
        """Return the columns (k, r, n) of each group, the noise beyond them, and what is known, both (k, 1, B·m)."""
        if columns.keep is None:
            return self._turn(columns.whole)
        return [columns.of(part, 0) for part in self._kept(columns.whole)]

    def keep(self, wholes: Sequence[Array]) -> None:
        """Turn sets of columns that will be asked for, at once: so many small products take longer one by one."""
        new = [
            whole for whole in wholes if id(whole) not in self._turned and (id(whole), id(whole)) not in self._products
        ]
        if len(new) > 1:
            ends = np.cumsum([whole.shape[1] for whole in new])[:-1]
            parts = [np.split(part, ends) for part in self._turn(np.hstack(new))]
            for whole, *turned in zip(new, *parts, strict=True):
                self._kept(whole, turned)

    def _kept(self, whole: Array, turned: list[Array] | None = None) -> list[Array]:
        """Return columns (n, p) turned by group, and remember them in place of those that were asked for longest ago.

        Args:
            turned: the same, where they are known already.
        """
        turned = turned or self._turned.pop(id(whole), None) or self._turn(whole)
        self._wholes[id(whole)] = whole
        self._turned[id(whole)] = turned
        self._sizes[id(whole)] = sum(part.size for part in turned)
        # Those that were asked for last stay. Other threads ask as well.
        excess = sum(self._sizes.copy().values()) - _KEPT_NUMBERS
        for key in list(self._turned)[:-1]:
            if excess <= 0:
                break
            self._turned.pop(key, None)
            excess -= self._sizes.pop(key, 0)
        return turned

    def _turn(self, columns: Array) -> list[Array]:
        """Return columns (n, p) turned into the axes in which the blocks of a group have one diagonal covariance.

        Returns:
            Of each group, of what is left of the noise, and of what is known, (p, rows, blocks).
        """
        X = columns.reshape(*self.per_noise.shape, columns.shape[1])
        white = self.per_noise[..., None] * X
        parts = []
        for group in self.groups:
            turned = group.turn @ white[group.blocks]
            white[group.blocks] -= group.turn.transpose(0, 2, 1) @ turned
            parts.append(turned)
        alone = white if self.noise_alone else white[:0]
        known = (self.per_known[..., None] * X)[self.per_known.any(axis=1)]
        parts += [rest.reshape(len(rest) * rest.shape[1], 1, rest.shape[2]) for rest in (alone, known)]
        return [np.ascontiguousarray(part.transpose(2, 1, 0)) for part in parts]


@dataclass(frozen=True)
class MeanSums:
    """Columns of a model's mean, what was seen as the last one, and the sums over blocks of their products."""

    common: CommonCovariance
    sets: Sequence[SelectedColumns]
    known_products: Array | None = None  # `products`, where they were made already

    @property
    def are_kept(self) -> bool:
        """True if sums of all of the columns are kept."""
        return all(columns.keep is not None for columns in self.sets)

    @cached_property
    def products(self) -> Array:
        """(t, a + 1, a + 1) products of all of them."""
        if self.known_products is not None:
            return self.known_products
        return np.concatenate([self.products_with(columns) for columns in self.sets], axis=2)

    def products_with(self, columns: SelectedColumns) -> Array:
        """Return their products (t, a + 1, p) with other columns."""
        if columns.keep is None or not self.are_kept:
            return pair_products(self._turned, self.common.turned(columns))
        return np.concatenate([self.common.products(held, columns) for held in self.sets], axis=1)

    @cached_property
    def _turned(self) -> list[Array]:
        return [np.concatenate(parts) for parts in zip(*map(self.common.turned, self.sets), strict=True)]

    def products_with_further(self, sets: Sequence[SelectedColumns]) -> Array:
        """Return products (t, a + g + 1, a + g + 1) of all, with g further columns between mean and what was seen."""
        if not sets:
            return self.products
        across = np.concatenate([self.products_with(columns) for columns in sets], axis=2)
        rows = [np.concatenate([self.common.products(one, other) for other in sets], axis=2) for one in sets]
        a, g = across.shape[1] - 1, across.shape[2]
        old, new = np.append(np.arange(a), a + g), slice(a, a + g)
        every = np.empty((len(across), a + g + 1, a + g + 1))
        every[:, old[:, None], old] = self.products
        every[:, old, new] = across
        every[:, new, old] = across.transpose(0, 2, 1)
        every[:, new, new] = np.concatenate(rows, axis=1)
        return every


def pair_products(X: Sequence[Array], Y: Sequence[Array]) -> Array:
    """Return sums (t, k, q) over blocks of products, per pair of turned numbers, of columns X and Y as `turned`.

    Both orders of a pair count as one: V⁻¹ says the same of them.
    """
    out = []
    for x, y in zip(X, Y, strict=True):
        (k, r, n), q = x.shape, len(y)
        every = (x.reshape(k * r, n) @ y.reshape(q * r, n).T).reshape(k, r, q, r).transpose(1, 3, 0, 2)
        for i in range(r):
            pairs = every[i, i:].copy()
            pairs[1:] += every[i + 1 :, i]
            out.append(pairs)
    return np.concatenate(out)


def common_covariance(scattered: Sequence[Array], noise: Array, known: Array) -> CommonCovariance | None:
    """Return the groups of blocks that have one covariance but for a turn; None where there are none.

    Args:
        scattered: per component of scatter (V, m, 3) what a unit of it does to the numbers of the first V blocks.
        noise: (B, m) variance of a unit of sensor noise; 0 where a number has none.
        known: (B, m) variance that is known; 0 elsewhere.
    """
    per_noise = np.where(noise > 0, noise, np.inf) ** -0.5
    per_known = np.where(known > 0, known, np.inf) ** -0.5
    whole = np.concatenate(scattered, axis=2)
    J = whole * per_noise[: len(whole), :, None]
    patterns, which = np.unique(noise[: len(J)], axis=0, return_inverse=True)
    # A number without noise that scatters all the same fits into no group.
    if len(J) < MANY_BLOCKS or len(patterns) * _BLOCKS_A_GROUP > len(J) or whole[J == 0].any():
        return None
    component = np.repeat(np.arange(len(scattered)), [per_unit.shape[2] for per_unit in scattered])
    groups = []
    for k in range(len(patterns)):
        group = _group_of(J, np.flatnonzero(which.ravel() == k), component)
        if group is None:
            return None
        groups.append(group)
    scatter = sum(len(group.blocks) * group.turn.shape[1] for group in groups)
    log_units = float(np.log(noise[noise > 0]).sum() + np.log(known[known > 0]).sum())
    return CommonCovariance(groups, per_noise, per_known, int((noise > 0).sum()) - scatter, log_units)


def _group_of(J: Array, blocks: Indices, component: Indices) -> CovarianceGroup | None:
    """Return some blocks as a group whose covariance is diagonal in one system of axes for each; None if it is not.

    Args:
        J: (V, m, s) what a unit of scatter along each of s axes does to their numbers, in units of the noise.
        component: (s,) of each axis.
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
    of_components = [(root * (size**2 * (component == i))[:, None]).T @ root for i in range(component[-1] + 1)]
    turn = J[blocks] @ (vectors[:, keep] / np.sqrt(values[keep]) / size[:, None])
    return CovarianceGroup(blocks, turn.transpose(0, 2, 1), np.array([*of_components, np.eye(int(keep.sum()))]))
