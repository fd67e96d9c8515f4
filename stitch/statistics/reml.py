"""The restricted likelihood of variance components, with its slope.

    z = A·α + G·θ + noise,   cov(noise) = V = Σ_i λ_i C_i,   θ ~ N(0, S)

The α are free (integrated out with a flat prior: that is REML, Patterson & Thompson 1971, Harville 1977);
the θ have a prior of the size that is plausible (their integral is the evidence for the columns G). V is
block-diagonal in B blocks: one for the pose channel of scans, one a view for labelled points.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Self

import numpy as np
from scipy.linalg import block_diag
from scipy.linalg.lapack import dlauum, dpotrf, dtrtri
from scipy.optimize import minimize
from scipy.special import betainc, betaln, expit

from stitch.frames import Array, Mask
from stitch.statistics.least_squares import CLEARLY_KNOWN, equilibrated

# A covariance in blocks: its inverse, its factor and its determinant.


@dataclass(frozen=True)
class InverseCovariance:
    """Of a covariance V in B blocks of m."""

    matrix: Array  # (B, m, m) V⁻¹
    half: Array  # (B, m, m) L⁻¹, lower, with V = L Lᵀ
    logdet: float  # of V; infinite where it has no inverse


def invert_covariance(V: Array) -> InverseCovariance:
    """The inverse of (B, m, m); of a matrix that has none `logdet` is infinite."""
    # A search or a leap that ran away ends among infinite variances.
    if not np.isfinite(V).all():
        return InverseCovariance(V, V, np.inf)
    return _invert_blocks(V) if len(V) > 1 else _invert_single(V[0])


def _invert_single(V: Array) -> InverseCovariance:
    """Of one large block."""
    L, failed = dpotrf(V, lower=1, clean=1)
    if failed:
        return InverseCovariance(V[None], V[None], np.inf)
    half, _ = dtrtri(L, lower=1)
    lower, _ = dlauum(half, lower=1)
    # Above the diagonal all are zero.
    inverse = lower + lower.T
    np.fill_diagonal(inverse, np.diag(lower))
    return InverseCovariance(inverse[None], half[None], 2 * float(np.log(np.diag(L)).sum()))


def _invert_blocks(V: Array) -> InverseCovariance:
    """Of many small blocks, by Cholesky factors of all at once: a library's loop over them takes five times as long."""
    m = V.shape[1]
    A = np.ascontiguousarray(V.transpose(1, 2, 0))
    L, half = np.zeros_like(A), np.zeros_like(A)  # blocks last
    for j in range(m):
        below = A[j:, j] - np.einsum("ikb,kb->ib", L[j:, :j], L[j, :j])
        if not (below[0] > 0).all():
            return InverseCovariance(V, V, np.inf)
        L[j:, j] = below / np.sqrt(below[0])
        half[j, :j] = -np.einsum("kb,kib->ib", L[j, :j], half[:j, :j]) / L[j, j]
        half[j, j] = 1 / L[j, j]
    half = np.ascontiguousarray(half.transpose(2, 0, 1))
    return InverseCovariance(half.transpose(0, 2, 1) @ half, half, 2 * float(np.log(np.einsum("iib->ib", L)).sum()))


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

    @property
    def size(self) -> int:
        """Numbers in all."""
        return int(self.z.size) if self.independent is None else self.independent

    def covariance(self, variances: Array) -> Array:
        """(B, m, m) for variances (c,)."""
        V = np.einsum("c,cbij->bij", variances, self.components)
        return np.asarray(V if self.fixed is None else V + self.fixed)


@dataclass(frozen=True)
class RemlProblem:
    """A mixed model with the further columns of its mean, and their prior."""

    mixed: MixedModel
    Xz: Array  # (B, m, a + g + 1) with what was seen as the last column
    precision: Array  # (a + g,) of the prior
    offset: float  # log det of the prior covariance


def reml_problem(mixed: MixedModel, G: Array | None, prior: Array | None) -> RemlProblem:
    """With further columns G (B, m, g) and the standard deviations (g,) of their coefficients, if these have any."""
    Xz = np.concatenate([mixed.A, *(() if G is None else (G,)), mixed.z[..., None]], axis=2)
    if G is None or prior is None:
        return RemlProblem(mixed, Xz, np.zeros(Xz.shape[2] - 1), 0.0)
    precision = np.concatenate([np.zeros(mixed.A.shape[2]), 1 / prior**2])
    return RemlProblem(mixed, Xz, precision, float(2 * np.log(prior).sum()))


@dataclass(frozen=True)
class Likelihood:
    """The restricted likelihood at some variances, and what is best believed of the mean there."""

    problem: RemlProblem
    log_variances: Array  # (c,)
    deviance: float  # −2 log of it, and of the prior of the log variances
    mean: Array  # (a + g,) coefficients
    half: Array  # (a + g, r) square root of their covariance
    inverse: InverseCovariance  # of the numbers' covariance
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
        if not np.isfinite(self.inverse.logdet):
            return np.zeros(len(self.log_variances))
        variances, mixed = np.exp(self.log_variances), self.problem.mixed
        (blocks, m), own = mixed.z.shape, np.zeros(len(variances))
        half_and_rest = block_diag(self.half, 1.0)
        half_and_rest[:-1, -1] = -self.mean
        for at in _portions(blocks):
            W = self.inverse.matrix[at]
            taken = (flatten_blocks(W @ self.problem.Xz[at]) @ half_and_rest).reshape(len(W), m, -1)
            against = W - taken @ taken.transpose(0, 2, 1)
            own += mixed.components[:, at].reshape(len(own), -1) @ against.ravel()
        return np.asarray(variances * own + log_prior(self.log_variances, mixed.further)[1])


def _portions(blocks: int) -> Iterator[slice]:
    return (slice(start, start + _IN_CACHE) for start in range(0, blocks, _IN_CACHE))


def likelihood(log_variances: Array, problem: RemlProblem) -> Likelihood:
    """Evaluate it; infinitely unlikely, flat, where the covariance has no inverse."""
    with np.errstate(over="ignore"):
        mixed, variances = problem.mixed, np.exp(log_variances)
    inverse, k = invert_covariance(mixed.covariance(variances)), len(problem.precision)
    if not np.isfinite(inverse.logdet):
        mean, half = np.zeros(k), np.zeros((k, k))
        return Likelihood(problem, log_variances, 1e300, mean, half, inverse, np.zeros((k + 1, k + 1)))
    sums = np.zeros((k + 1, k + 1))
    for at in _portions(len(mixed.z)):
        white = flatten_blocks(inverse.half[at] @ problem.Xz[at])
        sums += white.T @ white
    half, of_information = _root_of_inverse(sums[:k, :k] + np.diag(problem.precision))
    mean = half @ (half.T @ sums[:k, k])
    # zᵀP z with P = (V + G S Gᵀ)⁻¹ projected: (z − Xβ)ᵀV⁻¹(z − Xβ) + βᵀQβ.
    rest = (flatten_blocks(problem.Xz) @ np.append(-mean, 1.0)).reshape(*mixed.z.shape, 1)
    square = float(np.sum((inverse.half @ rest) ** 2)) + float(mean @ (problem.precision * mean))
    value = inverse.logdet + of_information + problem.offset + square + log_prior(log_variances, mixed.further)[0]
    return Likelihood(problem, log_variances, value, mean, half, inverse, sums)


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


# Blocks of several sessions as those of one: numbers that the smaller blocks lack are absent.


def block_columns(columns: Sequence[Array]) -> Array:
    """(ΣB, m, Σa) columns (B, m, a) of unknowns that every session has for itself."""
    if len(columns) == 1:
        return columns[0]
    widths = np.cumsum([0, *(c.shape[2] for c in columns)])
    every = []
    for c, at in zip(columns, widths[:-1], strict=True):
        wide = np.zeros((*c.shape[:2], widths[-1]))
        wide[..., at : at + c.shape[2]] = c
        every.append(wide)
    return stack_blocks(every)


def stack_blocks(blocks: Sequence[Array]) -> Array:
    """(ΣB, m, …) blocks (B, m, …) of several sessions."""
    if len(blocks) == 1:
        return blocks[0]
    m = max(b.shape[1] for b in blocks)
    return np.concatenate([np.pad(b, [(0, 0), (0, m - b.shape[1]), *[(0, 0)] * (b.ndim - 2)]) for b in blocks])


def stack_mixed_models(mixed: Sequence[MixedModel], A: Array) -> MixedModel:
    """Mixed models of sessions that scatter alike, with columns A (ΣB, m, a) of the free mean of all."""
    if len(mixed) == 1:
        return mixed[0]
    m = max(own.z.shape[1] for own in mixed)

    def wide(matrices: Array, absent: float = 0.0) -> Array:
        lacking = m - matrices.shape[-1]
        out = np.pad(matrices, [*[(0, 0)] * (matrices.ndim - 2), (0, lacking), (0, lacking)])
        more = np.arange(m - lacking, m)
        out[..., more, more] = absent
        return out

    fixed = [np.zeros((*own.z.shape, own.z.shape[1])) if own.fixed is None else own.fixed for own in mixed]
    return MixedModel(
        z=stack_blocks([own.z for own in mixed]),
        A=A,
        components=np.concatenate([wide(own.components) for own in mixed], axis=1),
        fixed=np.concatenate([wide(own, absent=1.0) for own in fixed]),
        independent=sum(own.size for own in mixed),
    )


# Fisher scoring of variance components, where their maximum lies near.

# Scoring steps, their largest leap in a log variance, how often one is halved, the deviance that is not worth another
# (rounding alone moves that of thousands of numbers by a tenth of it), and the blocks from which they pay.
_SCORINGS, _LEAP, _HALVINGS, _CONVERGED, _MANY_BLOCKS = 20, 2.0, 4, 1e-3, 50
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
    if len(mixed.z) < _MANY_BLOCKS:
        return None
    x, here = start, likelihood(start, problem)
    for _ in range(_SCORINGS):
        if np.abs(here.slope).max() < flat:
            return x, here
        variances = np.exp(x)
        shares = variances[:, None, None, None] * (here.inverse.matrix @ mixed.components)
        curvature = shares.reshape(len(x), -1) @ shares.transpose(0, 1, 3, 2).reshape(len(x), -1).T
        prior = log_prior(x, mixed.further)[1], 2 * prior_information(variances, mixed.further)
        step = _scoring_step(curvature, here.slope, *prior)
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
    G: Array | None = None,
    prior: Array | None = None,
    start: Array | None = None,
    both_starts: bool = False,
) -> VarianceFit:
    """Maximise over the variances.

    Args:
        G: (B, m, g) further columns of the mean.
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
    mixed: MixedModel, variances: Array, G: Array | None = None, prior: Array | None = None
) -> VarianceFit:
    """The same without searching: mean, covariance and deviance for given variances (c,)."""
    return _fit_at(reml_problem(mixed, G, prior), np.asarray(variances))


def _fit_at(problem: RemlProblem, variances: Array) -> VarianceFit:
    return _as_variance_fit(variances, likelihood(np.log(np.maximum(variances, _ABSENT)), problem))


def _as_variance_fit(variances: Array, solution: Likelihood) -> VarianceFit:
    return VarianceFit(variances, solution.deviance, solution.mean, solution.covariance, solution.sums)


def whitener(mixed: MixedModel, variances: Array) -> Array:
    """(B, m, m) inverse Cholesky factors of the blocks' covariance."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(mixed.covariance(variances))))
