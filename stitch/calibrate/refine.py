"""Nonlinear least squares for A·X = Z·B and A·X = X·B, with covariance in views.

Residual of a view: the twist log((A X)⁻¹ Z B), of a motion: log(X⁻¹ A⁻¹ X B), in the probe's frame.
Rotations and translations scatter by σ_r and σ_t, both found from the residuals unless given.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stitch import frames
from stitch.calibrate.jackknife import jackknife
from stitch.calibrate.motions import require_motion
from stitch.closed_form.axxb import park_martin
from stitch.closed_form.axzb import require_poses, shah
from stitch.frames import Array

_STEPS = 30
# A step below this share of the sigmas changes nothing.
_SMALL = 1e-6
# Beyond this many sigmas a robust fit counts a residual by its size, not its square (Huber).
_HUBER = 2.0


@dataclass(frozen=True)
class Refined:
    """One or two transforms; the covariance is of their right perturbations T·exp(ξ), rotation first."""

    transforms: tuple[Array, ...]  # X, or X and Z, (4, 4) each
    covariance: Array  # (6, 6) or (12, 12): X, then Z
    inflation: float  # what leaving views out put on the covariance, ≥ 1
    residual: Array  # (V, 6) twists
    heldout: Array  # (V, 6) the same, each view predicted without itself
    sigma: tuple[float, float]  # of a residual's rotation (rad) and translation


def refine_axzb(
    A: Array,
    B: Array,
    sigma: tuple[float, float] | None = None,
    weights: Array | None = None,
    robust: bool = False,
    groups: Array | None = None,
) -> Refined:
    """X, Z of A·X = Z·B from Shah's start.

    Args:
        A, B: (V, 4, 4) poses.
        sigma: scatter of rotation (rad) and translation, if known; their ratio weighs the two.
        weights: (V,) on the squares of each view.
        robust: Huber's loss, and scatters from medians.
        groups: (V,) labels of views that may err together; the covariance then leaves out whole groups.

    Raises:
        NoResultError: poses that cannot show both; names the axis they share.
    """
    require_poses(A)
    back = frames.adjoint(frames.inverse(B))

    def linear(at: tuple[Array, ...]) -> tuple[Array, Array]:
        e = frames.log(frames.inverse(A @ at[0]) @ at[1] @ B)
        left, right = _inverse_jacobians(e)
        return e, np.concatenate([-left, right @ back], axis=2)

    return _refine(linear, shah(A, B, weights), sigma, weights, robust, groups)


def refine_axxb(
    A: Array, B: Array, sigma: tuple[float, float] | None = None, weights: Array | None = None, robust: bool = False
) -> Refined:
    """X of A·X = X·B from Park and Martin's start; arguments as in `refine_axzb`, motions for poses.

    The covariance takes the motions as independent. Motions between all pairs of views are not: where the
    views' own poses are known, `refine_axzb` uses each of them once.

    Raises:
        NoResultError: motions that cannot show X; names the axis they share.
    """
    require_motion(A)
    back = frames.adjoint(frames.inverse(B))

    def linear(at: tuple[Array, ...]) -> tuple[Array, Array]:
        e = frames.log(frames.inverse(A @ at[0]) @ at[0] @ B)
        left, right = _inverse_jacobians(e)
        return e, right @ back - left

    return _refine(linear, (park_martin(A, B, weights),), sigma, weights, robust)


def _inverse_jacobians(e: Array) -> tuple[Array, Array]:
    """Left and right inverse Jacobians (V, 6, 6) of SE(3) at small twists, to first order (Barfoot 7.84)."""
    half = np.zeros((len(e), 6, 6))
    half[:, :3, :3] = half[:, 3:, 3:] = 0.5 * frames.skew(e[:, :3])
    half[:, 3:, :3] = 0.5 * frames.skew(e[:, 3:])
    return np.eye(6) - half, np.eye(6) + half


def _refine(
    linear: Callable[[tuple[Array, ...]], tuple[Array, Array]], start: tuple[Array, ...],
    sigma: tuple[float, float] | None, weights: Array | None, robust: bool, groups: Array | None = None,
) -> Refined:  # fmt: skip
    """Gauss–Newton; every step whitens by the scatter of the residuals it starts from."""
    n, at = 6 * len(start), start
    root = np.ones(1) if weights is None else np.sqrt(np.asarray(weights, float))
    for step in range(_STEPS + 1):
        e, jacobian = linear(at)
        scatter = np.array(sigma or _scatter(e * root[:, None], n, robust))
        white = root[:, None] / np.repeat(scatter, 3)
        information, gradient = _normal_equations(jacobian * white[..., None], e * white, robust)
        xi = -np.linalg.solve(information.sum(axis=0), gradient.sum(axis=0))
        if step == _STEPS or np.sqrt(xi @ information.sum(axis=0) @ xi) < _SMALL:
            break
        at = _moved(at, xi)
    model = np.linalg.inv(information.sum(axis=0)) * (_student(e.size - n) if sigma is None else 1.0)
    statistics = jackknife(information, gradient, model)
    heldout = np.array([e[v] + jacobian[v] @ step for v, step in enumerate(statistics.steps)])
    if groups is not None:
        member = groups == np.unique(groups)[:, None]
        statistics = jackknife(np.tensordot(member, information, 1), member @ gradient, model)
    return Refined(at, statistics.covariance, statistics.inflation, e, heldout, (float(scatter[0]), float(scatter[1])))


def _moved(at: tuple[Array, ...], xi: Array) -> tuple[Array, ...]:
    return tuple(T @ frames.exp(xi[6 * k : 6 * k + 6]) for k, T in enumerate(at))


def _student(free: int) -> float:
    """Variance of Student's t where each of the two scatters is found from half of the free numbers; at most 3."""
    return min(free / 2 / max(free / 2 - 2, 1e-9), 3.0)


def _normal_equations(jacobian: Array, e: Array, robust: bool) -> tuple[Array, Array]:
    """JᵀWJ and JᵀWe of each view, each coordinate weighted as the loss weighs it."""
    w = 1 / np.maximum(1.0, np.abs(e) / _HUBER) if robust else np.ones_like(e)
    weighted = jacobian * w[..., None]
    information = np.swapaxes(weighted, 1, 2) @ jacobian
    return np.asarray(information), np.einsum("vij,vi->vj", weighted, e)


def _scatter(e: Array, n: int, robust: bool) -> tuple[float, float]:
    """σ of rotations and of translations; each half of the residuals pays for half of the n unknowns."""
    free = max(1 - n / e.size, 1 / e.size)
    halves = e[:, :3], e[:, 3:]
    if robust:
        sizes = [1.4826 * float(np.median(np.abs(half))) for half in halves]
    else:
        sizes = [float(np.sqrt(np.mean(half**2))) for half in halves]
    # Exact data have no scatter; what rounding leaves of lengths keeps the weights finite.
    return max(sizes[0] / np.sqrt(free), 1e-12), max(sizes[1] / np.sqrt(free), 1e-9)
