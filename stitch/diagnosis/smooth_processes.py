"""Smooth processes by which a joint or the flange may err, and how large they are beside a model.

A process is a few columns of unit coefficients: the leading eigenvectors of its covariance between views. Its size is
sought at the null's variances first (`size_process`), then with all variances (`fit_process`).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.linalg.lapack import dpstrf

from stitch.diagnosis import thresholds as limits
from stitch.effects.contract import EFFECTS
from stitch.model.forward import pose_derivatives
from stitch.model.model import term_of
from stitch.numerics.frames import Array
from stitch.numerics.kernels import REACH, SHORT_REACH, exponential_kernel, rbf_joints
from stitch.numerics.reml import VarianceFit, fit_variances
from stitch.observations.linear_model import LinearModel
from stitch.observations.pose_errors import DRIFT_MEMORY, flange_twists, time_in_steps
from stitch.session.scan import even_indices

# Below this share of the largest variance nothing is left of a covariance.
_ROUNDING = 1e-8
# Of so many processes the trends are kept: those of a session with six or seven joints. Of thousands of poses each
# takes a megabyte or two.
_KEPT = 40
# Sizes that are tried, as multiples of the one at which the clearest column is as large as its own sigma.
_SIZES = np.geomspace(0.1, 1e5, 49)


@dataclass(frozen=True)
class SmoothProcess:
    """Σ c·motion·shape over all p motions and R shapes, with independent coefficients c of variance 1.

    Its columns are far larger than this, and made only where it is fitted.
    """

    joint: int | None  # that errs, counted from 1; None: the flange
    motions: Array  # (V, 6, p) twists of the views
    shapes: Array  # (V, R) by which a motion is multiplied in each view
    # Only of a flange that errs by a swing or a stretch in time:
    kind: str = ""
    words: str = ""  # what the poses do: "they …"
    trend: Callable[[Array], Array] | None = None  # times (T,) in steps from view to view → shapes (T, R)
    frequency: float | None = None  # 1/step, of a swing

    def columns(self, linear: LinearModel) -> Array:
        """Return the columns (n, p·R) of the coefficients in the reduced observations, motion by motion."""
        moved = self.motions[:, :, :, None] * self.shapes[:, None, None, :]
        return linear.observation.from_twists(moved.reshape(6 * len(moved), -1))


@dataclass(frozen=True)
class FittedProcess:
    """A process at its likeliest size, all variances fitted beside it."""

    base: LinearModel  # without it
    process: SmoothProcess
    columns: Array  # (n, R) of its coefficients in the reduced observations
    size: float  # standard deviation of the coefficients
    fit: VarianceFit  # of the views with the process
    log_bayes_factor: float  # over the model without it, less the number of processes that were tried

    @property
    def joint(self) -> int | None:
        """The joint that errs by it, counted from 1; None: the flange, in time."""
        return self.process.joint

    @property
    def words(self) -> str:
        """Which joint errs, or that the flange does, as a clause."""
        if self.joint is None:
            return "the flange wanders in time"
        return f"joint {self.joint} follows a smooth curve without a name"

    @property
    def flange_scatter(self) -> Array:
        """(2,) variances per axis of the scatter of the flange, rad² and length_unit², beside the process."""
        return self.base.flange_scatter(self.fit)

    @property
    def explained(self) -> Array:
        """(n,) what it explains of the reduced observations, at its likeliest coefficients."""
        return self.columns @ self.fit.mean[-self.columns.shape[1] :]


def joint_motions(linear: LinearModel) -> Array:
    """Return twists (n, V, 6, 1) of the V views per radian of each of n joints, about the part's centre."""
    offset = term_of(linear.measurement, EFFECTS["joint_offset"])
    return next(pose_derivatives(linear.measurement, linear.model, [offset], linear.observation.centre))[..., None]


def single_joint_processes(linear: LinearModel, motions: Array, k: int) -> Iterator[SmoothProcess]:
    """Yield three processes of one joint: smooth in all joint angles; in its own; in its own here and one view before.

    Args:
        motions: (n, V, 6, 1) twists of the views per radian of each joint.
        k: the joint, counted from 0.
    """
    views = linear.measurement.views
    angle = views.joints[:, [k]]
    before = views.previous[:, [k]]
    for angles, reach in ((views.joints, REACH), (angle, SHORT_REACH), (np.hstack([angle, before]), REACH)):
        yield SmoothProcess(k + 1, motions[k], _smooth_trends(angles, reach))


def joint_pair_processes(linear: LinearModel, motions: Array, k: int) -> Iterator[SmoothProcess]:
    """Yield processes of one joint that are smooth in its own angle and that of another one, for each other joint.

    Args:
        motions: (n, V, 6, 1) twists of the views per radian of each joint.
        k: the joint, counted from 0.
    """
    joints = linear.measurement.views.joints
    for other in range(joints.shape[1]):
        if other != k:
            yield SmoothProcess(k + 1, motions[k], _smooth_trends(joints[:, [k, other]]))


def wandering_flange(linear: LinearModel) -> SmoothProcess:
    """Return the process of a flange that wanders in time, with an exponential covariance between views."""
    measurement = linear.measurement
    time = time_in_steps(measurement)
    knots = even_indices(len(time), limits.PROCESS_KNOTS)
    covariance = exponential_kernel(time, time[knots], DRIFT_MEMORY["slowly wandering"])
    motions = flange_twists([measurement], [linear.observation.centre]).reshape(len(time), 6, 6)
    return SmoothProcess(None, motions, covariance @ leading_trends(covariance[knots], limits.PROCESS_COLUMNS // 6))


def leading_trends(covariance: Array, most: int) -> Array:
    """Return the matrix (K, R) that turns covariances (V, K) with K knots into R trends (V, R) of a random process.

    A sum of these trends with independent coefficients of variance 1 has nearly the covariance of the process
    (Nyström's method). With the largest eigenvalues d and eigenvectors E of the covariance C of the knots the matrix is
    E d^(−½): at the knots the trends C E d^(−½) are E d^(½), whose square is C.

    Args:
        covariance: (K, K) between the knots, which are some of the views.
        most: largest number R; small eigenvalues are left out too.
    """
    # A smooth covariance has low rank. By pivoted Cholesky it is root rootᵀ, and the eigenvectors come from the smaller
    # rootᵀ root, three times as fast.
    factor, order, rank, _ = dpstrf(covariance, lower=1, tol=_ROUNDING * covariance.diagonal().max())
    root = np.zeros((len(covariance), rank))
    root[order - 1] = np.tril(factor[:, :rank])
    low_rank = rank < len(covariance) / 2
    values, vectors = np.linalg.eigh(root.T @ root if low_rank else covariance)
    values, vectors = values[::-1][:most], vectors[:, ::-1][:, :most]
    keep = values > limits.PROCESS_LEAST_VARIANCE * values[0]
    trends = vectors[:, keep] / np.sqrt(values[keep])
    return root @ (trends / np.sqrt(values[keep])) if low_rank else trends


def size_process(linear: LinearModel, process: SmoothProcess) -> tuple[float, float]:
    """Return the likeliest size of a process at the null's variances, and its log Bayes factor over no process there.

    With size s (of the coefficients), eigenvalues k of the coefficients' information and their score g along the
    eigenvectors: log BF(s) = ½ Σ g²/(k + 1/s²) − ½ Σ log(1 + s²k).
    """
    (information,), (vector,) = linear.information_of_motions(process.motions, process.shapes[None])
    k, vectors = np.linalg.eigh(information)
    k, g = np.maximum(k, 0.0), vectors.T @ vector
    if not k[-1] > 0:
        return 1.0, -np.inf
    sizes = _SIZES / np.sqrt(k[-1])
    gains = g**2 / (k + 1 / sizes[:, None] ** 2) - np.log1p(sizes[:, None] ** 2 * k)
    factors = 0.5 * gains.sum(axis=1)
    return float(sizes[factors.argmax()]), float(factors.max())


def fit_process(linear: LinearModel, process: SmoothProcess, first_size: float, tried: int) -> FittedProcess:
    """Return a process fitted together with all variances, at the likelier of two sizes.

    What the process explains is no scatter, and with less scatter another size may be likelier: the second size is
    sought at the variances of the first fit.

    Args:
        first_size: the likeliest at the null's variances (`size_process`).
        tried: number of processes among which it was chosen; its logarithm is taken off the log Bayes factor.
    """
    columns = process.columns(linear)
    G = linear.in_blocks(columns)
    unit = np.ones(columns.shape[1])
    first = fit_variances(linear.mixed, G, first_size * unit, start=linear.null.variances)
    size, _ = size_process(replace(linear, null=first), process)
    again = fit_variances(linear.mixed, G, size * unit, start=first.variances)
    size, fit = (size, again) if again.deviance < first.deviance else (first_size, first)
    gain = 0.5 * (linear.null.deviance - fit.deviance) - float(np.log(tried))
    return FittedProcess(linear, process, columns, size, fit, gain)


def _smooth_trends(angles: Array, reach: float = REACH) -> Array:
    """Return (V, R) trends of a smooth random function of a angles, less their mean over the views.

    The mean, a constant offset, is an effect that has a name.

    Args:
        angles: (V, a) rad.
        reach: angle over which the function changes little, rad.
    """
    return _smooth_trends_of(np.ascontiguousarray(angles).tobytes(), len(angles), reach)


@lru_cache(maxsize=_KEPT)
def _smooth_trends_of(angles: bytes, views: int, reach: float) -> Array:
    """Return the trends of `_smooth_trends`, cached by the bytes of the angles: every diagnosis asks for them."""
    of_views = np.frombuffer(angles).reshape(views, -1)
    knots = even_indices(views, limits.PROCESS_KNOTS)
    covariance = rbf_joints(of_views, of_views[knots], reach)
    shapes = covariance @ leading_trends(covariance[knots], limits.PROCESS_COLUMNS)
    return shapes - shapes.mean(axis=0)
