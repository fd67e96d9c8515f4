"""Sums XᵀV⁻¹Y over blocks whose covariances are equal but for a rotation: made once, for all variances.

Where every view shows the same targets on its flange, the scatter of the flange moves them alike but for the flange's
orientation. A block is one view; its covariance is V_b = Σ_i λ_i C_ib, with variances λ and known components C.

*Turned numbers* of a block are its r coordinates along orthonormal axes that rotate with the flange. In them all blocks
of a group have one covariance (r, r); in all other directions there is sensor noise alone. So Σ_b X_bᵀV_b⁻¹Y_b is a sum
over the *pairs* (i ≤ j) of turned numbers: the entry ij of that one inverse, times Σ_b (x_bi y_bj + x_bj y_bi), which
does not depend on λ. Of t pairs in all, the last two stand for the noise alone and for numbers of known variance.
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
# Numbers of turned columns that are cached: 50 MB. Their products are small.
_CACHED_NUMBERS = 6_000_000


@dataclass(frozen=True, eq=False)
class SelectedColumns:
    """A selection of P columns (n, P) over the n numbers of all blocks."""

    whole: Array  # (n, P) all columns; sums are cached under the identity of this array: pass the same object each time
    keep: Mask | None = None  # (P,) those that are selected; None: all, and nothing of them is cached

    @property
    def columns(self) -> Array:
        """(n, p) the columns that are selected."""
        return self.whole if self.keep is None or self.keep.all() else self.whole[:, self.keep]

    @property
    def count(self) -> int:
        """p, the number of columns that are selected."""
        return self.whole.shape[1] if self.keep is None else int(self.keep.sum())

    @property
    def key(self) -> tuple[int | bytes, bytes]:
        """A key for dictionaries that equal selections share; of cached columns valid while `whole` is alive."""
        return (self.whole.tobytes(), b"") if self.keep is None else (id(self.whole), self.keep.tobytes())

    def of(self, values: Array, axis: int) -> Array:
        """Return the entries for the selected columns, from values that have one for each of the P along an axis."""
        return values if self.keep is None or self.keep.all() else values.compress(self.keep, axis)


@dataclass(frozen=True)
class CovarianceGroup:
    """n blocks whose turned numbers have one covariance Σ_i λ_i components[i], in units of the noise's sigma."""

    blocks: Indices  # (n,)
    turn: Array  # (n, r, m) orthonormal rows: turn @ numbers (m,) gives the r turned numbers
    components: Array  # (c, r, r) of the covariance of the turned numbers, the sensor's noise last


@dataclass(frozen=True)
class PairWeights:
    """The inverse covariance at some variances λ, as a weight of each pair of turned numbers, and traces of it."""

    logdet: float  # log det V of all blocks
    pairs: Array  # (t,) entry of V⁻¹ for each pair
    slopes: Array  # (c, t) −∂pairs/∂λ_i, the entries of V⁻¹C_iV⁻¹
    traces: Array  # (c,) tr(V⁻¹C_i)
    curvature: Array  # (c, c) tr(V⁻¹C_iV⁻¹C_j)


@dataclass(frozen=True)
class CommonCovariance:
    """B blocks of m numbers in groups of one covariance each, with a cache of sums over them."""

    groups: Sequence[CovarianceGroup]
    per_noise: Array  # (B, m) 1/σ of a unit of sensor noise; 0 where the number has none
    per_known: Array  # (B, m) 1/σ of numbers whose variance is known; 0 for all others
    noise_alone: int  # count of directions in all blocks with sensor noise alone
    logdet: float  # of the units: Σ log of all variances that `per_noise` and `per_known` divide by
    # Caches by id(whole) of a set of columns; the set itself is held in `_wholes`, so that no other takes its id.
    _wholes: dict[int, Array] = field(default_factory=dict, repr=False)
    _turned: dict[int, list[Array]] = field(default_factory=dict, repr=False)
    _sizes: dict[int, int] = field(default_factory=dict, repr=False)  # count of numbers in `_turned`
    _products: dict[tuple[int, int], Array] = field(default_factory=dict, repr=False)

    def weights(self, variances: Array) -> PairWeights:
        """Return the weights of all pairs at variances λ (c,), the sensor's noise last.

        A group of n blocks has W = (Σ λ_i C_i)⁻¹ (r, r) and, per component, the share W C_i. Its part of log det V is
        n log det W⁻¹, of tr(V⁻¹C_i) n tr(W C_i), of tr(V⁻¹C_iV⁻¹C_j) n tr(W C_i W C_j); ∂W/∂λ_i = −W C_i W. In all
        other directions V is the noise's variance λ. Where V has no inverse `logdet` is infinite, and the rest means
        nothing.
        """
        noise, count = variances[-1], len(variances)
        logdet = self.logdet + self.noise_alone * float(np.log(noise))
        pairs, slopes = list[Array](), list[Array]()
        traces, curvature = np.zeros(count), np.zeros((count, count))
        for group in self.groups:
            inverse = invert_covariance(np.tensordot(variances, group.components, axes=1)[None])
            W, n = inverse.matrix[0], len(group.blocks)
            shares = W @ group.components
            logdet += n * inverse.logdet
            # Pairs i ≤ j, row after row, in the order of `pair_products`.
            upper = np.triu_indices(len(W))
            pairs.append(W[upper])
            slopes.append((shares @ W)[:, *upper])
            traces += n * shares.trace(axis1=1, axis2=2)
            curvature += n * shares.reshape(count, -1) @ shares.transpose(0, 2, 1).reshape(count, -1).T
        # The last two pairs: noise alone, of which only the last component has some, and numbers of known variance.
        of_noise = np.arange(count) == count - 1
        traces[-1] += self.noise_alone / noise
        curvature[-1, -1] += self.noise_alone / noise**2
        slopes.append(np.column_stack([of_noise / noise**2, np.zeros(count)]))
        return PairWeights(logdet, np.concatenate([*pairs, [1 / noise, 1.0]]), np.hstack(slopes), traces, curvature)

    def products(self, a: SelectedColumns, b: SelectedColumns) -> Array:
        """Return the sums over blocks of products of columns a (p) and b (q), per pair of turned numbers: (t, p, q)."""
        if a.keep is None or b.keep is None:
            return pair_products(self.turned(a), self.turned(b))
        return b.of(a.of(self._cached_products(a.whole, b.whole), 1), 2)

    def weighted(self, pairs: Array, a: SelectedColumns, b: SelectedColumns) -> Array:
        """Return aᵀV⁻¹b (p, q) from weights of the pairs (t,); the products of columns are cached for other weights."""
        products = self._cached_products(a.whole, b.whole)
        return b.of(a.of((pairs @ products.reshape(len(pairs), -1)).reshape(products.shape[1:]), 0), 1)

    def _cached_products(self, a: Array, b: Array) -> Array:
        """Return the products (t, P, Q) of two whole sets of columns (n, P) and (n, Q), from the cache where they are.

        Both orders, ab and ba, are stored.
        """
        products = self._products.get((id(a), id(b)))
        if products is None:
            products = pair_products(self._cached(a), self._cached(b))
            back = np.ascontiguousarray(products.transpose(0, 2, 1))
            self._products.update({(id(a), id(b)): products, (id(b), id(a)): back})
        return products

    def turned(self, columns: SelectedColumns) -> list[Array]:
        """Return p columns of turned numbers: (p, r, n) of each group, then (p, 1, rows) of noise alone and of known.

        Rows are all numbers of all blocks, without their turned part, in units of their sigma.
        """
        if columns.keep is None:
            return self._turn(columns.whole)
        return [columns.of(part, 0) for part in self._cached(columns.whole)]

    def cache(self, wholes: Sequence[Array]) -> None:
        """Cache the turned numbers of several sets of columns (n, P), all of one product: many small ones take longer.

        A single set is turned when it is first asked for, and one whose products are cached needs it no more. Sets are
        known by their ids, which stay theirs since the cache holds the arrays.
        """
        new = [
            whole for whole in wholes if id(whole) not in self._turned and (id(whole), id(whole)) not in self._products
        ]
        if len(new) > 1:
            ends = np.cumsum([whole.shape[1] for whole in new])[:-1]
            # Turned columns come first: (p, r, n).
            parts = [np.split(part, ends) for part in self._turn(np.hstack(new))]
            for whole, *turned in zip(new, *parts, strict=True):
                self._cached(whole, turned)

    def _cached(self, whole: Array, turned: list[Array] | None = None) -> list[Array]:
        """Return the turned columns of a whole set (n, P), and cache them.

        Beyond `_CACHED_NUMBERS` the sets that were asked for longest ago leave the cache.

        Args:
            turned: the result, where the caller has it already.
        """
        turned = turned or self._turned.pop(id(whole), None) or self._turn(whole)
        self._wholes[id(whole)] = whole
        self._turned[id(whole)] = turned
        self._sizes[id(whole)] = sum(part.size for part in turned)
        # Python's dicts keep the order of insertion: the oldest come first. Copies and defaults, since several threads
        # share the cache.
        excess = sum(self._sizes.copy().values()) - _CACHED_NUMBERS
        for key in list(self._turned)[:-1]:
            if excess <= 0:
                break
            self._turned.pop(key, None)
            excess -= self._sizes.pop(key, 0)
        return turned

    def _turn(self, columns: Array) -> list[Array]:
        """Return columns (n, p) in turned numbers, in which all blocks of a group have one covariance.

        Returns:
            (p, r, n) of each group of n blocks; then (p, 1, rows) in the directions with noise alone; then (p, 1, rows)
            of numbers of known variance. All are in units of sigma.
        """
        X = columns.reshape(*self.per_noise.shape, columns.shape[1])
        white = self.per_noise[..., None] * X
        parts = []
        for group in self.groups:
            # What is taken into turned numbers leaves the rest, in which there is noise alone.
            turned = group.turn @ white[group.blocks]
            white[group.blocks] -= group.turn.transpose(0, 2, 1) @ turned
            parts.append(turned)
        alone = white if self.noise_alone else white[:0]
        known = (self.per_known[..., None] * X)[self.per_known.any(axis=1)]
        parts += [rest.reshape(len(rest) * rest.shape[1], 1, rest.shape[2]) for rest in (alone, known)]
        return [np.ascontiguousarray(part.transpose(2, 1, 0)) for part in parts]


@dataclass(frozen=True)
class MeanSums:
    """The a columns of a model's mean with the observations z as the last one, and sums of their products."""

    common: CommonCovariance
    sets: Sequence[SelectedColumns]  # a + 1 columns in all, z last
    known_products: Array | None = None  # the value of `products`, where it is known already

    @property
    def are_cached(self) -> bool:
        """True if products of these columns with others are cached."""
        return all(columns.keep is not None for columns in self.sets)

    @cached_property
    def products(self) -> Array:
        """(t, a + 1, a + 1) sums over blocks of products of the columns with each other, per pair of turned numbers."""
        if self.known_products is not None:
            return self.known_products
        return np.concatenate([self.products_with(columns) for columns in self.sets], axis=2)

    def products_with(self, columns: SelectedColumns) -> Array:
        """Return the sums over blocks (t, a + 1, p) of products with p other columns, per pair of turned numbers."""
        if columns.keep is None or not self.are_cached:
            return pair_products(self._turned, self.common.turned(columns))
        return np.concatenate([self.common.products(held, columns) for held in self.sets], axis=1)

    @cached_property
    def _turned(self) -> list[Array]:
        """The turned columns of all sets, as `CommonCovariance.turned`, joined group by group."""
        return [np.concatenate(parts) for parts in zip(*map(self.common.turned, self.sets), strict=True)]

    def products_with_further(self, sets: Sequence[SelectedColumns]) -> Array:
        """Return products (t, a + g + 1, a + g + 1) of all columns: a of the mean, g further ones, and z.

        Each is summed over blocks for one of the t pairs i ≤ j of turned numbers; weighted by the pairs' entries of V⁻¹
        (`PairWeights.pairs`) they add up to [X z]ᵀV⁻¹[X z].

        Args:
            sets: further columns, g in all.
        """
        if not sets:
            return self.products
        across = np.concatenate([self.products_with(columns) for columns in sets], axis=2)
        rows = [np.concatenate([self.common.products(one, other) for other in sets], axis=2) for one in sets]
        a, g = across.shape[1] - 1, across.shape[2]
        old, new = np.append(np.arange(a), a + g), slice(a, a + g)
        products = np.empty((len(across), a + g + 1, a + g + 1))
        products[:, old[:, None], old] = self.products
        products[:, old, new] = across
        products[:, new, old] = across.transpose(0, 2, 1)
        products[:, new, new] = np.concatenate(rows, axis=1)
        return products


def pair_products(X: Sequence[Array], Y: Sequence[Array]) -> Array:
    """Return the sums over blocks of products of k columns X and q columns Y, per pair of turned numbers: (t, k, q).

    Of a pair i < j it is Σ_b (x_bi y_bj + x_bj y_bi), since V⁻¹ is symmetric; of i = j, Σ_b x_bi y_bi.

    Args:
        X, Y: per group (k, r, n) and (q, r, n), as `CommonCovariance.turned` returns them.
    """
    out = []
    for x, y in zip(X, Y, strict=True):
        (k, r, n), q = x.shape, len(y)
        # Σ_b x_bi y_bj for all i and j: (r, r, k, q).
        products = (x.reshape(k * r, n) @ y.reshape(q * r, n).T).reshape(k, r, q, r).transpose(1, 3, 0, 2)
        for i in range(r):
            pairs = products[i, i:].copy()
            pairs[1:] += products[i + 1 :, i]
            out.append(pairs)
    return np.concatenate(out)


def common_covariance(scattered: Sequence[Array], noise: Array, known: Array) -> CommonCovariance | None:
    """Return B blocks of m numbers in groups of one covariance but for a rotation; None where they form none.

    None also where they are few, so that ordinary sums over blocks are as fast. Blocks of one group have the same
    `noise`; their scatter is held against each other by `_group_of`.

    Args:
        scattered: per component of scatter (V, m, 3), by how much a unit of it along each axis moves the numbers of the
            first V blocks; the others do not scatter.
        noise: (B, m) variance of a unit of sensor noise; 0 where a number has none.
        known: (B, m) variance that is known; 0 elsewhere.
    """
    per_noise = np.where(noise > 0, noise, np.inf) ** -0.5
    per_known = np.where(known > 0, known, np.inf) ** -0.5
    all_axes = np.concatenate(scattered, axis=2)
    J = all_axes * per_noise[: len(all_axes), :, None]
    patterns, pattern = np.unique(noise[: len(J)], axis=0, return_inverse=True)
    # A number without noise that scatters all the same fits into no group.
    if len(J) < MANY_BLOCKS or len(patterns) * _BLOCKS_A_GROUP > len(J) or all_axes[J == 0].any():
        return None
    component = np.repeat(np.arange(len(scattered)), [per_unit.shape[2] for per_unit in scattered])
    groups = []
    for k in range(len(patterns)):
        group = _group_of(J, np.flatnonzero(pattern.ravel() == k), component)
        if group is None:
            return None
        groups.append(group)
    turned_count = sum(len(group.blocks) * group.turn.shape[1] for group in groups)
    logdet = float(np.log(noise[noise > 0]).sum() + np.log(known[known > 0]).sum())
    return CommonCovariance(groups, per_noise, per_known, int((noise > 0).sum()) - turned_count, logdet)


def _group_of(J: Array, blocks: Indices, component: Indices) -> CovarianceGroup | None:
    """Return blocks as a group of one covariance but for a rotation; None if they are not, or imprecisely so.

    Scatter of unit size along s axes moves the numbers of block b by J_b. Where all J_bᵀJ_b = G are equal, the J_b
    differ by a rotation alone. With G = E Λ Eᵀ the rows of Λ^(−1/2) Eᵀ J_bᵀ are orthonormal: the axes of the turned
    numbers.

    Args:
        J: (V, m, s) in units of the noise's sigma.
        blocks: (n,) which of the V.
        component: (s,) index of the component of the covariance that each axis belongs to.
    """
    G = J[blocks].transpose(0, 2, 1) @ J[blocks]
    # Axes count in rad and length_unit: all is done in units in which G has a unit diagonal.
    size = np.sqrt(np.maximum(np.diag(G[0]), 1e-300))
    if (np.abs(G - G[0]) > _SAME * np.outer(size, size)).any():
        return None
    values, vectors = np.linalg.eigh(G[0] / np.outer(size, size))
    keep = values > _NO_DIRECTION * max(values[-1], 1e-300)
    if not (values[keep] > _PRECISE * values[-1]).all():
        return None
    root = np.sqrt(values[keep]) * vectors[:, keep]  # (s, r), axes of unit size
    of_components = [(root * (size**2 * (component == i))[:, None]).T @ root for i in range(component[-1] + 1)]
    turn = J[blocks] @ (vectors[:, keep] / np.sqrt(values[keep]) / size[:, None])
    return CovarianceGroup(blocks, turn.transpose(0, 2, 1), np.array([*of_components, np.eye(int(keep.sum()))]))
