"""The restricted likelihood of variance components, with its slope, and its maximum.

    z = A·α + G·θ + noise,   cov(noise) = V = Σ_i λ_i C_i,   θ ~ N(0, S)

The α are free (integrated out with a flat prior: that is REML, Patterson & Thompson 1971, Harville 1977);
the θ have a prior of the size that is plausible (their integral is the evidence for the columns G). V is
block-diagonal in B blocks: one for the reduced observations of scans, one a view for labelled points
(`common_covariance`). What is believed of the variances λ before anything was seen comes first, then the
likelihood and its maximum: by Fisher scoring among many blocks, else by a search with its slope.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Self

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtri
from scipy.optimize import minimize
from scipy.special import betainc, betaln, expit

from stitch.numerics.common_covariance import (
    MANY_BLOCKS,
    CommonCovariance,
    MeanSums,
    PairWeights,
    SelectedColumns,
)
from stitch.numerics.frames import Array, Mask
from stitch.numerics.least_squares import CLEARLY_KNOWN, InverseCovariance, equilibrated, invert_covariance

# The component that is sensor noise; all others are scatter and errors of the arm. A gamma(2, 0) prior on their σ
# keeps the maximum off the boundary at zero, where every sigma after it would be too small, by about one standard
# error (Chung et al. 2013, Psychometrika 78:685).
NOISE = 2
# Of further components λ/s² of a scale s is a priori beta-prime(a/2, 1/2), with the tails of a half-Cauchy (Armagan,
# Clyde & Dunson 2011, NIPS 24). What may well be absent piles up at zero; with a = 1 it is the half-Cauchy of Gelman
# 2006, Bayesian Analysis 1:515, for what is there on every arm in some size. The density counts per log σ.
MAY_BE_ABSENT, ALWAYS_PRESENT = 0.1, 1.0
# The factor on the sensor's noise is 1 for white noise and grows with its correlation: a few, seldom hundreds.
# A weak log-normal prior decides where the views hardly can between sensor noise and scatter of the arm.
USUAL_NOISE_FACTOR, FACTOR_SPREAD = 2.0, 1.5
# More numbers than 41 views show: a second start would take too long.
_LARGE_BLOCK = 250
# Blocks that are held against the components at a time: as many as stay in a core's cache.
_IN_CACHE = 256
# Of the mean's information, columns of unit diagonal: directions below this share tell nothing.
_KNOWN = 1e-12
# The search, in log variance below and above the start; of the factor on the noise; and what stands for a variance of
# zero, which has no logarithm.
_SPAN = (32.0, 14.0)
_FACTORS = (float(np.log(0.3)), float(np.log(1e8)))
_ABSENT = 1e-300
# The second start of a fit: all variances but the noise's smaller by this, in the logarithm.
_NEARLY_ABSENT = 9.0
# The search ends where the deviance's slope is below the first; with thousands of numbers below the second: the
# curvature grows with their count, and 0.1 then costs the deviance less than 1e-5.
# Where further components may be absent, begun near the maximum, the third: their prior alone curves by 0.09, so that
# the deviance is missed by less than slope²/(2·0.09), 0.005.
_FLAT, _FLAT_AMONG_MANY, _FLAT_NEAR_MAXIMUM, MANY_NUMBERS = 1e-4, 0.1, 0.03, 1_000
# Scoring steps, their largest leap in a log variance, how often one is halved, and the deviance that is not worth
# another; rounding alone moves that of thousands of numbers by a tenth of the last.
_SCORINGS, _LEAP, _HALVINGS, _CONVERGED, _CONVERGED_AMONG_MANY = 20, 2.0, 4, 1e-5, 1e-3
# Deviance gained by a step that is the last one: another would gain a fiftieth of it at the most, as
# seen in the fits of 600 labelled poses; where a prior bends the slope it would gain more.
_LAST = 0.05
# Change of a variance, as a share of it, beyond which little of it would be left; and the curvature in its logarithm of
# one that is known to a tenth.
_NEARLY_NONE, _WELL_KNOWN = -0.8, 200.0


@dataclass(frozen=True)
class FurtherPrior:
    """Prior of the variances of f further components, those after scatter and noise, and of the scatter's."""

    scales: Array  # (f,) usual σ of each
    shapes: Array  # (f,) of the density near zero: MAY_BE_ABSENT or ALWAYS_PRESENT
    common_factor: Mask  # (f,) those that share an unknown factor on their usual σ
    scatter: tuple[float, float] | None = None  # usual σ of rotation and translation scatter; None: not known

    def select(self, keep: Mask) -> Self:
        """Return the prior of some components alone (f,)."""
        return replace(self, scales=self.scales[keep], shapes=self.shapes[keep], common_factor=self.common_factor[keep])

    def scaled(self, factor: float) -> Self:
        """Return the prior with all usual σ multiplied by a factor."""
        return replace(self, scales=factor * self.scales)


def log_prior(log_variances: Array, further: FurtherPrior | None) -> tuple[float, Array]:
    """Return −2 log of the prior density of the log variances (c,), up to a constant, and its gradient (c,).

    Of the scatter, before NOISE, a gamma(2, 0) prior on σ. Of the noise factor, at NOISE, a log-normal one. Of each
    further variance v, with usual σ s and shape a, v^(a/2) / (1 + v/s²)^((1 + a)/2).

    Args:
        further: prior of the components after NOISE; None: there are none.
    """
    factor_sigmas = (log_variances[NOISE] - np.log(USUAL_NOISE_FACTOR)) / FACTOR_SPREAD
    value = -float(log_variances[:NOISE].sum()) + factor_sigmas**2
    slope = -np.ones(len(log_variances))
    slope[NOISE] = 2 * factor_sigmas / FACTOR_SPREAD
    if further is not None:
        ratio = np.exp(log_variances[NOISE + 1 :]) / further.scales**2
        a = further.shapes
        value += float(((1 + a) * np.log1p(ratio) - a * log_variances[NOISE + 1 :]).sum())
        slope[NOISE + 1 :] = (1 + a) * ratio / (1 + ratio) - a
    return value, slope


def log_density(component: int, log_variances: Array, further: FurtherPrior | None) -> Array:
    """Return the log prior density (g,), up to a constant, of one component on a grid of log variances (g,).

    The grid has equal steps; its first point stands for all smaller variances, zero included. Scatter of known usual
    size has the prior of a further component that is always present.

    Args:
        component: index, NOISE or another.
        further: prior of the components after NOISE; None: there are none.
    """
    if component == NOISE:
        return -0.5 * ((log_variances - np.log(USUAL_NOISE_FACTOR)) / FACTOR_SPREAD) ** 2
    if further is None or (component < NOISE and further.scatter is None):
        return 0.5 * log_variances
    if component < NOISE and further.scatter is not None:
        scale = further.scatter[component]
        a = ALWAYS_PRESENT
    else:
        scale = float(further.scales[component - NOISE - 1])
        a = float(further.shapes[component - NOISE - 1])
    log_ratio = log_variances - 2 * np.log(scale)
    density = 0.5 * a * log_ratio - 0.5 * (1 + a) * np.log1p(np.exp(log_ratio))
    # The first point has half a step of its own, and all below it: x/(1 + x) has a beta distribution.
    below = betaln(0.5 * a, 0.5) + np.log(betainc(0.5 * a, 0.5, expit(log_ratio[0])))
    density[0] = np.logaddexp(density[0] - np.log(2), below - np.log(log_variances[1] - log_variances[0]))
    return density


def prior_information(variances: Array, further: FurtherPrior | None) -> Array:
    """Return the prior's information (c,) on the log variances at variances (c,): half the curvature of `log_prior`.

    The scatter's prior is linear in the log variance: it has none.
    """
    information = np.zeros(len(variances))
    information[NOISE] = 1 / FACTOR_SPREAD**2
    if further is not None:
        ratio = variances[NOISE + 1 :] / further.scales**2
        information[NOISE + 1 :] = 0.5 * (1 + further.shapes) * ratio / (1 + ratio) ** 2
    return information


def usual_variances(z: Array, components: Array) -> Array:
    """Return variances (c,) to begin a search with: a share of Σz² for each component, 1 for the noise factor.

    Args:
        z: (B, m) observations.
        components: (c, B, m, m) of their covariance.
    """
    traces = np.einsum("cbii->c", components)
    sum_of_squares = float((z**2).sum()) or 1e-24
    # Further components begin small: they grow where the observations ask for them.
    shares = np.where(np.arange(len(traces)) < NOISE, 0.25, 0.05)
    variances = shares * sum_of_squares / np.maximum(traces, 1e-300)
    variances[NOISE] = 1.0
    return variances


@dataclass(frozen=True)
class MixedModel:
    """The model z = A α + e, cov e = Σ_i λ_i C_i, of observations in B independent blocks of m numbers."""

    z: Array  # (B, m) observations
    A: Array  # (B, m, a) columns of the mean, with free coefficients α
    components: Array  # (c, B, m, m) C of unit rotation scatter, translation scatter, sensor noise, and further ones
    fixed: Array | None = None  # (B, m, m) covariance that is known, with 1 on the diagonal of absent numbers; added
    independent: int | None = None  # numbers that could err independently, if that is not all of them
    further: FurtherPrior | None = None  # of the c − 3 further components; None: there are none
    common: CommonCovariance | None = None  # of the same covariances, where many blocks have one but for a turn
    known_sums: MeanSums | None = None  # of A and z, where the model that this one extends has made them
    # How many further numbers, beside z, are nothing but the sensor's noise, and their sum of squares.
    noise_only: tuple[int, float] = (0, 0.0)

    @property
    def size(self) -> int:
        """The number of observations that could err independently: all of z, unless `independent` says fewer."""
        return int(self.z.size) if self.independent is None else self.independent

    def covariance(self, variances: Array) -> Array:
        """Return the covariance (B, m, m) of z for variances (c,): Σ λ_i C_i + fixed."""
        V = np.tensordot(variances, self.components, axes=1)
        return V if self.fixed is None else V + self.fixed

    @cached_property
    def sums(self) -> MeanSums:
        """Products of the columns of A, and of z as the last one, summed over blocks; needs `common`."""
        if self.known_sums is not None:
            return self.known_sums
        assert self.common is not None
        columns = (flatten_blocks(self.A), self.z.reshape(-1, 1))
        return MeanSums(self.common, [SelectedColumns(X, np.ones(X.shape[1], bool)) for X in columns])


@dataclass(frozen=True)
class FurtherColumns:
    """A mixed model with g further columns G of its mean, and sums of them that do not depend on a prior."""

    mixed: MixedModel
    sets: Sequence[SelectedColumns]

    @cached_property
    def G(self) -> Array:
        """(B, m, g) the further columns of all sets."""
        columns = [selected.columns for selected in self.sets]
        return np.hstack([np.zeros((self.mixed.z.size, 0)), *columns]).reshape(*self.mixed.z.shape, -1)

    @cached_property
    def Xz(self) -> Array:
        """(B, m, a + g + 1) all columns of the mean, and the observations z as the last."""
        return np.concatenate([self.mixed.A, self.G, self.mixed.z[..., None]], axis=2)

    @cached_property
    def products(self) -> Array:
        """(t, a + g + 1, a + g + 1) products of all per pair of turned numbers (`common_covariance`), as in `Xz`."""
        return self.mixed.sums.products_with_further(self.sets)

    def in_mean(self) -> MixedModel:
        """Return the mixed model with the further columns appended to those of its mean: A (B, m, a + g).

        Sums over blocks that are known already are handed on to it.
        """
        A = np.concatenate([self.mixed.A, self.G], axis=2)
        if self.mixed.common is None:
            return replace(self.mixed, A=A)
        *mean, z = self.mixed.sums.sets
        sums = MeanSums(self.mixed.common, [*mean, *self.sets, z], self.products)
        return replace(self.mixed, A=A, known_sums=sums)


@dataclass(frozen=True)
class ModelInformation:
    """What the information on further columns needs of a model, at the variances of a fit; X are the model's columns.

    The model has `common`: its blocks have one covariance but for a rotation.
    """

    mixed: MixedModel
    pairs: Array  # (t,) weight of every pair of turned numbers: entries of V⁻¹ (`common_covariance`)
    half: Array  # (a, r) square root of (XᵀV⁻¹X)⁻¹
    z_explained: Array  # (r,) halfᵀXᵀV⁻¹z

    def of(self, columns: SelectedColumns) -> tuple[Array, Array]:
        """Return I (g, g) and v (g,) of the log likelihood vᵀθ − ½ θᵀIθ of the coefficients θ of g further columns G.

        I = GᵀPG and v = GᵀPz with P = V⁻¹ − V⁻¹X(XᵀV⁻¹X)⁻¹XᵀV⁻¹: the model's own coefficients are free. Sums of the
        columns are cached.
        """
        common = self.mixed.sums.common
        # XᵀV⁻¹G of each set of the model's columns, and zᵀV⁻¹G as the last.
        *of_model, of_z = (common.weighted(self.pairs, columns_or_z, columns) for columns_or_z in self.mixed.sums.sets)
        explained = self.half.T @ np.concatenate(of_model)
        information = common.weighted(self.pairs, columns, columns) - explained.T @ explained
        return information, of_z[0] - explained.T @ self.z_explained


def model_information(mixed: MixedModel, fit: "VarianceFit") -> ModelInformation:
    """Return what the information on further columns needs of a model, at the variances of a fit.

    Args:
        mixed: a model with `common`.
        fit: of the model; further columns in it, behind the model's own, are disregarded.
    """
    a = mixed.A.shape[2]
    half, _ = _root_of_inverse(fit.sums[:a, :a])
    pairs = mixed.sums.common.weights(fit.variances).pairs
    return ModelInformation(mixed, pairs, half, half.T @ fit.sums[:a, -1])


@dataclass(frozen=True)
class RemlProblem:
    """A mixed model with further columns of its mean, and the prior of their coefficients."""

    mixed: MixedModel
    columns: FurtherColumns
    precision: Array  # (a + g,) 1/σ² of the prior, 0 of free coefficients
    offset: float  # log det of the prior covariance; 0 without a prior


def reml_problem(mixed: MixedModel, G: Array | FurtherColumns | None, prior: Array | None) -> RemlProblem:
    """Return the likelihood to be maximised, of a model with further columns of its mean.

    Args:
        G: (B, m, g), or the same prepared for several fits; None: no further columns.
        prior: (g,) standard deviations of their coefficients; None: they are free.
    """
    if not isinstance(G, FurtherColumns):
        G = FurtherColumns(mixed, () if G is None else (SelectedColumns(flatten_blocks(G)),))
    precision = np.zeros(sum(selected.count for selected in G.sets)) if prior is None else 1 / prior**2
    offset = 0.0 if prior is None else float(2 * np.log(prior).sum())
    return RemlProblem(G.mixed, G, np.append(np.zeros(mixed.A.shape[2]), precision), offset)


@dataclass(frozen=True)
class Likelihood:
    """The restricted likelihood at some variances, with the estimates of the mean's coefficients β there.

    X = [A, G] are all columns of the mean, M = XᵀV⁻¹X + the prior's precision, W = V⁻¹.
    """

    problem: RemlProblem
    log_variances: Array  # (c,) log λ
    deviance: float  # −2 log of the restricted likelihood times the prior of the log variances
    mean: Array  # (a + g,) β
    half: Array  # (a + g, r) square root of M⁻¹, the covariance of β
    errors: InverseCovariance | PairWeights  # V⁻¹
    sums: Array  # (a + g + 1, a + g + 1) [X z]ᵀV⁻¹[X z]
    of_variances: float  # the terms of the deviance that do not depend on X
    prior_slope: Array  # (c,) of −2 log prior of the log variances

    @property
    def covariance(self) -> Array:
        """(a + g, a + g) covariance of the mean's coefficients."""
        return self.half @ self.half.T

    @cached_property
    def slope(self) -> Array:
        """(c,) gradient of the deviance in the log variances; zero where V has no inverse.

        d/dλ_i = tr(P C_i) − rᵀWC_iWr with P = W − WX M⁻¹XᵀW and r = z − Xβ. Both terms are Σ (P − Wr rᵀW)∘C_i: one
        matrix `against` every component.
        """
        if not np.isfinite(self.errors.logdet):
            return np.zeros(len(self.log_variances))
        mixed, columns = self.problem.mixed, self.problem.columns
        k, r = self.half.shape
        # W·[X z]·half_and_rest = [WX·half, Wr]; with its transpose it gives WX M⁻¹XᵀW + Wr rᵀW.
        half_and_rest = np.zeros((k + 1, r + 1))
        half_and_rest[:-1, :-1] = self.half
        half_and_rest[:-1, -1] = -self.mean
        half_and_rest[-1, -1] = 1.0
        if isinstance(self.errors, PairWeights):
            subtracted = np.tensordot(columns.products, half_and_rest @ half_and_rest.T)
            slopes = self.errors.traces - self.errors.slopes @ subtracted
        else:
            blocks, m = mixed.z.shape
            slopes = np.zeros(len(mixed.components))
            for start in range(0, blocks, _IN_CACHE):
                at = slice(start, start + _IN_CACHE)
                W = self.errors.matrix[at]
                root = (flatten_blocks(W @ columns.Xz[at]) @ half_and_rest).reshape(len(W), m, -1)
                against = W - root @ root.transpose(0, 2, 1)
                slopes += mixed.components[:, at].reshape(len(slopes), -1) @ against.ravel()
        slopes = np.exp(self.log_variances) * slopes + self.prior_slope
        count, square = mixed.noise_only
        slopes[NOISE] += count - square / np.exp(self.log_variances[NOISE])
        return slopes

    @property
    def curvature(self) -> Array:
        """(c, c) approximate second derivatives of the deviance in the log variances, without the prior's.

        Their expectation, with V⁻¹ in place of P: λ_iλ_j tr(V⁻¹C_iV⁻¹C_j). For a single block the average of expected
        and observed ones, λ_iλ_j zᵀPC_iPC_jPz, which takes no product of matrices (Gilmour, Thompson & Cullis 1995,
        Biometrics 51:1440).
        """
        variances = np.exp(self.log_variances)
        if len(self.problem.mixed.z) == 1 and not isinstance(self.errors, PairWeights):
            return np.outer(variances, variances) * self._average_information
        if isinstance(self.errors, PairWeights):
            curvature = np.outer(variances, variances) * self.errors.curvature
        else:
            shares = variances[:, None, None, None] * (self.errors.matrix @ self.problem.mixed.components)
            count = len(variances)
            curvature = shares.reshape(count, -1) @ shares.transpose(0, 1, 3, 2).reshape(count, -1).T
        curvature[NOISE, NOISE] += self.problem.mixed.noise_only[0]
        return curvature

    @property
    def _average_information(self) -> Array:
        """(c, c) zᵀPC_iPC_jPz of a model of one block, with P = W − WX M⁻¹XᵀW."""
        assert isinstance(self.errors, InverseCovariance)
        X, W = self.problem.columns.Xz[0, :, :-1], self.errors.matrix[0]
        z = self.problem.mixed.z[0]
        # C_iPz, a row for each component: Pz is W times the residual.
        CPz = self.problem.mixed.components[:, 0] @ (W @ (z - X @ self.mean))
        WCPz = CPz @ W
        explained = WCPz @ X @ self.half
        return CPz @ WCPz.T - explained @ explained.T


def likelihood(log_variances: Array, problem: RemlProblem) -> Likelihood:
    """Return the restricted likelihood at log variances (c,).

    Its −2 log is log det V + log det M + log det S + (z − Xβ)ᵀV⁻¹(z − Xβ) + βᵀS⁻¹β − 2 log prior, with the prior
    covariance S of the further coefficients and M = XᵀV⁻¹X + S⁻¹. Where V has no inverse it is 1e300, with zero slope,
    which a search steps back from.
    """
    mixed, columns = problem.mixed, problem.columns
    with np.errstate(over="ignore"):
        variances = np.exp(log_variances)
    errors: InverseCovariance | PairWeights
    if mixed.common is not None and np.isfinite(variances).all():
        errors = mixed.common.weights(variances)
    else:
        errors = invert_covariance(mixed.covariance(variances))
    k = len(problem.precision)
    if not np.isfinite(errors.logdet):
        nothing = np.zeros((k + 1, k + 1))
        flat = np.zeros(len(log_variances))
        return Likelihood(problem, log_variances, 1e300, nothing[0, :k], nothing[:k, :k], errors, nothing, 1e300, flat)
    if isinstance(errors, PairWeights):
        sums = np.tensordot(errors.pairs, columns.products, axes=1)
    else:
        sums = np.zeros((k + 1, k + 1))
        for start in range(0, len(mixed.z), _IN_CACHE):
            at = slice(start, start + _IN_CACHE)
            white = flatten_blocks(errors.half[at] @ columns.Xz[at])
            sums += white.T @ white
    half, logdet_M = _root_of_inverse(sums[:k, :k] + np.diag(problem.precision))
    mean = half @ (half.T @ sums[:k, k])
    # Residuals z − Xβ are formed before they are squared where they can be: from `sums` alone digits cancel.
    to_residual = np.append(-mean, 1.0)
    if isinstance(errors, PairWeights):
        square = float(to_residual @ sums @ to_residual)
    else:
        residual = (flatten_blocks(columns.Xz) @ to_residual).reshape(*mixed.z.shape, 1)
        square = float(np.sum((errors.half @ residual) ** 2))
    square += float(mean @ (problem.precision * mean))
    prior, prior_slope = log_prior(log_variances, mixed.further)
    count, square_of_noise = mixed.noise_only
    of_variances = errors.logdet + prior + count * log_variances[NOISE] + square_of_noise / variances[NOISE]
    value = of_variances + logdet_M + problem.offset + square
    return Likelihood(problem, log_variances, value, mean, half, errors, sums, of_variances, prior_slope)


def _root_of_inverse(M: Array) -> tuple[Array, float]:
    """Return R (k, r) with R Rᵀ = M⁻¹ for a symmetric M (k, k), and log det M; both without directions near zero.

    Those are eigenvectors of M, scaled to unit diagonal, with eigenvalues below `_KNOWN`.
    """
    scaled, unit = equilibrated(M)
    L, failed = dpotrf(scaled, lower=1, clean=1)
    if not failed and len(L) and L.diagonal().min() > CLEARLY_KNOWN:
        root = np.asarray(dtrtri(L, lower=1)[0].T)
        logdet = 2 * float(np.log(L.diagonal()).sum())
    else:
        values, vectors = np.linalg.eigh(scaled)
        keep = values > _KNOWN
        root = vectors[:, keep] / np.sqrt(values[keep])
        logdet = float(np.log(values[keep]).sum())
    return unit[:, None] * root, logdet - 2 * float(np.log(unit).sum())


def deviance(log_variances: Array, problem: RemlProblem) -> tuple[float, Array]:
    """Return −2 log restricted likelihood (times the prior) at log variances (c,), and its slope (c,) in these."""
    at_variances = likelihood(log_variances, problem)
    return at_variances.deviance, at_variances.slope


def flatten_blocks(X: Array) -> Array:
    """Return (B, m, a) as (B·m, a); `reshape(-1, a)` does not know the rows where a is 0."""
    return X.reshape(X.shape[0] * X.shape[1], X.shape[2])


@dataclass(frozen=True)
class VarianceFit:
    """The maximum of a restricted likelihood over the variances, with the estimates of the mean's coefficients β."""

    variances: Array  # (c,) λ
    deviance: float  # −2 log of the restricted likelihood times the prior of the log variances
    mean: Array  # (a + g,) β
    covariance: Array  # (a + g, a + g) of β
    sums: Array  # (a + g + 1, a + g + 1) [X z]ᵀV⁻¹[X z] of the mean's columns X and the observations z
    of_variances: float = 0.0  # the terms of the deviance that do not depend on X

    def under_prior(self, prior: Array) -> Self:
        """Return mean, covariance and deviance at the same variances under another prior of the further coefficients.

        Args:
            prior: (g,) standard deviations of the last g coefficients; the others are free.
        """
        precision = np.append(np.zeros(len(self.mean) - len(prior)), prior**-2.0)
        half, logdet_M = _root_of_inverse(self.sums[:-1, :-1] + np.diag(precision))
        mean = half @ (half.T @ self.sums[:-1, -1])
        to_residual = np.append(-mean, 1.0)
        square = float(to_residual @ self.sums @ to_residual + mean @ (precision * mean))
        value = self.of_variances + logdet_M + 2 * float(np.log(prior).sum()) + square
        return replace(self, deviance=value, mean=mean, covariance=half @ half.T)


def fit_variances(
    mixed: MixedModel,
    G: Array | FurtherColumns | None = None,
    prior: Array | None = None,
    start: Array | None = None,
    both_starts: bool = False,
) -> VarianceFit:
    """Return the maximum of the restricted likelihood over the variances; a component that is zero has variance 0.

    Fisher scoring where it converges, else a search with gradients (L-BFGS-B).

    Args:
        G: (B, m, g) further columns of the mean; of the same ones asked several times, `FurtherColumns`.
        prior: (g,) standard deviations of their coefficients; None leaves them free.
        start: (c,) variances to begin with; None starts from the spread of z.
        both_starts: also begin from noise alone, where the likelihood may have a second maximum, and return the better
            one; disregarded for one large block, where it would take too long.
    """
    problem = reml_problem(mixed, G, prior)
    usual = usual_variances(mixed.z, mixed.components)
    first = np.log(np.maximum(usual if start is None else start, _ABSENT))
    is_noise = np.arange(len(first)) == NOISE
    is_large = len(mixed.z) == 1 and mixed.z.size > _LARGE_BLOCK and mixed.further is None
    starts = [first, first - _NEARLY_ABSENT * ~is_noise] if both_starts and not is_large else [first]
    flat = _FLAT if start is None or mixed.further is None else _FLAT_NEAR_MAXIMUM
    flat = _FLAT_AMONG_MANY if mixed.size > MANY_NUMBERS else flat
    bounds = [
        _FACTORS if noise else (centre - _SPAN[0], centre + _SPAN[1])
        for centre, noise in zip(np.log(usual), is_noise, strict=True)
    ]
    present = np.einsum("cbii->c", mixed.components) > 0
    bounds = [span if is_there else (np.log(_ABSENT),) * 2 for span, is_there in zip(bounds, present, strict=True)]
    options = {"ftol": 1e-9, "gtol": flat, "maxiter": 60}
    search = partial(minimize, deviance, args=(problem,), jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    fits = []
    for begin in starts:
        # Scoring has no bounds: begun within them, it would go once more where an earlier fit has ended beyond.
        maximum = fisher_scoring(problem, begin, flat) if present.all() else None
        if maximum is None:
            log_variances = search(np.clip(begin, *np.array(bounds).T)).x
            fits.append(_fit_at(np.where(present, np.exp(log_variances), 0.0), problem))
        else:
            fits.append(_fit_at(np.exp(maximum.log_variances), problem, maximum))
    return min(fits, key=lambda fit: fit.deviance)


def at_variances(
    mixed: MixedModel, variances: Array, G: Array | FurtherColumns | None = None, prior: Array | None = None
) -> VarianceFit:
    """Return the fit at given variances (c,), without a search: mean, covariance and deviance.

    Args:
        G: (B, m, g) further columns of the mean, or the same prepared for several fits; None: none.
        prior: (g,) standard deviations of their coefficients; None: they are free.
    """
    return _fit_at(np.asarray(variances), reml_problem(mixed, G, prior))


def _fit_at(variances: Array, problem: RemlProblem, solution: Likelihood | None = None) -> VarianceFit:
    """Return the fit at variances (c,), which may be zero.

    Args:
        solution: the likelihood there; None: it is computed.
    """
    solution = solution or likelihood(np.log(np.maximum(variances, _ABSENT)), problem)
    mean, covariance = solution.mean, solution.covariance
    return VarianceFit(variances, solution.deviance, mean, covariance, solution.sums, solution.of_variances)


def fisher_scoring(problem: RemlProblem, start: Array, flat: float) -> Likelihood | None:
    """Return the maximum by Fisher scoring: Newton steps with the expected curvature of the deviance.

    None where it does not converge within `_SCORINGS` steps, or a step halved `_HALVINGS` times does not improve: then
    the caller searches. None also for a few blocks, where a search is as fast. A quarter of the likelihoods that a
    search without curvature asks for are enough: seven for the surfaces of 18 views, three for thousands of targets.

    Args:
        start: (c,) log variances.
        flat: largest slope of the deviance in a log variance at which the iteration ends.
    """
    mixed = problem.mixed
    if 1 < len(mixed.z) < MANY_BLOCKS:
        return None
    negligible_gain = _CONVERGED_AMONG_MANY if mixed.size > MANY_NUMBERS else _CONVERGED
    current = likelihood(start, problem)
    for _ in range(_SCORINGS):
        if np.abs(current.slope).max() < flat:
            return current
        # By the quadratic model a step changes the deviance by half of slope · step.
        prior_curvature = 2 * prior_information(np.exp(current.log_variances), mixed.further)
        step = _scoring_step(current.curvature, current.slope, current.prior_slope, prior_curvature)
        gain = -0.5 * float(current.slope @ step)
        if gain < negligible_gain:
            return current
        for _ in range(_HALVINGS):
            trial = likelihood(current.log_variances + step, problem)
            if trial.deviance <= current.deviance + negligible_gain:
                break
            step /= 2
        else:
            return None
        current = trial
        if gain < _LAST and mixed.further is None and len(mixed.z) > 1:
            return current
    return None


def _scoring_step(curvature: Array, slope: Array, prior_slope: Array, prior_curvature: Array) -> Array:
    """Return a scoring step (c,) in the log variances, at most `_LEAP` in one.

    First a Newton step in the variances themselves, where scoring is exact if a single one decides. If it would make
    one negative, or take nearly all of one that is hardly known, that variance is small against the data. Then a step
    in the logarithms: there the likelihood of a small variance curves as much as it slopes.

    Args:
        curvature: (c, c) of the deviance in the log variances, without the prior's.
        slope: (c,) of the deviance in the log variances, with the prior's.
        prior_slope, prior_curvature: (c,) of −2 log prior in the log variances.
    """
    # Second derivatives in the variance, times its square, are those in the logarithm less the slope there. Of the
    # prior's the larger of both counts, so that the step goes downhill.
    with_prior = curvature + np.diag(np.maximum(prior_curvature - prior_slope, prior_curvature))
    relative_change = -np.linalg.solve(with_prior, slope)
    if (relative_change > np.where(with_prior.diagonal() > _WELL_KNOWN, -1.0, _NEARLY_NONE)).all():
        return np.maximum(np.log1p(relative_change), -_LEAP)
    likelihood_slope = np.maximum(slope - prior_slope, 0)
    step = -np.linalg.solve(curvature + np.diag(prior_curvature + likelihood_slope), slope).astype(float)
    return step * min(1.0, _LEAP / float(np.abs(step).max()))


def whitener(mixed: MixedModel, variances: Array) -> Array:
    """Return L⁻¹ (B, m, m) with cov z = L Lᵀ per block, at variances (c,): L⁻¹z has unit covariance."""
    return invert_covariance(mixed.covariance(variances)).half
