"""The restricted likelihood of variance components, with its slope.

    z = A·α + G·θ + noise,   cov(noise) = V = Σ_i λ_i C_i,   θ ~ N(0, S)

The α are free (integrated out with a flat prior: that is REML, Patterson & Thompson 1971, Harville 1977);
the θ have a prior of the size that is plausible (their integral is the evidence for the columns G). V is
block-diagonal in B blocks: one for the pose channel of scans, one a view for labelled points (`common_covariance`).
"""

from collections.abc import Iterator, Sequence
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
    PairWeights,
    SelectedColumns,
    pair_products,
)
from stitch.numerics.frames import Array, Mask
from stitch.numerics.least_squares import CLEARLY_KNOWN, InverseCovariance, equilibrated, invert_covariance

# What is believed of variance components before anything was seen: scatter, noise, and what may well be absent.

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


@dataclass(frozen=True)
class FurtherPrior:
    """What is believed of components beside scatter and noise, and of the size of scatter."""

    scales: Array  # (f,) that their σ usually has
    shapes: Array  # (f,) of the density near zero: MAY_BE_ABSENT or ALWAYS_PRESENT
    common_factor: Mask  # (f,) those that are large or small together
    scatter: tuple[float, float] | None = None  # that σ of rotation and translation usually has; None: not known

    def select(self, keep: Mask) -> Self:
        """Of some components alone (f,)."""
        return replace(self, scales=self.scales[keep], shapes=self.shapes[keep], common_factor=self.common_factor[keep])

    def scaled(self, factor: float) -> Self:
        """Where all are usually so many times as large."""
        return replace(self, scales=factor * self.scales)


def log_prior(log_variances: Array, further: FurtherPrior | None) -> tuple[float, Array]:
    """−2 log prior of the log variances (c,), and its slope."""
    off = (log_variances[NOISE] - np.log(USUAL_NOISE_FACTOR)) / FACTOR_SPREAD
    value, slope = -float(log_variances[:NOISE].sum()) + off**2, -np.ones(len(log_variances))
    slope[NOISE] = 2 * off / FACTOR_SPREAD
    if further is not None:
        over, a = np.exp(log_variances[NOISE + 1 :]) / further.scales**2, further.shapes
        value += float(((1 + a) * np.log1p(over) - a * log_variances[NOISE + 1 :]).sum())
        slope[NOISE + 1 :] = (1 + a) * over / (1 + over) - a
    return value, slope


def log_density(component: int, log_variances: Array, further: FurtherPrior | None) -> Array:
    """(g,) of one component at log variances (g,) in equal steps, up to a constant; its first stands for all below."""
    if component == NOISE:
        return np.asarray(-0.5 * ((log_variances - np.log(USUAL_NOISE_FACTOR)) / FACTOR_SPREAD) ** 2)
    if further is None or (component < NOISE and further.scatter is None):
        return 0.5 * log_variances
    if component < NOISE and further.scatter is not None:
        scale, a = further.scatter[component], ALWAYS_PRESENT
    else:
        scale, a = (float(own[component - NOISE - 1]) for own in (further.scales, further.shapes))
    over = log_variances - 2 * np.log(scale)
    out = 0.5 * a * over - 0.5 * (1 + a) * np.log1p(np.exp(over))
    # Half a step of its own, and all that is below it: a beta distribution of x/(1 + x).
    below = betaln(0.5 * a, 0.5) + np.log(betainc(0.5 * a, 0.5, expit(over[0])))
    out[0] = np.logaddexp(out[0] - np.log(2), below - np.log(log_variances[1] - log_variances[0]))
    return np.asarray(out)


def prior_information(variances: Array, further: FurtherPrior | None) -> Array:
    """(c,) what the prior alone knows of the log variances: half the curvature of `log_prior`."""
    out = np.zeros(len(variances))
    out[NOISE] = 1 / FACTOR_SPREAD**2
    if further is not None:
        over = variances[NOISE + 1 :] / further.scales**2
        out[NOISE + 1 :] = 0.5 * (1 + further.shapes) * over / (1 + over) ** 2
    return out


def usual_variances(z: Array, components: Array) -> Array:
    """(c,) where a search begins: what was seen, mostly scatter and noise.

    Args:
        z: (B, m) numbers that were seen.
        components: (c, B, m, m) of their covariance.
    """
    traces = np.einsum("cbii->c", components)
    spread = float((z**2).sum()) or 1e-24
    # What there is beside scatter and noise begins small: it is there only where the numbers ask for it.
    shares = np.where(np.arange(len(traces)) < NOISE, 0.25, 0.05)
    guess = np.asarray(shares * spread / np.maximum(traces, 1e-300))
    guess[NOISE] = 1.0
    return guess


# Blocks that are held against the components at a time: as many as stay in a core's cache.
_IN_CACHE = 256
# Of the mean's information, columns of unit diagonal: directions below this share tell nothing.
_KNOWN = 1e-12


@dataclass(frozen=True)
class MixedModel:
    """B blocks of m numbers that were seen, the columns of their mean and the components of their covariance."""

    z: Array  # (B, m)
    A: Array  # (B, m, a) columns of the free mean
    components: Array  # (c, B, m, m) of unit rotation scatter, translation scatter, sensor noise, and further ones
    fixed: Array | None = None  # (B, m, m) what is known of the covariance, and 1 on the diagonal of absent numbers
    independent: int | None = None  # numbers that could err independently, if that is not all of them
    further: FurtherPrior | None = None  # of the c − 3 further components; None: there are none
    common: CommonCovariance | None = None  # of the same covariances, where many blocks have one but for a turn

    @property
    def size(self) -> int:
        """Numbers in all."""
        return int(self.z.size) if self.independent is None else self.independent

    def covariance(self, variances: Array) -> Array:
        """(B, m, m) for variances (c,)."""
        V = np.einsum("c,cbij->bij", variances, self.components)
        return np.asarray(V if self.fixed is None else V + self.fixed)

    # Where blocks have one covariance: sums over them of everything in the mean, and of what was seen as the last one.

    @cached_property
    def sets(self) -> list[SelectedColumns]:
        """Columns of the mean, and what was seen as the last one."""
        every = flatten_blocks(self.A), self.z.reshape(-1, 1)
        return [SelectedColumns(own, np.ones(own.shape[1], bool)) for own in every]

    @property
    def are_kept(self) -> bool:
        """True if sums of all of them are kept."""
        return all(own.keep is not None for own in self.sets)

    @cached_property
    def products(self) -> Array:
        """(t, a + 1, a + 1) products of all of them."""
        return np.concatenate([self.products_with(own) for own in self.sets], axis=2)

    def products_with(self, own: SelectedColumns) -> Array:
        """(t, a + 1, p) their products with other columns."""
        assert self.common is not None
        if own.keep is None or not self.are_kept:
            return pair_products(self._turned, self.common.turned(own))
        return np.concatenate([self.common.products(held, own) for held in self.sets], axis=1)

    @cached_property
    def _turned(self) -> list[Array]:
        assert self.common is not None
        return [np.concatenate(parts) for parts in zip(*map(self.common.turned, self.sets), strict=True)]


@dataclass(frozen=True)
class FurtherColumns:
    """A mixed model and g further columns of its mean, with what any prior of their coefficients has in common."""

    mixed: MixedModel
    sets: Sequence[SelectedColumns]

    @cached_property
    def G(self) -> Array:
        """(B, m, g) all of them."""
        every = [own.columns for own in self.sets]
        return np.hstack([np.zeros((self.mixed.z.size, 0)), *every]).reshape(*self.mixed.z.shape, -1)

    @cached_property
    def Xz(self) -> Array:
        """(B, m, a + g + 1) all columns of the mean, and what was seen as the last one."""
        return np.concatenate([self.mixed.A, self.G, self.mixed.z[..., None]], axis=2)

    @cached_property
    def with_model(self) -> Array:
        """(t, a + 1, g) products of the model's columns, and of what was seen, with the further ones."""
        if not self.sets:
            return self.mixed.products[:, :, :0]
        return np.concatenate([self.mixed.products_with(own) for own in self.sets], axis=2)

    @cached_property
    def with_each_other(self) -> Array:
        """(t, g, g) products of the further ones."""
        common, sets = self.mixed.common, self.sets
        assert common is not None
        if not sets:
            return self.mixed.products[:, :0, :0]
        rows = [np.concatenate([common.products(one, other) for other in sets], axis=2) for one in sets]
        return np.concatenate(rows, axis=1)

    @cached_property
    def products(self) -> Array:
        """(t, a + g + 1, a + g + 1) products of all, in the order of `Xz`."""
        if not self.sets:
            return self.mixed.products
        a, g = self.mixed.A.shape[2], self.with_model.shape[2]
        old, new = np.append(np.arange(a), a + g), slice(a, a + g)
        every = np.empty((len(self.with_model), a + g + 1, a + g + 1))
        every[:, old[:, None], old] = self.mixed.products
        every[:, old, new] = self.with_model
        every[:, new, old] = self.with_model.transpose(0, 2, 1)
        every[:, new, new] = self.with_each_other
        return every

    def in_mean(self) -> MixedModel:
        """The model where they are columns of the free mean as well."""
        whole = replace(self.mixed, A=np.concatenate([self.mixed.A, self.G], axis=2))
        if self.mixed.common is not None:
            # What the new model would sum anew.
            *mean, seen = self.mixed.sets
            vars(whole).update(sets=[*mean, *self.sets, seen], products=self.products)
        return whole


@dataclass(frozen=True)
class ModelInformation:
    """What a model whose blocks have one covariance holds against further columns, at the variances of a fit of it."""

    mixed: MixedModel
    pairs: Array  # (t,) what every pair of turned numbers counts
    half: Array  # (a, r) square root of the covariance of its own coefficients
    seen: Array  # (r,) halfᵀXᵀV⁻¹z

    def of(self, own: SelectedColumns) -> tuple[Array, Array]:
        """What is told of the coefficients θ of further columns that are kept, beside the model: (g, g) and (g,) of the
        log likelihood vᵀθ − ½ θᵀIθ."""
        common = self.mixed.common
        assert common is not None
        *mean, seen = (common.weighted(self.pairs, held, own) for held in self.mixed.sets)
        known = self.half.T @ np.concatenate(mean)
        return common.weighted(self.pairs, own, own) - known.T @ known, seen[0] - known.T @ self.seen


def model_information(mixed: MixedModel, fit: "VarianceFit") -> ModelInformation:
    """At the variances of a fit, with or without further columns."""
    assert mixed.common is not None
    a = mixed.A.shape[2]
    half, _ = _root_of_inverse(fit.sums[:a, :a])
    return ModelInformation(mixed, mixed.common.weights(fit.variances).pairs, half, half.T @ fit.sums[:a, -1])


@dataclass(frozen=True)
class RemlProblem:
    """A mixed model with further columns of its mean, and their prior."""

    columns: FurtherColumns
    precision: Array  # (a + g,) of the prior
    offset: float  # log det of the prior covariance

    @property
    def mixed(self) -> MixedModel:
        """The model without them."""
        return self.columns.mixed


def reml_problem(mixed: MixedModel, G: Array | FurtherColumns | None, prior: Array | None) -> RemlProblem:
    """With further columns G (B, m, g) and the standard deviations (g,) of their coefficients, if these have any."""
    if not isinstance(G, FurtherColumns):
        G = FurtherColumns(mixed, () if G is None else (SelectedColumns(flatten_blocks(G)),))
    known = np.zeros(sum(own.count for own in G.sets)) if prior is None else 1 / prior**2
    offset = 0.0 if prior is None else float(2 * np.log(prior).sum())
    return RemlProblem(G, np.append(np.zeros(mixed.A.shape[2]), known), offset)


@dataclass(frozen=True)
class Likelihood:
    """The restricted likelihood at some variances, and what is best believed of the mean there."""

    problem: RemlProblem
    log_variances: Array  # (c,)
    deviance: float  # −2 log of it, and of the prior of the log variances
    mean: Array  # (a + g,) coefficients
    half: Array  # (a + g, r) square root of their covariance
    errors: InverseCovariance | PairWeights  # of the numbers
    sums: Array  # (a + g + 1, a + g + 1) XzᵀV⁻¹Xz of the mean's columns and what was seen

    @property
    def covariance(self) -> Array:
        """(a + g, a + g) of the coefficients."""
        return self.half @ self.half.T

    @cached_property
    def slope(self) -> Array:
        """(c,) of the deviance in the log variances; it takes as long as the deviance itself.

        d/dλ_i = tr(P C_i) − rᵀWC_iWr with P = W − WX M⁻¹ XᵀW: one matrix against every component.
        """
        if not np.isfinite(self.errors.logdet):
            return np.zeros(len(self.log_variances))
        variances, mixed = np.exp(self.log_variances), self.problem.mixed
        k, r = self.half.shape
        half_and_rest = np.zeros((k + 1, r + 1))
        half_and_rest[:-1, :-1], half_and_rest[:-1, -1], half_and_rest[-1, -1] = self.half, -self.mean, 1.0
        if isinstance(self.errors, PairWeights):
            taken = np.tensordot(self.problem.columns.products, half_and_rest @ half_and_rest.T)
            own = self.errors.traces - self.errors.slopes @ taken
        else:
            own = self._block_slopes(self.errors.matrix, half_and_rest)
        return np.asarray(variances * own + log_prior(self.log_variances, mixed.further)[1])

    def _block_slopes(self, W: Array, half_and_rest: Array) -> Array:
        """(c,) tr(P C_i) − rᵀWC_iWr, blocks by blocks."""
        mixed = self.problem.mixed
        (blocks, m), own = mixed.z.shape, np.zeros(len(mixed.components))
        for at in _portions(blocks):
            taken = (flatten_blocks(W[at] @ self.problem.columns.Xz[at]) @ half_and_rest).reshape(len(W[at]), m, -1)
            against = W[at] - taken @ taken.transpose(0, 2, 1)
            own += mixed.components[:, at].reshape(len(own), -1) @ against.ravel()
        return own

    @property
    def curvature(self) -> Array:
        """(c, c) expected of the deviance, but for what the mean takes: λ_iλ_j tr(V⁻¹C_iV⁻¹C_j)."""
        variances = np.exp(self.log_variances)
        if isinstance(self.errors, PairWeights):
            return np.asarray(np.outer(variances, variances) * self.errors.curvature)
        shares = variances[:, None, None, None] * (self.errors.matrix @ self.problem.mixed.components)
        count = len(variances)
        return np.asarray(shares.reshape(count, -1) @ shares.transpose(0, 1, 3, 2).reshape(count, -1).T)


def _portions(blocks: int) -> Iterator[slice]:
    return (slice(start, start + _IN_CACHE) for start in range(0, blocks, _IN_CACHE))


def likelihood(log_variances: Array, problem: RemlProblem) -> Likelihood:
    """Evaluate it; infinitely unlikely, flat, where the covariance has no inverse."""
    with np.errstate(over="ignore"):
        mixed, variances = problem.mixed, np.exp(log_variances)
    k, errors = len(problem.precision), _errors_at(mixed, variances)
    if not np.isfinite(errors.logdet):
        mean, half = np.zeros(k), np.zeros((k, k))
        return Likelihood(problem, log_variances, 1e300, mean, half, errors, np.zeros((k + 1, k + 1)))
    sums = _sums_of_columns(problem, errors)
    half, of_information = _root_of_inverse(sums[:k, :k] + np.diag(problem.precision))
    mean = half @ (half.T @ sums[:k, k])
    # zᵀP z with P = (V + G S Gᵀ)⁻¹ projected: (z − Xβ)ᵀV⁻¹(z − Xβ) + βᵀQβ.
    square = _square_of_rest(problem, errors, sums, np.append(-mean, 1.0)) + float(mean @ (problem.precision * mean))
    value = errors.logdet + of_information + problem.offset + square + log_prior(log_variances, mixed.further)[0]
    return Likelihood(problem, log_variances, value, mean, half, errors, sums)


def _errors_at(mixed: MixedModel, variances: Array) -> InverseCovariance | PairWeights:
    if mixed.common is not None and np.isfinite(variances).all():
        return mixed.common.weights(variances)
    return invert_covariance(mixed.covariance(variances))


def _sums_of_columns(problem: RemlProblem, errors: InverseCovariance | PairWeights) -> Array:
    """(a + g + 1, a + g + 1) XzᵀV⁻¹Xz."""
    k = len(problem.precision) + 1
    if isinstance(errors, PairWeights):
        return np.tensordot(errors.pairs, problem.columns.products, axes=1)
    sums = np.zeros((k, k))
    for at in _portions(len(problem.mixed.z)):
        white = flatten_blocks(errors.half[at] @ problem.columns.Xz[at])
        sums += white.T @ white
    return sums


def _square_of_rest(
    problem: RemlProblem, errors: InverseCovariance | PairWeights, sums: Array, of_rest: Array
) -> float:
    """rᵀV⁻¹r of what the mean leaves, with its combination (a + g + 1,) of the columns."""
    if isinstance(errors, PairWeights):
        return float(of_rest @ sums @ of_rest)
    rest = (flatten_blocks(problem.columns.Xz) @ of_rest).reshape(*problem.mixed.z.shape, 1)
    return float(np.sum((errors.half @ rest) ** 2))


def _root_of_inverse(M: Array) -> tuple[Array, float]:
    """R (k, r) with R Rᵀ = M⁻¹ for M (k, k), and log det M; both without directions that nothing tells of."""
    scaled, unit = equilibrated(M)
    L, failed = dpotrf(scaled, lower=1, clean=1)
    if not failed and len(L) and np.diag(L).min() > CLEARLY_KNOWN:
        own, logdet = np.asarray(dtrtri(L, lower=1)[0].T), 2 * float(np.log(np.diag(L)).sum())
    else:
        values, vectors = np.linalg.eigh(scaled)
        keep = values > _KNOWN
        own, logdet = vectors[:, keep] / np.sqrt(values[keep]), float(np.log(values[keep]).sum())
    return unit[:, None] * own, logdet - 2 * float(np.log(unit).sum())


def deviance(log_variances: Array, problem: RemlProblem) -> tuple[float, Array]:
    """−2 log restricted likelihood and its slope in the log variances."""
    here = likelihood(log_variances, problem)
    return here.deviance, here.slope


def flatten_blocks(X: Array) -> Array:
    """(B·m, a) of (B, m, a); a model that is only judged has no columns."""
    return X.reshape(X.shape[0] * X.shape[1], X.shape[2])


# Fisher scoring of variance components, where their maximum lies near.

# Scoring steps, their largest leap in a log variance, how often one is halved, the deviance that is not worth another
# (rounding alone moves that of thousands of numbers by a tenth of it).
_SCORINGS, _LEAP, _HALVINGS, _CONVERGED = 20, 2.0, 4, 1e-3
# Deviance gained by a step that is the last one: another would gain a fiftieth of it at the most, as
# seen in the fits of 600 labelled poses; where a prior bends the slope it would gain more.
_LAST = 0.05
# Change of a variance, as a share of it, beyond which little of it would be left; and the curvature in its logarithm of
# one that is known to a tenth.
_NEARLY_NONE, _WELL_KNOWN = -0.8, 200.0


def fisher_scoring(problem: RemlProblem, start: Array, flat: float) -> tuple[Array, Likelihood] | None:
    """(c,) log variances at the maximum by Fisher scoring, where it lies near; None where a search must look for it.

    The expected curvature of the deviance is λ_iλ_j tr(V⁻¹C_iV⁻¹C_j), less what the mean takes. With thousands of
    numbers in small blocks three steps do what a search without curvature needs sixteen for.
    """
    mixed = problem.mixed
    if len(mixed.z) < MANY_BLOCKS:
        return None
    x, here = start, likelihood(start, problem)
    for _ in range(_SCORINGS):
        if np.abs(here.slope).max() < flat:
            return x, here
        variances = np.exp(x)
        prior = log_prior(x, mixed.further)[1], 2 * prior_information(variances, mixed.further)
        step = _scoring_step(here.curvature, here.slope, *prior)
        gain = -0.5 * float(here.slope @ step)
        if gain < _CONVERGED:
            return x, here
        for _ in range(_HALVINGS):
            there = likelihood(x + step, problem)
            if there.deviance <= here.deviance + _CONVERGED:
                break
            step /= 2
        else:
            return None
        x, here = x + step, there
        if gain < _LAST and mixed.further is None:
            return x, here
    return None


def _scoring_step(curvature: Array, slope: Array, log_prior_slope: Array, log_prior_curvature: Array) -> Array:
    """(c,) in the log variances.

    In the variances themselves scoring is exact where one of them decides. One of which little would be left and that
    is hardly known, or that would be negative, is hardly seen: there the likelihood curves, in the logarithm, by its
    slope.
    """
    # In the variance itself a prior curves by its slope in the logarithm as well.
    own = curvature + np.diag(np.maximum(log_prior_curvature - log_prior_slope, log_prior_curvature))
    share = -np.linalg.solve(own, slope)
    if (share > np.where(np.diag(own) > _WELL_KNOWN, -1.0, _NEARLY_NONE)).all():
        return np.asarray(np.maximum(np.log1p(share), -_LEAP))
    weak = np.maximum(slope - log_prior_slope, 0)
    step = -np.linalg.solve(curvature + np.diag(log_prior_curvature + weak), slope)
    return np.asarray(step * min(1.0, _LEAP / float(np.abs(step).max())))


# Variance components by restricted maximum likelihood, with or without a prior on some columns of the mean.

_SPAN = (32.0, 14.0)  # the search, in log variance below and above the start
_ABSENT = 1e-300  # in place of a variance of zero, which has no logarithm
_FACTORS = (float(np.log(0.3)), float(np.log(1e8)))  # and of the factor on the noise
# The search ends where the deviance's slope is below the first; with thousands of numbers below the second: the
# curvature grows with their count, and 0.1 then costs the deviance less than 1e-5.
# Where further components may be absent, begun near the maximum, the third: their prior alone curves by 0.09, so that
# the deviance is missed by less than slope²/(2·0.09), 0.005.
_FLAT, _FLAT_AMONG_MANY, _FLAT_NEAR_MAXIMUM, MANY_NUMBERS = 1e-4, 0.1, 0.03, 1_000


@dataclass(frozen=True)
class VarianceFit:
    """The maximum: variances λ (c,), −2 log of the (restricted) likelihood, and the mean's coefficients."""

    variances: Array  # (c,)
    deviance: float
    mean: Array  # (a + g,)
    covariance: Array  # (a + g, a + g)
    sums: Array  # (a + g + 1, a + g + 1) XᵀV⁻¹X of the mean's columns, and of what was seen as the last one

    def under_prior(self, prior: Array) -> tuple[Array, Array]:
        """Mean (a + g,) and covariance at the same variances, with standard deviations (g,) of further coefficients."""
        precision = np.append(np.zeros(len(self.mean) - len(prior)), prior**-2.0)
        half, _ = _root_of_inverse(self.sums[:-1, :-1] + np.diag(precision))
        return half @ (half.T @ self.sums[:-1, -1]), half @ half.T


def fit_variances(
    mixed: MixedModel,
    G: Array | FurtherColumns | None = None,
    prior: Array | None = None,
    start: Array | None = None,
    both_starts: bool = False,
) -> VarianceFit:
    """Maximise over the variances.

    Args:
        G: (B, m, g) further columns of the mean; of the same ones asked several times, `FurtherColumns`.
        prior: (g,) standard deviations of their coefficients; None leaves them free.
        start: (c,) variances to begin with; None starts from the spread of z.
        both_starts: also begin from noise alone, where the likelihood may have a second maximum.

    Returns:
        A component that no number has is at variance zero.
    """
    problem = reml_problem(mixed, G, prior)
    guess = usual_variances(mixed.z, mixed.components) if start is None else start
    first = np.log(np.maximum(guess, _ABSENT))
    scattered = np.arange(len(first)) != NOISE
    begin = [first, first - 9.0 * scattered] if both_starts else [first]
    centre = np.log(usual_variances(mixed.z, mixed.components))
    few = _FLAT if start is None or mixed.further is None else _FLAT_NEAR_MAXIMUM
    flat = _FLAT_AMONG_MANY if mixed.size > MANY_NUMBERS else few
    bounds = [(c - _SPAN[0], c + _SPAN[1]) if s else _FACTORS for c, s in zip(centre, scattered, strict=True)]
    present = np.einsum("cbii->c", mixed.components) > 0
    bounds = [own if there else (np.log(_ABSENT),) * 2 for own, there in zip(bounds, present, strict=True)]
    options = {"ftol": 1e-9, "gtol": flat, "maxiter": 60}
    # Scoring has no bounds: begun within them, it would go once more where an earlier fit has ended beyond.
    near = [fisher_scoring(problem, s, flat) if present.all() else None for s in begin]
    begin = [np.clip(s, *np.array(bounds).T) for s in begin]
    search = partial(minimize, deviance, args=(problem,), jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    fits = [
        _fit_at(problem, np.where(present, np.exp(search(s).x), 0.0))
        if found is None
        else _as_variance_fit(np.exp(found[0]), found[1])
        for s, found in zip(begin, near, strict=True)
    ]
    return min(fits, key=lambda fit: fit.deviance)


def at_variances(
    mixed: MixedModel, variances: Array, G: Array | FurtherColumns | None = None, prior: Array | None = None
) -> VarianceFit:
    """The same without searching: mean, covariance and deviance for given variances (c,)."""
    return _fit_at(reml_problem(mixed, G, prior), np.asarray(variances))


def _fit_at(problem: RemlProblem, variances: Array) -> VarianceFit:
    return _as_variance_fit(variances, likelihood(np.log(np.maximum(variances, _ABSENT)), problem))


def _as_variance_fit(variances: Array, solution: Likelihood) -> VarianceFit:
    return VarianceFit(variances, solution.deviance, solution.mean, solution.covariance, solution.sums)


def whitener(mixed: MixedModel, variances: Array) -> Array:
    """(B, m, m) inverse Cholesky factors of the blocks' covariance."""
    return invert_covariance(mixed.covariance(variances)).half
