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
    """An orthonormal map of rows (B, m), in units of their noise, to numbers (C, d): V blocks of views, then others."""

    per_sigma: Array  # (B, m) one over the sigma of a row, the sensor's or one that is known; 0 of absent rows
    of_views: Array  # (V, d, m) what a motion of the view makes
    beyond: Array  # (e, V·m) what no motion makes, but unknowns and effects of points
    known: Mask  # (B, m) rows whose variance is known: each a number by itself
    noise_only: tuple[int, float]  # how many further numbers are noise alone, and their sum of squares
    points: csr_array  # (B·m, U) rows in those units per unknown of what is seen
    kept: Array  # (U, r) combinations of the unknowns that poses answer to; noise alone shows the others
    shares: Array  # (r, U) how much of each of these is in the unknowns

    @property
    def blocks(self) -> int:
        """C."""
        views, size, _ = self.of_views.shape
        return views - (-(len(self.beyond) + int(self.known.sum())) // size)

    def reduce(self, rows: Array) -> Array:
        """Return the reduced numbers (C, d, P) of P columns of rows (B, m, P).

        Every row is divided by its sigma. First come d numbers a view, then those that mix views (`beyond`), then one
        per row of known variance; zeros fill the last block.
        """
        views = len(self.of_views)
        white = self.per_sigma[..., None] * rows
        own = flatten_blocks(self.of_views @ white[:views])
        across = self.beyond @ flatten_blocks(white[:views])
        return self._in_blocks(np.concatenate([own, across, white[self.known]]))

    def reduce_twists(self, rows: Array) -> Array:
        """Return numbers (C, d, P) of rows (V, m, P) that motions of the views make."""
        return self._in_blocks(flatten_blocks(self.of_views @ (self.per_sigma[: len(rows), :, None] * rows)))

    def expand(self, numbers: Array) -> Array:
        """Return rows (B, m, P), divided by their sigmas, that `reduce` makes numbers (C, d, P) of: the shortest such.

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
    turned, sizes, _ = np.linalg.svd(lever / length, full_matrices=False)
    shown = sizes > _ROUNDING * sizes.max(axis=1, initial=1e-300, keepdims=True)
    return np.ascontiguousarray((turned * shown[:, None]).transpose(0, 2, 1))


def reduction_of(
    residual: Array, lever: Array, unknowns: Array, noise: Array, known: Array, of_points: Array
) -> RowReduction:
    """Return the map of all rows to few numbers that are sufficient for poses, landmarks and effects of points.

    In units of the rows' sigmas: d numbers a view span what its motion does; the landmarks that no pose depends on are
    eliminated (`alone`); of the rest the directions that other landmarks and effects move are kept (`beyond`). What is
    left over is noise alone, and only its sum of squares is kept.

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
    of_views = pose_numbers(per_sigma[:V, :, None] * lever)
    points = csr_array(unknowns.reshape(-1, U)).multiply(per_sigma.reshape(-1, 1)).tocsr()
    length = np.sqrt(points.multiply(points).sum(axis=0))
    per_length = np.where(length > 0, length, np.inf) ** -1
    turn = by_view(of_views)
    in_views = points[: V * m]
    # What landmarks do to poses and to known rows: combinations that do nothing there are seen by noise alone.
    shown = np.vstack([(turn @ in_views).toarray(), points[V * m :].toarray()]) * per_length
    _, sizes, directions = np.linalg.svd(np.linalg.qr(shown, mode="r"))
    rank = int((sizes > _ROUNDING * sizes.max(initial=1e-300)).sum())
    kept, alone = per_length[:, None] * directions[:rank].T, per_length[:, None] * directions[rank:].T
    shares = directions[:rank] * length
    information = alone.T @ (in_views.T @ in_views @ alone)
    of_alone = symmetric_inverse(information) if alone.size else information

    def rest(white: Array) -> Array:
        """Return columns (V·m, P), what poses and the landmarks `alone` can make projected out."""
        white = white - turn.T @ (turn @ white)
        return white - in_views @ (alone @ (of_alone @ (alone.T @ (in_views.T @ white))))

    seen = flatten_blocks((per_sigma[..., None] * of_points)[:V])
    beyond = _row_space(rest(np.hstack([in_views @ kept, seen])), np.hstack([in_views @ kept, seen]))
    left = rest((per_sigma * residual)[:V].reshape(-1, 1))[:, 0]
    left = left - beyond.T @ (beyond @ left)
    placed = np.linalg.matrix_rank(information, hermitian=True) if alone.size else 0
    count = int((noise[:V] > 0).sum() - of_views.any(axis=2).sum() - placed - len(beyond))
    return RowReduction(
        per_sigma, of_views, beyond, known > 0, (count, float(left @ left) if count else 0.0), points, kept, shares
    )


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
    there = length > _ROUNDING * np.linalg.norm(whole, axis=0)
    Q, R = np.linalg.qr(rest[:, there] / length[there])
    U, sizes, _ = np.linalg.svd(R)
    return np.ascontiguousarray((Q @ U[:, sizes > _ROUNDING * sizes.max(initial=1e-300)]).T)
