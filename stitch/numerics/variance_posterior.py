"""Variances with their uncertainty: averaged over their posterior, not plugged in at its maximum.

With few views a variance may well be zero at its maximum, and every sigma after it a lie. A covariance is linear in its
variances, so what counts is their posterior mean (REML likelihood times prior). The posterior has many modes: of errors
that look alike any one may be there and the others absent. So each variance is drawn in turn from all that it may be
while the others stand (Gibbs sampling on a grid; Ritter & Tanner 1992, J. Am. Stat. Assoc. 87:861), absent included,
and what counts is its mean there (Gelfand & Smith 1990, J. Am. Stat. Assoc. 85:398). Same random numbers every time.

How good an arm is, is one more thing that nobody knows before: one factor on the usual sizes of all its errors, drawn
with them (global and local scales; Carvalho, Polson & Scott 2010, Biometrika 97:465). An arm that shows no error of one
kind is then believed to have less of the others. Few views hardly say how good it is: there the factor is what data
sheets say of arms.

How well the scatter is known in a direction are Satterthwaite's degrees of freedom: the variance s of a combination of
what was seen is Σ λ_i s_i over the components of `reml.py`, whose estimates have the information ½ tr(P C_i P C_j).
An estimate of s of relative variance 2/ν is worth a χ² of ν degrees of freedom (Satterthwaite 1946; Kenward & Roger
1997, Biometrics 53:983).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag
from scipy.linalg.lapack import dpotrf, dtrtrs

from stitch.numerics.frames import Array
from stitch.numerics.least_squares import column_space
from stitch.numerics.reml import (
    NOISE,
    MixedModel,
    VarianceFit,
    flatten_blocks,
    log_density,
    prior_information,
    usual_variances,
    whitener,
)

# The largest number of degrees of freedom that is told: a variance is then as good as known.
_MANY = 1e4
# Rounds over all variances that count, and those before them that do not.
_ROUNDS, _BURN_IN = 32, 6
# From so many observations on a round takes longer and the variances are known better, so that fewer rounds do, but
# these at least; from the third number on the maximum alone must do.
_AMONG, _FEWEST, _NO_ROUNDS = 300, 4, 1_200
# The grid in log variances: below and above a variance that is usual, and its steps as a share of how
# well n numbers know a log variance, √(2/n), at most so long.
_BELOW, _ABOVE, _SHARE, _LONGEST = np.log(1e-4), np.log(1e8), 1.5, 0.25
# Factors on all usual sizes of an arm, from a hundredth to thirty, and the middle one: half of all arms are worse.
# Sizes of factor one put the flange of an arm of 1 to 2 m off by 0.2 to 0.3 mm rms. Data sheets and tests state 0.2 to
# 0.5 mm for calibrated arms of that reach, and 0.5 to 2 mm for others. The factor is half-Cauchy about the middle
# (Gelman 2006), so that the views decide where they can.
_FACTORS = np.exp(np.arange(np.log(0.01), np.log(30.0), 0.25))
_MIDDLE_FACTOR = 3.0
_LOG_FACTOR_DENSITY = np.log(_FACTORS / _MIDDLE_FACTOR) - np.log1p((_FACTORS / _MIDDLE_FACTOR) ** 2)
_USUAL = int(np.abs(np.log(_FACTORS / _MIDDLE_FACTOR)).argmin())
# Directions of a component with less than this share of its largest variance are rounding.
_ROUNDING = 1e-12


@dataclass(frozen=True)
class Satterthwaite:
    """Components of a covariance V = L Lᵀ, whitened, and how well their variances λ are known."""

    white: Array  # (c, B, m, m) λ_i L⁻¹C_iL⁻ᵀ: they sum to 1
    spread: Array  # (c, c) covariance of the log variances

    def degrees_of_freedom(self, white: Array) -> float:
        """Return Satterthwaite's degrees of freedom of the scatter in the space of whitened columns (B, m, p).

        2/ν = Σ_ij s_i s_j spread_ij, with s_i the share of component i in the variance, averaged over the space; ν is
        at most `_MANY`.
        """
        directions = column_space(white.reshape(-1, white.shape[2])).reshape(*white.shape[:2], -1)
        if not directions.shape[2]:
            return _MANY
        along = (directions @ directions.transpose(0, 2, 1)).ravel()
        shares = self.white.reshape(len(self.white), -1) @ along / directions.shape[2]
        return float(min(2 / max(shares @ self.spread @ shares, 2 / _MANY), _MANY))

    def of_each(self, white: Array) -> Array:
        """Return Satterthwaite's degrees of freedom (p,) of the scatter along each whitened column (B, m, p) alone.

        As `degrees_of_freedom`; `_MANY` for a column of zeros.
        """
        squares = np.sum(white**2, axis=(0, 1))
        shares = np.einsum("bmp,cbmp->cp", white, self.white @ white) / np.maximum(squares, 1e-300)
        known = 2 / np.maximum(np.sum(shares * (self.spread @ shares), axis=0), 2 / _MANY)
        return np.where(squares > 0, known, _MANY)


def satterthwaite(mixed: MixedModel, null: VarianceFit) -> Satterthwaite:
    """Return how well the variances of a fit are known, from REML's expected information and the prior's.

    With whitened components K_i it is ½ tr(M K_i M K_j), where M = 1 − UUᵀ projects out the mean's columns.

    Args:
        null: the fit without the columns whose degrees of freedom will be computed.
    """
    inverse_root = whitener(mixed, null.variances)
    white = null.variances[:, None, None, None] * (inverse_root @ mixed.components @ inverse_root.transpose(0, 2, 1))
    mean = inverse_root @ mixed.A
    U = column_space(mean.reshape(-1, mean.shape[2])).reshape(*mean.shape[:2], -1)
    KU = white @ U
    within = np.einsum("bik,cbil->ckl", U, KU, optimize=True)
    # ½ tr(M K_i M K_j), multiplied out: no product of whole blocks.
    information = 0.5 * (
        np.einsum("cbij,dbij->cd", white, white, optimize=True)
        - 2 * np.einsum("cbik,dbik->cd", KU, KU, optimize=True)
        + np.einsum("ckl,dkl->cd", within, within, optimize=True)
    )
    information[NOISE, NOISE] += 0.5 * mixed.noise_only[0]
    information += np.diag(prior_information(null.variances, mixed.further))
    return Satterthwaite(white, np.linalg.pinv(information, rcond=1e-9, hermitian=True))


@dataclass(frozen=True)
class _MeanFreeData:
    """Observations projected on the n directions in which the mean's columns are zero, as one block."""

    z: Array  # (n,)
    components: Array  # (c, n, n) of the covariance
    roots: list[Array]  # per component a square root (n, rank); rank 0: the component is zero
    fixed: Array  # (n, n) covariance that is known, added to the components


def mean_variances(mixed: MixedModel, fit: VarianceFit) -> Array:
    """Return posterior means (c,) of the variances, by Gibbs sampling on a grid of each, begun at their maximum.

    The prior says how large each error of an arm usually is. An arm may be worse than usual in all of them, so that one
    factor multiplies the usual sizes of these components together (`common_factor`). A round draws each variance given
    the others and the factor, then the factor given the variances. What is averaged over the rounds are the means of a
    variance over its grid; the first rounds do not count. A component that the mean's columns absorb has mean 0.

    The maximum itself is returned from `_NO_ROUNDS` observations on, where a round takes seconds, and where the mean
    leaves no observation over.

    Args:
        fit: the maximum of the restricted likelihood.
    """
    if mixed.size >= _NO_ROUNDS:
        return fit.variances
    data, rng = _remove_mean(mixed), np.random.default_rng(0)
    if not len(data.z):
        return fit.variances
    grids = _grids(mixed, fit.variances)
    priors = _log_priors(mixed, grids)
    drawn = [i for i, root in enumerate(data.roots) if root.shape[1]]
    with_factor = [i for i in drawn if len(priors[i]) > 1]
    variances, on_grid, factor = np.array(fit.variances), np.zeros(len(grids), int), _USUAL
    sums_of_means = np.zeros(len(grids))
    rounds = int(np.clip(_ROUNDS * (_AMONG / mixed.size) ** 3, _FEWEST, _ROUNDS))
    burn_in = -(-_BURN_IN * rounds // _ROUNDS)
    for number in range(burn_in + rounds):
        for i in drawn:
            weights = _grid_weights(data, variances, i, grids[i], priors[i][factor if i in with_factor else 0])
            on_grid[i] = rng.choice(len(weights), p=weights)
            variances[i] = grids[i][on_grid[i]]
            if number >= burn_in:
                sums_of_means[i] += float(weights @ grids[i])
        if with_factor:
            log_posterior = _LOG_FACTOR_DENSITY + np.sum([priors[i][:, on_grid[i]] for i in with_factor], axis=0)
            factor = int(rng.choice(len(_FACTORS), p=_normalised(log_posterior)))
    return sums_of_means / rounds


def _log_priors(mixed: MixedModel, grids: Sequence[Array]) -> list[Array]:
    """Return the log prior density of each variance on its grid (g,), for each of F factors on its usual size.

    They are (F, g), a row for each of `_FACTORS`, where the component shares the factor; else (1, g).
    """
    log_priors = []
    for i, grid in enumerate(grids):
        priors = [mixed.further]
        if mixed.further is not None and i > NOISE and mixed.further.common_factor[i - NOISE - 1]:
            priors = [mixed.further.scaled(factor) for factor in _FACTORS]
        log_priors.append(np.array([log_density(i, np.log(grid), prior) for prior in priors]))
    return log_priors


def _normalised(logs: Array) -> Array:
    """Return probabilities (n,) that sum to 1 from their logarithms, which are known up to a constant."""
    weights = np.exp(logs - logs.max())
    return weights / weights.sum()


def _remove_mean(mixed: MixedModel) -> _MeanFreeData:
    """Return the observations projected on the complement of the mean's columns: their likelihood is the restricted.

    All blocks are joined into one.
    """
    # The columns of U beyond the rank are orthogonal to the mean's columns.
    U, singular, _ = np.linalg.svd(column_space(flatten_blocks(mixed.A)), full_matrices=True)
    to_complement = U[:, singular.size :].T
    roots = []
    for blocks in mixed.components:
        C = to_complement @ (blocks[0] if len(blocks) == 1 else block_diag(*blocks)) @ to_complement.T
        values, vectors = np.linalg.eigh(C)
        keep = values > _ROUNDING * float(np.max(values, initial=1e-300))
        roots.append(vectors[:, keep] * np.sqrt(values[keep]))
    n = len(to_complement)
    fixed = np.zeros((n, n)) if mixed.fixed is None else to_complement @ block_diag(*mixed.fixed) @ to_complement.T
    return _MeanFreeData(to_complement @ mixed.z.ravel(), np.array([root @ root.T for root in roots]), roots, fixed)


def _grids(mixed: MixedModel, likeliest: Array) -> list[Array]:
    """Return per component the grid (g,) of variances that it is drawn from, in equal steps of the logarithm.

    Each spans `_BELOW` to `_ABOVE` about a usual variance; the first value stands for all smaller ones.

    Args:
        likeliest: (c,) variances at the maximum; that of the noise centres its grid.
    """
    # Scatter may be anything up to far above all that was seen: its grid is centred at 1e-4 of its share of Σz².
    usual = 1e-4 * usual_variances(mixed.z, mixed.components)
    usual[NOISE] = likeliest[NOISE]
    if mixed.further is not None:
        usual[NOISE + 1 :] = mixed.further.scales**2
    step = min(_LONGEST, _SHARE * float(np.sqrt(2 / mixed.size)))
    return [np.maximum(size, 1e-300) * np.exp(np.arange(_BELOW, _ABOVE, step)) for size in usual]


def _grid_weights(data: _MeanFreeData, variances: Array, i: int, grid: Array, log_prior: Array) -> Array:
    """Return the posterior probabilities (g,) of the values of variance i on its grid, given the other variances.

    V(λ) = V + (λ − λ_i) C = L (1 + (λ − λ_i) M) Lᵀ with M = L⁻¹ C L⁻ᵀ = R Rᵀ: one decomposition for the whole grid.
    With m and v eigenvalues and vectors of RᵀR, t = 1 + (λ − λ_i) m and a = vᵀRᵀL⁻¹z, the log likelihood is
    −½ Σ (log t + a²/m (1/t − 1)) up to a constant.

    Args:
        data: observations z, components C and square roots of these.
        variances: (c,) λ, of all components now.
        grid: (g,) values of variance i.
        log_prior: (g,) its log prior there.

    Raises:
        LinAlgError: the covariance is not positive.
    """
    covariance = data.fixed + np.tensordot(variances, data.components, axes=1)
    # LAPACK directly: what scipy does around these routines takes longer than they do.
    L, failed = dpotrf(covariance, lower=1, clean=0, overwrite_a=1)
    if failed:
        raise np.linalg.LinAlgError("covariance is not positive")
    white = dtrtrs(L, np.column_stack([data.roots[i], data.z]), lower=1)[0]
    R, z = white[:, :-1], white[:, -1]
    m, v = np.linalg.eigh(R.T @ R)
    m = np.maximum(m, 1e-300)
    a = v.T @ (R.T @ z)
    # Bounded, since by rounding the covariance could lose its last positive part.
    t = np.maximum(1 + (grid[:, None] - variances[i]) * m, 1e-12)
    return _normalised(log_prior - 0.5 * (np.log(t) + a**2 / m * (1 / t - 1)).sum(axis=1))
