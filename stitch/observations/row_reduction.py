"""Rows of many points in few numbers: six a view say all of its pose, and the rest is the sensor's noise.

A view errs in six ways, however many targets it shows. In units of the sensor's noise its rows are turned (QR) so that
the first numbers answer to a motion of the view, and all others to none: those have the noise alone, of one variance.
Places of targets that these alone show take as many of them, and say nothing of anything else. Of what is left, the
few directions that unknowns and effects of points still move are kept, and of all others their sum of squares: with
normal noise these statistics are sufficient, so that every likelihood is that of the rows (Harville 1977).
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from stitch.numerics.frames import Array, Mask
from stitch.numerics.least_squares import symmetric_inverse
from stitch.numerics.reml import flatten_blocks

# Of a column of unit length in its block, what is rounding.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class RowReduction:
    """An orthonormal map of rows (B, m), each divided by its sigma, to numbers (C, d), V blocks of views first."""

    per_sigma: Array  # (B, m) 1/sigma of each row, by the sensor's noise or a known variance; 0 of absent rows
    of_views: Array  # (V, d, m) orthonormal rows: d numbers of each view that say all of its pose
    beyond: Array  # (e, V·m) orthonormal rows: numbers that landmarks or effects of points change, no pose
    known: Mask  # (B, m) rows whose variance is known, as of nominal places: each a number by itself
    noise_only: tuple[int, float]  # count of further numbers that are noise alone, and their sum of squares
    points: csr_array  # (B·m, U) change of the rows, times `per_sigma`, per unknown of the landmarks
    kept: Array  # (U, r) combinations of these unknowns that poses or known rows depend on: the others are eliminated
    shares: Array  # (r, U) coefficients of these combinations, of the unknowns

    @property
    def blocks(self) -> int:
        """Number C of blocks of the reduced numbers."""
        views, size, _ = self.of_views.shape
        return views - (-(len(self.beyond) + int(self.known.sum())) // size)

    def reduce(self, rows: Array) -> Array:
        """Return the reduced numbers (C, d, P) of P columns of rows (B, m, P), each row in its own unit.

        There are m rows in each of B blocks: first those of the V views, then those of no view, as nominal places of
        targets. Every row is divided by its sigma. The numbers are, in turn,

        1. d of each view, which say all of its pose;
        2. e that mix views: landmarks and effects of points change them, no pose does (`beyond`);
        3. one of each row of known variance, of whatever block.

        They fill C = V + ⌈(e + rows of known variance)/d⌉ blocks, the last one with zeros. What is left of the rows
        places landmarks on which nothing else depends, or is noise alone, of which `noise_only` is all that a
        likelihood needs.
        """
        views = len(self.of_views)
        white = self.per_sigma[..., None] * rows
        own = flatten_blocks(self.of_views @ white[:views])
        across = self.beyond @ flatten_blocks(white[:views])
        return self._in_blocks(np.concatenate([own, across, white[self.known]]))

    def reduce_twists(self, rows: Array) -> Array:
        """Return the reduced numbers (C, d, P) of rows (V, m, P) that motions of the views cause."""
        return self._in_blocks(flatten_blocks(self.of_views @ (self.per_sigma[: len(rows), :, None] * rows)))

    def expand(self, numbers: Array) -> Array:
        """Return the shortest rows (B, m, P), divided by their sigmas, that `reduce` maps to numbers (C, d, P).

        What the places of eliminated targets do to the rows is not among them.
        """
        views, _, m = self.of_views.shape
        P = numbers.shape[2]
        out = np.zeros((*self.per_sigma.shape, P))
        out[:views] = self.of_views.transpose(0, 2, 1) @ numbers[:views]
        others = flatten_blocks(numbers[views:])
        across, e = others[: len(self.beyond)], len(self.beyond)
        if across.any():
            out[:views] += (self.beyond.T @ across).reshape(views, m, P)
        out[self.known] = others[e : e + int(self.known.sum())]
        return out

    @property
    def present(self) -> tuple[Array, Array]:
        """Return two (C, d) arrays of 0 and 1: where a number has the sensor's noise, and where its variance is 1.

        The second are the rows of known variance, in units of their sigma, and numbers that are absent.
        """
        of_views = self.of_views.any(axis=2).astype(float).reshape(-1, 1)
        noise = self._in_blocks(np.concatenate([of_views, np.ones((len(self.beyond), 1))]))[..., 0]
        return noise, 1 - noise

    def _in_blocks(self, numbers: Array) -> Array:
        """Return numbers (n, P) as blocks (C, d, P), n ≤ C·d, filled up with zeros."""
        size, P = self.of_views.shape[1], numbers.shape[1]
        out = np.zeros((self.blocks * size, P))
        out[: len(numbers)] = numbers
        return out.reshape(self.blocks, size, P)


def pose_numbers(lever: Array) -> Array:
    """Return per view d = min(m, 6) orthonormal rows of length m, (V, d, m), that span the columns of its lever.

    The last ones are zero in a view that shows less than six numbers of its pose.

    Args:
        lever: (V, m, 6) change of the m rows of a view per twist of it, each row divided by its sigma.
    """
    length = np.sqrt(np.maximum((lever**2).sum(axis=(0, 1)), 1e-300))
    basis, sizes, _ = np.linalg.svd(lever / length, full_matrices=False)
    shown = sizes > _ROUNDING * sizes.max(axis=1, initial=1e-300, keepdims=True)
    return np.ascontiguousarray((basis * shown[:, None]).transpose(0, 2, 1))


def reduction_of(
    residual: Array, lever: Array, unknowns: Array, noise: Array, known: Array, of_points: Array
) -> RowReduction:
    """Return the map of all rows to few numbers that are sufficient for poses, landmarks and effects of points.

    In units of the rows' sigmas:

    1. d numbers a view span what a motion of it changes.
    2. Combinations of landmarks that change none of these, nor rows of known variance, are eliminated.
    3. What is left of the other landmarks, and of effects, spans the directions `beyond`.
    4. All other directions are noise alone: only their count and sum of squares are kept.

    Args:
        residual: (B, m) of the rows; their units are squared in `noise` and `known`.
        lever: (V, m, 6) change of the rows of the first V blocks per twist of the view.
        unknowns: (B, m, U) change of the rows per unknown landmark.
        noise: (B, m) variance of the sensor; 0 where a row has none.
        known: (B, m) variance of rows that are no sensor's; 0 elsewhere, also where a row is absent.
        of_points: (B, m, P) change of the rows per parameter of effects that move points within a view.
    """
    (V, m, _), U = lever.shape, unknowns.shape[2]
    variance = noise + known
    per_sigma = np.where(variance > 0, variance, np.inf) ** -0.5
    # Step 1.
    of_views = pose_numbers(per_sigma[:V, :, None] * lever)
    pose_rows = by_view(of_views)
    # Step 2, with each landmark in units of its effect on all rows.
    points = csr_array(unknowns.reshape(-1, U)).multiply(per_sigma.reshape(-1, 1)).tocsr()
    in_views = points[: V * m]
    length = np.sqrt(points.multiply(points).sum(axis=0))
    per_length = np.where(length > 0, length, np.inf) ** -1
    shown = np.vstack([(pose_rows @ in_views).toarray(), points[V * m :].toarray()]) * per_length
    _, sizes, directions = np.linalg.svd(np.linalg.qr(shown, mode="r"))
    rank = int((sizes > _ROUNDING * sizes.max(initial=1e-300)).sum())
    kept, eliminated = per_length[:, None] * directions[:rank].T, per_length[:, None] * directions[rank:].T
    information = eliminated.T @ (in_views.T @ in_views @ eliminated)
    inverse = symmetric_inverse(information) if eliminated.size else information

    def rest(white: Array) -> Array:
        """Return columns (V·m, P) less what poses and eliminated landmarks can explain of them."""
        white = white - pose_rows.T @ (pose_rows @ white)
        return white - in_views @ (eliminated @ (inverse @ (eliminated.T @ (in_views.T @ white))))

    # Step 3.
    others = np.hstack([in_views @ kept, flatten_blocks((per_sigma[..., None] * of_points)[:V])])
    beyond = _row_space(rest(others), others)
    # Step 4: a number of every row that the sensor's noise has, less those that one of the first three took.
    noise_rows = rest((per_sigma * residual)[:V].reshape(-1, 1))[:, 0]
    noise_rows = noise_rows - beyond.T @ (beyond @ noise_rows)
    placed = np.linalg.matrix_rank(information, hermitian=True) if eliminated.size else 0
    count = int((noise[:V] > 0).sum() - of_views.any(axis=2).sum() - placed - len(beyond))
    noise_only = (count, float(noise_rows @ noise_rows) if count else 0.0)
    shares = directions[:rank] * length
    return RowReduction(per_sigma, of_views, beyond, known > 0, noise_only, points, kept, shares)


def by_view(of_views: Array) -> csr_array:
    """Return the block-diagonal sparse matrix (V·d, V·m) of V matrices (V, d, m)."""
    V, d, m = of_views.shape
    columns = np.broadcast_to((np.arange(V)[:, None] * m + np.arange(m))[:, None], (V, d, m))
    return csr_array((of_views.ravel(), columns.ravel(), np.arange(V * d + 1) * m), shape=(V * d, V * m))


def _row_space(rest: Array, whole: Array) -> Array:
    """Return orthonormal rows (e, n) that span the columns `rest` (n, P), without those that are rounding.

    Args:
        whole: (n, P) the same columns before something was projected out; they say what rounding is.
    """
    length = np.linalg.norm(rest, axis=0)
    is_left = length > _ROUNDING * np.linalg.norm(whole, axis=0)
    Q, R = np.linalg.qr(rest[:, is_left] / length[is_left])
    U, sizes, _ = np.linalg.svd(R)
    return np.ascontiguousarray((Q @ U[:, sizes > _ROUNDING * sizes.max(initial=1e-300)]).T)
