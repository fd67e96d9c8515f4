"""Least squares in unknowns of mixed units: columns are equilibrated first, what says nothing drops out."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve, qr
from scipy.linalg.lapack import dlauum, dpotrf, dpotrs, dtrtri
from scipy.sparse import csr_array
from scipy.special import ndtri

from stitch.numerics.frames import Array, Indices, Mask

# Where every column of a unit diagonal has more than this share of its root beside those before it, a Cholesky factor
# is as good as eigenvectors, and takes a tenth of the time.
CLEARLY_KNOWN = 1e-3
# Above this one it solves as well as they do.
_SOLVABLE = 1e-6
# Of so many rows singular values take ten times as long as eigenvalues of the columns' products. These, their squares,
# tell as well which combinations say something, unless one lies between.
_MANY_ROWS, _SAYS_SOMETHING, _SAYS_NOTHING = 1_000, 1e-8, 1e-12
# Of blocks of more numbers a library's loop takes a third of the time, of 264 a seventh.
_LARGE_BLOCK = 96
# Fewer estimates with a group left out say nothing about their spread.
_FEWEST = 4
# Anderson's share by which a step is lengthened: at most twice as far, or half as far where steps turn back.
_FARTHEST, _NEAREST = 1.0, -0.5


def equilibrated(matrix: Array) -> tuple[Array, Array]:
    """Return symmetric matrices M (..., k, k) scaled to unit diagonal, u_i M_ij u_j, and the units u (..., k).

    Unknowns of mixed units, rad, mm and per hour, then compare. Where the diagonal is zero, row and column become zero
    and the unit is 1.
    """
    diagonal = np.diagonal(matrix, axis1=-2, axis2=-1)
    shown = ~(diagonal <= 1e-300)  # NaN stays
    unit = 1 / np.sqrt(np.where(shown, diagonal, 1.0))
    scaled = matrix * unit[..., :, None] * unit[..., None, :]
    return np.where(shown[..., :, None] & shown[..., None, :], scaled, 0.0), unit


@dataclass(frozen=True)
class InverseCovariance:
    """The inverse of a covariance V that has B blocks of m numbers."""

    matrix: Array  # (B, m, m) V⁻¹
    half: Array  # (B, m, m) L⁻¹, lower, with V = L Lᵀ
    logdet: float  # of V; infinite where it has no inverse


def invert_covariance(V: Array) -> InverseCovariance:
    """Return the inverses of B covariances V (B, m, m), by Cholesky factors.

    Where one of them is not positive definite or not finite, `logdet` is infinite and the matrices mean nothing.
    """
    # A search or a leap that ran away ends among infinite variances.
    if not np.isfinite(V).all():
        return InverseCovariance(V, V, np.inf)
    # A view of which nothing is left has a block of no size, of which LAPACK complains on the terminal.
    if V.size == 0:
        return InverseCovariance(V, V, 0.0)
    if len(V) > 1 and V.shape[1] <= _LARGE_BLOCK:
        return _invert_blocks(V)
    singles = [_invert_single(block) for block in V]
    matrix, half = (np.concatenate([getattr(one, name) for one in singles]) for name in ("matrix", "half"))
    return InverseCovariance(matrix, half, sum(one.logdet for one in singles))


def _invert_single(V: Array) -> InverseCovariance:
    """Return the inverse of one covariance (m, m), by LAPACK, as B = 1 block; `logdet` infinite where it has none."""
    L, failed = dpotrf(V, lower=1, clean=1)
    if failed:
        return InverseCovariance(V[None], V[None], np.inf)
    half, _ = dtrtri(L, lower=1)
    lower, _ = dlauum(half, lower=1)
    # Above the diagonal all are zero.
    inverse = lower + lower.T
    np.fill_diagonal(inverse, lower.diagonal())
    return InverseCovariance(inverse[None], half[None], 2 * float(np.log(L.diagonal()).sum()))


def _invert_blocks(V: Array) -> InverseCovariance:
    """Return the inverses of many small covariances V (B, m, m); `logdet` is infinite where one has none.

    Column j of all Cholesky factors L at once, and row j of all L⁻¹: a library's loop over blocks takes five times as
    long.
    """
    m = V.shape[1]
    A = np.ascontiguousarray(V.transpose(1, 2, 0))
    L, half = np.zeros_like(A), np.zeros_like(A)  # blocks last
    for j in range(m):
        below = A[j:, j] - np.einsum("ikb,kb->ib", L[j:, :j], L[j, :j])
        if not (below[0] > 0).all():
            return InverseCovariance(matrix=V, half=V, logdet=np.inf)
        L[j:, j] = below / np.sqrt(below[0])
        half[j, :j] = -np.einsum("kb,kib->ib", L[j, :j], half[:j, :j]) / L[j, j]
        half[j, j] = 1 / L[j, j]
    half = np.ascontiguousarray(half.transpose(2, 0, 1))
    return InverseCovariance(half.transpose(0, 2, 1) @ half, half, 2 * float(np.log(np.einsum("iib->ib", L)).sum()))


@dataclass(frozen=True)
class BlockLeastSquares:
    """Weighted least squares for z = X·x + noise in B blocks of m numbers, with k unknowns x and a prior on them.

    Estimates weigh each number by its own variance alone, W = 1/diag(covariance) (working independence, Liang & Zeger
    1986). As long as effects are missing from X, the true errors are not the noise that the covariance says. Full
    weights would then trade millimetres at the targets for combinations of numbers that only look exact. The covariance
    of the estimates does count all correlations.
    """

    z: Array  # (B, m)
    X: Array  # (B, m, k)
    covariance: Array  # (B, m, m)
    precision: Array  # (k,) of the prior
    prior_vector: Array  # (k,) precision times the prior's middle

    @cached_property
    def _weights(self) -> Array:
        """(B, m) weights W of the numbers: 1 over the variance of each."""
        return 1 / np.einsum("bii->bi", self.covariance)

    @cached_property
    def _rows(self) -> Array:
        """(B, m, k + 1) the rows √W·[X, z]."""
        return np.concatenate([self.X, self.z[..., None]], axis=2) * np.sqrt(self._weights)[..., None]

    @cached_property
    def _sums(self) -> Array:
        """(k + 1, k + 1) Σ [X, z]ᵀW[X, z] over all blocks."""
        rows = self._rows.reshape(-1, self._rows.shape[2])
        return rows.T @ rows

    @property
    def information(self) -> Array:
        """(k, k) XᵀWX."""
        return self._sums[:-1, :-1]

    def solve(self, left_out: Array | Indices | None = None) -> Array:
        """Return the estimates (k,), fitted without some blocks, given by their indices; None: all count."""
        return self.solve_each([(self.precision, self.prior_vector)], left_out)[0]

    def solve_each(self, priors: Sequence[tuple[Array, Array]], left_out: Array | Indices | None = None) -> list[Array]:
        """Return the estimates (p,) under each of several priors, fitted without some blocks.

        Args:
            priors: of each, the precision (p,) and the precision times mean (p,) of the first p of the k unknowns; the
                others are not in the fit.
            left_out: indices of blocks; None: all blocks count.
        """
        sums = self._sums
        if left_out is not None:
            rows = self._rows[np.asarray(left_out, np.int64)].reshape(-1, len(sums))
            sums = sums - rows.T @ rows
        solutions = list[Array]()
        for precision, prior_vector in priors:
            p = len(precision)
            Q, vector = np.diag(precision), sums[:p, -1] + prior_vector
            # Units from all blocks: what the blocks left out alone show must count as small in the rest.
            unit = equilibrated(self._sums[:p, :p] + Q)[1]
            solutions.append(solve_in_units(sums[:p, :p] + Q, vector, unit))
        return solutions

    def estimates_covariance(self) -> Array:
        """Return the covariance (k, k) of the estimates, from the blocks' full covariance C: N⁻¹(XᵀWCWX + Q)N⁻¹.

        N = XᵀWX + Q, with Q the precision of the prior.
        """
        weighted = self.X * self._weights[..., None]
        spread = np.einsum("bmk,bmn,bnl->kl", weighted, self.covariance, weighted, optimize=True)
        inverse = self._inverse
        return inverse @ (spread + np.diag(self.precision)) @ inverse

    def shift_by_errors(self, errors: Array) -> Array:
        """Return how far q errors of the observations, (B, m, q), each move the k estimates: (k, q), N⁻¹XᵀW·errors."""
        return self._inverse @ np.einsum("bmk,bm,bmq->kq", self.X, self._weights, errors, optimize=True)

    @cached_property
    def _inverse(self) -> Array:
        """(k, k) inverse N⁻¹ of the normal matrix XᵀWX + Q of all blocks."""
        return _pseudo_inverse(*equilibrated(self.information + np.diag(self.precision)))


def solve_in_units(matrix: Array, vector: Array, unit: Array) -> Array:
    """Return x (k,) of matrix·x = vector (k,), by Cholesky where that is precise, else by a pseudo-inverse.

    Directions with almost no information have x = 0.

    Args:
        matrix: (k, k) symmetric.
        unit: (k,) of the unknowns, in which directions compare: see `equilibrated`.
    """
    scaled = matrix * np.outer(unit, unit)
    root, failed = dpotrf(scaled, lower=1, clean=0)
    if not failed and root.diagonal().min() > _SOLVABLE:
        return np.asarray(dpotrs(root, vector * unit, lower=1)[0] * unit)
    return _pseudo_inverse(scaled, unit) @ vector


def _pseudo_inverse(scaled: Array, unit: Array, relative: float = 1e-14) -> Array:
    """Return the pseudo-inverse (k, k) of a symmetric matrix: zero in directions of almost no information.

    Args:
        scaled: (k, k) the matrix in units of its unknowns, in which directions compare: unit_i M_ij unit_j.
        unit: (k,) of each unknown.
        relative: eigenvalues below this share of the largest count as zero.
    """
    values, vectors = np.linalg.eigh(scaled)
    shown = np.abs(values) > relative * np.abs(values).max(initial=0.0)
    vectors = vectors[:, shown] * unit[:, None]
    return (vectors / values[shown]) @ vectors.T


def generalised_fit(noise: Array, columns: Array, precision: Array) -> tuple[Array, Array]:
    """Return gain G (a, n) and covariance C (a, a) of the generalised least squares of z = columns·x + noise.

    The estimate is x = G z + C p, with p (a,) the prior's precision times its mean. Units may be mixed.

    Args:
        noise: (n, n) covariance, positive definite.
        columns: (n, a).
        precision: (a, a) of the prior of x.
    """
    weighted = cho_solve(cho_factor(noise, lower=True), columns)
    scaled, unit = equilibrated(columns.T @ weighted + precision)
    covariance = np.linalg.inv(scaled) * np.outer(unit, unit)
    return covariance @ weighted.T, covariance


def column_space(columns: Array, relative: float = 1e-9) -> Array:
    """Return an orthonormal basis (n, r) of the space of columns (n, K), each scaled to length 1 first.

    Args:
        relative: directions whose singular value is below this share of the largest are left out.
    """
    scaled = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    if len(scaled) > _MANY_ROWS:
        values, vectors = np.linalg.eigh(scaled.T @ scaled)
        says = values > _SAYS_SOMETHING
        if relative**2 <= _SAYS_NOTHING and (says | (values < _SAYS_NOTHING)).all():
            return scaled @ (vectors[:, says] / np.sqrt(values[says]))
    U, s, _ = np.linalg.svd(scaled, full_matrices=False)
    return U[:, s > relative * s[0]]


def fit_columns(columns: Array, values: Array) -> Array:
    """Return x (K,) that minimises |columns·x − values|, for columns (n, K) of mixed units and values (n,)."""
    scale = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    return np.linalg.lstsq(columns / scale, values, rcond=1e-10)[0] / scale


def symmetric_inverse(matrix: Array) -> Array:
    """Return the inverse (k, k) of a symmetric matrix of mixed units; zero in directions of almost no information."""
    return _pseudo_inverse(*equilibrated(matrix), relative=1e-10)


def summed_squares(blocks: Array) -> Array:
    """Return the covariance (n, n) of n numbers that V independent unit errors of k components move: Σ_v B_v B_vᵀ.

    One matrix product: with hundreds of views a sum over three indices takes a hundred times as long.

    Args:
        blocks: B (V, n, k).
    """
    wide = blocks.transpose(1, 0, 2).reshape(blocks.shape[1], -1)
    return wide @ wide.T


def less_group_means(rows: Array, group: Indices, weight: Array | None = None) -> Array:
    """Return rows (N, …) less the mean of the rows of the same group (N,), weighted by (N,); None: by 1."""
    flat = rows.reshape(len(rows), -1)
    of_group = csr_array((np.ones(len(rows)) if weight is None else weight, (group, np.arange(len(rows)))))
    means = (of_group @ flat) / np.maximum(of_group.sum(axis=1), 1e-300)[:, None]
    return (flat - means[group]).reshape(rows.shape)


def independent(base: Array, further: Array, sizes: Array, threshold: float) -> Mask:
    """Return a mask (P,) of the parameters that observations tell apart from those chosen before and from `base`.

    Parameters are chosen in the order of a QR factorisation with pivoting, the clearest first. One is chosen if its
    column at its plausible size is at least `threshold` sigmas long, less its projection on those before.

    Args:
        base: (N, a) columns of parameters that are in the model in any case, in units of the observations' sigma.
        further: (N, P) columns per unit of each parameter, in the same units.
        sizes: (P,) plausible sizes of the parameters.
    """
    # Pivoting among the rows of a first factor chooses the same; on all N rows scipy reserves N² numbers for it.
    rest = np.linalg.qr(project_out(base, further * sizes), mode="r")
    R, order = qr(rest, mode="r", pivoting=True)
    clear = np.abs(np.diag(R)) >= threshold
    chosen = np.zeros(further.shape[1], bool)
    chosen[order[: len(clear)][clear]] = True
    return chosen


def project_out(base: Array, columns: Array) -> Array:
    """Return `columns` (n, p) less their projection onto the column space of `base` (n, a)."""
    if not base.shape[1]:
        return columns
    U = column_space(base)
    return columns - U @ (U.T @ columns)


def mean_square_share(with_it: Array, without: Array) -> tuple[float, float]:
    """Return the ratio of the residual sums of squares of two models, and its standard error over samples.

    Ratio estimator: Σ with_it / Σ without, with the error from the samples' departures from it.

    Args:
        with_it: (G,) sum of squares of each sample, a group of views or one view, under the first model.
        without: (G,) the same under the second model.
    """
    share = float(with_it.sum() / max(without.sum(), 1e-300))
    spread = np.sum((with_it - share * without) ** 2) * len(without) / max(len(without) - 1, 1)
    return share, float(np.sqrt(spread) / max(without.sum(), 1e-300))


def significantly_smaller(squares: Array, others: Array, chance: float) -> bool:
    """Return True if one model's mean square over all views is significantly less than another's.

    Views where either is not finite do not count.

    Args:
        squares: (V,) mean square of each view under the one model.
        others: (V,) under the other.
        chance: probability of True where the models are equally good, one-sided, of a normal distribution.
    """
    seen = np.isfinite(squares) & np.isfinite(others)
    share, sigma = mean_square_share(squares[seen], others[seen])
    return bool(share < 1 - ndtri(1 - chance) * sigma)


def grouped_inflation(left_out: Array, covariance: Array) -> float:
    """Return the factor, at least 1, by which a covariance has to grow to be that of the jackknife.

    The jackknife's variance, (G − 1)/G Σ (estimate − mean)², over the model's, averaged over the eigenvectors of the
    covariance (Efron & Stein 1981). 1 where there are fewer than `_FEWEST` groups.

    Args:
        left_out: (G, K) estimates of K unknowns, each with one group of samples left out.
        covariance: (K, K) of the estimates by the model.
    """
    count = len(left_out)
    if count < _FEWEST:
        return 1.0
    scaled, unit = equilibrated(covariance)
    centred = (left_out - left_out.mean(axis=0)) * unit
    values, vectors = np.linalg.eigh(scaled)
    keep = values > 1e-9
    squares = (count - 1) / count * ((centred @ vectors[:, keep]) ** 2).sum(axis=0) / values[keep]
    return float(max(1.0, squares.mean()))


def anderson_step(step: Array, last_step: Array, last_taken: Array) -> Array:
    """Return the step (N,) to take by Anderson acceleration with a memory of one step, for fixed-point iterations.

    Corresponding points follow a view that moves, so that each step of point-to-plane matching leaves the same share
    of the way undone. Two steps in turn reveal that share, and the next one makes up for it (Anderson 1965; for ICP:
    Pavlov et al. 2018).

    Args:
        step: (N,) that the present iteration proposes, all components in one unit.
        last_step: (N,) that the iteration before proposed.
        last_taken: (N,) that was taken in its place.
    """
    change = step - last_step
    square = float(change @ change)
    share = 0.0 if square == 0 else float(np.clip(-(change @ step) / square, _NEAREST, _FARTHEST))
    return step + share * (last_taken + change)
