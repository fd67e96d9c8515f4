"""The restricted likelihood of variance components, with its slope.

    z = A·α + G·θ + noise,   cov(noise) = V = Σ_i λ_i C_i,   θ ~ N(0, S)

The α are free (integrated out with a flat prior: that is REML, Patterson & Thompson 1971, Harville 1977);
the θ have a prior of the size that is plausible (their integral is the evidence for the columns G). V is
block-diagonal in B blocks: one for the pose channel of scans, one a view for labelled points.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtri

from stitch.frames import Array
from stitch.statistics.inverse import InverseCovariance, invert_covariance
from stitch.statistics.variance_prior import FurtherPrior, log_prior

# Blocks that are held against the components at a time: as many as stay in a core's cache.
_IN_CACHE = 256
# Of the mean's information, columns of unit diagonal: directions below the first share tell nothing. Where every
# column has more than the second of its root beside those before it there are none, and no eigenvectors are sought.
_KNOWN, _CLEARLY_KNOWN = 1e-12, 1e-3


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
    X: Array  # (B, m, a + g)
    precision: Array  # (a + g,) of the prior
    offset: float  # log det of the prior covariance


def reml_problem(mixed: MixedModel, G: Array | None, prior: Array | None) -> RemlProblem:
    """With further columns G (B, m, g) and the standard deviations (g,) of their coefficients, if these have any."""
    a = mixed.A.shape[2]
    if G is None:
        return RemlProblem(mixed, mixed.A, np.zeros(a), 0.0)
    X = np.concatenate([mixed.A, G], axis=2)
    if prior is None:
        return RemlProblem(mixed, X, np.zeros(X.shape[2]), 0.0)
    precision = np.concatenate([np.zeros(a), 1 / prior**2])
    return RemlProblem(mixed, X, precision, float(2 * np.log(prior).sum()))


@dataclass(frozen=True)
class Likelihood:
    """The restricted likelihood at some variances, and what is best believed of the mean there."""

    problem: RemlProblem
    log_variances: Array  # (c,)
    deviance: float  # −2 log of it, and of the prior of the log variances
    mean: Array  # (a + g,) coefficients
    half: Array  # (a + g, r) square root of their covariance
    inverse: InverseCovariance  # of the numbers' covariance
    white: Array  # (B·m, a + g) the mean's columns in units of the scatter
    rest: Array  # (B·m,) what the mean leaves, in those units

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
        for start in range(0, blocks, _IN_CACHE):
            at, rows = slice(start, start + _IN_CACHE), slice(m * start, m * (start + _IN_CACHE))
            taken = np.column_stack([self.white[rows] @ self.half, self.rest[rows]])
            back = np.ascontiguousarray(self.inverse.half[at].transpose(0, 2, 1))
            unwhitened = back @ taken.reshape(-1, m, taken.shape[1])
            against = self.inverse.matrix[at] - unwhitened @ unwhitened.transpose(0, 2, 1)
            own += mixed.components[:, at].reshape(len(own), -1) @ against.ravel()
        return np.asarray(variances * own + log_prior(self.log_variances, mixed.further)[1])


def likelihood(log_variances: Array, problem: RemlProblem) -> Likelihood:
    """Evaluate it; infinitely unlikely, flat, where the covariance has no inverse."""
    with np.errstate(over="ignore"):
        mixed, variances = problem.mixed, np.exp(log_variances)
    inverse, k = invert_covariance(mixed.covariance(variances)), problem.X.shape[2]
    if not np.isfinite(inverse.logdet):
        mean, half = np.zeros(k), np.zeros((k, k))
        return Likelihood(problem, log_variances, 1e300, mean, half, inverse, white=half, rest=mean)
    white = flatten_blocks(inverse.half @ problem.X)
    white_z = np.matmul(inverse.half, mixed.z[..., None]).ravel()
    M = white.T @ white + np.diag(problem.precision)
    # Equilibrate: columns count in rad, mm and per hour.
    scale = 1 / np.sqrt(np.maximum(np.diag(M), 1e-300))
    own, of_information = _root_of_inverse(M * scale[:, None] * scale[None, :])
    half = scale[:, None] * own
    mean = half @ (half.T @ (white.T @ white_z))
    rest = white_z - white @ mean
    # zᵀP z with P = (V + G S Gᵀ)⁻¹ projected: (z − Xβ)ᵀV⁻¹(z − Xβ) + βᵀQβ.
    square = float(rest @ rest) + float(mean @ (problem.precision * mean))
    logdet = inverse.logdet + float(of_information - 2 * np.log(scale).sum()) + problem.offset
    value = logdet + square + log_prior(log_variances, mixed.further)[0]
    return Likelihood(problem, log_variances, value, mean, half, inverse, white=white, rest=rest)


def _root_of_inverse(M: Array) -> tuple[Array, float]:
    """R (k, r) with R Rᵀ = M⁻¹ for M (k, k) of unit diagonal, and log det M; both without directions that nothing
    tells of."""
    L, failed = dpotrf(M, lower=1, clean=1)
    if not failed and len(L) and np.diag(L).min() > _CLEARLY_KNOWN:
        return np.asarray(dtrtri(L, lower=1)[0].T), 2 * float(np.log(np.diag(L)).sum())
    values, vectors = np.linalg.eigh(M)
    keep = values > _KNOWN
    return vectors[:, keep] / np.sqrt(values[keep]), float(np.log(values[keep]).sum())


def deviance(log_variances: Array, problem: RemlProblem) -> tuple[float, Array]:
    """−2 log restricted likelihood and its slope in the log variances."""
    here = likelihood(log_variances, problem)
    return here.deviance, here.slope


def flatten_blocks(X: Array) -> Array:
    """(B·m, a) of (B, m, a); a model that is only judged has no columns."""
    return X.reshape(X.shape[0] * X.shape[1], X.shape[2])
