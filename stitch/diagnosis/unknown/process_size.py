"""How large a smooth process without a name is beside a model, and how much likelier the views are with it."""

from dataclasses import dataclass, replace

import numpy as np

from stitch.diagnosis.unknown.smooth_processes import SmoothProcess
from stitch.frames import Array
from stitch.observations.linear_model import LinearModel
from stitch.statistics.variance_components import VarianceFit, fit_variances

# Sizes that are tried, as multiples of the one at which the clearest column is as large as its own sigma.
_SIZES = np.geomspace(0.1, 1e5, 49)


@dataclass(frozen=True)
class SizedProcess:
    """A process at the size that is likeliest at the null's variances, and its log Bayes factor there."""

    process: SmoothProcess
    size: float
    gain: float


@dataclass(frozen=True)
class FittedProcess:
    """A process at its likeliest size, all variances fitted beside it."""

    base: LinearModel  # without it
    process: SmoothProcess
    columns: Array  # (n, R) of the channel, per unit of that size
    size: float
    fit: VarianceFit  # of the views with the process
    log_bayes_factor: float  # over the model without it, less the number of processes that were tried

    @property
    def joint(self) -> int | None:
        """That follows it, counted from 1; None: the flange, in time."""
        return self.process.joint

    @property
    def flange_scatter(self) -> Array:
        """(2,) variances along an axis by which the flange turns and moves anew in every view, beside the process."""
        return self.base.flange_scatter(self.fit)

    @property
    def numbers(self) -> Array:
        """(n,) of the channel that it explains."""
        return np.asarray(self.columns @ self.fit.mean[-self.columns.shape[1] :])


def size_process(linear: LinearModel, process: SmoothProcess) -> SizedProcess:
    """Its size at the null's variances.

    Over the eigenvalues k of the columns' information and the shares g of what was seen: log BF(s) =
    ½ Σ g²/(k + 1/s²) − ½ Σ log(1 + s²k).
    """
    white = linear.residual(process.columns(linear))
    k, vectors = np.linalg.eigh(white.T @ white)
    k, g = np.maximum(k, 0.0), vectors.T @ (white.T @ linear.white_residual)
    if not k[-1] > 0:
        return SizedProcess(process, 1.0, -np.inf)
    sizes = _SIZES / np.sqrt(k[-1])
    gains = g**2 / (k + 1 / sizes[:, None] ** 2) - np.log1p(sizes[:, None] ** 2 * k)
    found = 0.5 * gains.sum(axis=1)
    return SizedProcess(process, float(sizes[found.argmax()]), float(found.max()))


def fit_process(linear: LinearModel, sized: SizedProcess, tried: int) -> FittedProcess:
    """With all variances sought anew: what a process explains is no scatter, and where the scatter is less it is
    likelier of another size."""
    columns = sized.process.columns(linear)
    G, unit = linear.in_blocks(columns), np.ones(columns.shape[1])
    fit = fit_variances(linear.mixed, G, sized.size * unit, start=linear.null.variances)
    size = size_process(replace(linear, null=fit), sized.process).size
    again = fit_variances(linear.mixed, G, size * unit, start=fit.variances)
    size, fit = (size, again) if again.deviance < fit.deviance else (sized.size, fit)
    gained = 0.5 * (linear.null.deviance - fit.deviance) - float(np.log(tried))
    return FittedProcess(linear, sized.process, columns, size, fit, gained)
