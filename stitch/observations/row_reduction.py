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
        """Return reduced numbers (C, d, P) of rows (B, m, P): by view, of views together, and of known variance."""
        views = len(self.of_views)
        white = self.per_sigma[..., None] * rows
        own = flatten_blocks(self.of_views @ white[:views])
        across = self.beyond @ flatten_blocks(white[:views])
        return self._in_blocks(np.concatenate([own, across, white[self.known]]))

    def reduce_twists(self, rows: Array) -> Array:
        """Return numbers (C, d, P) of rows (V, m, P) that motions of the views make."""
        return self._in_blocks(flatten_blocks(self.of_views @ (self.per_sigma[: len(rows), :, None] * rows)))

    def expand(self, numbers: Array) -> Array:
        """Return rows (B, m, P) in units of their noise that have numbers (C, d, P), but for places of targets."""
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
        """(C, d) one where a number has the sensor's noise, and where its variance is known, 1, as of absent ones."""
        of_views = self.of_views.any(axis=2).astype(float).reshape(-1, 1)
        noise = self._in_blocks(np.concatenate([of_views, np.ones((len(self.beyond), 1))]))[..., 0]
        return noise, 1 - noise

    def _in_blocks(self, numbers: Array) -> Array:
        """(C, d, P) of the first numbers (n, P), the others absent."""
        size, P = self.of_views.shape[1], numbers.shape[1]
        out = np.zeros((self.blocks * size, P))
        out[: len(numbers)] = numbers
        return out.reshape(self.blocks, size, P)


def pose_numbers(lever: Array) -> Array:
    """Return orthonormal rows (V, d, m) that span what twists make of each view, (V, m, 6) in units of the noise.

    Of a view that shows less than its whole pose the last ones are zero.
    """
    length = np.sqrt(np.maximum((lever**2).sum(axis=(0, 1)), 1e-300))
    turned, sizes, _ = np.linalg.svd(lever / length, full_matrices=False)
    shown = sizes > _ROUNDING * sizes.max(axis=1, initial=1e-300, keepdims=True)
    return np.ascontiguousarray((turned * shown[:, None]).transpose(0, 2, 1))


def reduction_of(
    residual: Array, lever: Array, unknowns: Array, noise: Array, known: Array, of_points: Array
) -> RowReduction:
    """Return the reduction that keeps all that motions of views, unknowns and effects of points move.

    Args:
        residual: (B, m) what is left.
        lever: (V, m, 6) rows of the first V blocks per twist of the view.
        unknowns: (B, m, U) rows per unknown.
        noise: (B, m) variance of the sensor; 0 where a row has none.
        known: (B, m) variance that is known; 0 of absent rows and of those of the sensor.
        of_points: (B, m, P) rows per parameter of effects that move points within a view.
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
    shown = np.vstack([(turn @ in_views).toarray(), points[V * m :].toarray()]) * per_length
    _, sizes, directions = np.linalg.svd(np.linalg.qr(shown, mode="r"))
    rank = int((sizes > _ROUNDING * sizes.max(initial=1e-300)).sum())
    kept, alone = per_length[:, None] * directions[:rank].T, per_length[:, None] * directions[rank:].T
    shares = directions[:rank] * length
    information = alone.T @ (in_views.T @ in_views @ alone)
    of_alone = symmetric_inverse(information) if alone.size else information

    def rest(white: Array) -> Array:
        """(V·m, P) what neither poses nor targets that noise alone shows can make."""
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
    """(V·d, V·m) the rows of every view in its place."""
    V, d, m = of_views.shape
    columns = np.broadcast_to((np.arange(V)[:, None] * m + np.arange(m))[:, None], (V, d, m))
    return csr_array((of_views.ravel(), columns.ravel(), np.arange(V * d + 1) * m), shape=(V * d, V * m))


def _row_space(rest: Array, whole: Array) -> Array:
    """(e, n) orthonormal rows of what is left (n, P) of whole columns, rounding apart."""
    length = np.linalg.norm(rest, axis=0)
    there = length > _ROUNDING * np.linalg.norm(whole, axis=0)
    Q, R = np.linalg.qr(rest[:, there] / length[there])
    U, sizes, _ = np.linalg.svd(R)
    return np.ascontiguousarray((Q @ U[:, sizes > _ROUNDING * sizes.max(initial=1e-300)]).T)
