"""Nonlinear least squares for A·X = Z·B, with covariance in views.

Residual of a view: the twist log((A X)⁻¹ Z B) in the probe's frame.
Rotations and translations scatter by σ_r and σ_t, both found from the residuals unless given.
"""

from dataclasses import dataclass

import numpy as np

from stitch import frames
from stitch.calibrate.view_jackknife import jackknife
from stitch.closed_form.axzb import shah
from stitch.closed_form.relative_motions import weight_roots
from stitch.frames import Array
from stitch.statistics.robust import mad_sigma

_STEPS = 30
# A step below this share of the sigmas changes nothing.
_SMALL = 1e-6
# Beyond this many sigmas a robust fit counts a residual by its size, not its square (Huber).
_HUBER = 2.0
# Numbers of X and Z.
_UNKNOWNS = 12


@dataclass(frozen=True)
class AxzbSolution:
    """Both transforms; the covariance is of their right perturbations T·exp(ξ), rotation first."""

    transforms: tuple[Array, Array]  # X and Z, (4, 4) each
    covariance: Array  # (12, 12): X, then Z
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
) -> AxzbSolution:
    """X, Z of A·X = Z·B by Gauss–Newton from Shah's start; every step whitens by the scatter that it starts from.

    Args:
        A, B: (V, 4, 4) poses.
        sigma: scatter of rotation (rad) and translation, if known; their ratio weighs the two.
        weights: (V,) on the squares of each view.
        robust: Huber's loss, and scatters from medians.
        groups: (V,) labels of views that may err together; the covariance then leaves out whole groups.

    Raises:
        NoResultError: poses that cannot show both; names the axis they share.
    """
    X, Z = shah(A, B, weights)
    root = weight_roots(A, weights)[:, None]
    for step in range(_STEPS + 1):
        e, jacobian = _linearise_axzb(A, B, X, Z)
        scatter = np.array(sigma or _residual_scatter(e * root, robust))
        white = root / np.repeat(scatter, 3)
        information, gradient = _normal_equations(jacobian * white[..., None], e * white, robust)
        total = information.sum(axis=0)
        xi = -np.linalg.solve(total, gradient.sum(axis=0))
        if step == _STEPS or np.sqrt(xi @ total @ xi) < _SMALL:
            break
        X, Z = X @ frames.exp(xi[:6]), Z @ frames.exp(xi[6:])
    model = np.linalg.inv(total) * (_student_variance(e.size - _UNKNOWNS) if sigma is None else 1.0)
    statistics = jackknife(information, gradient, model)
    heldout = np.array([e[v] + jacobian[v] @ step for v, step in enumerate(statistics.steps)])
    if groups is not None:
        member = groups == np.unique(groups)[:, None]
        statistics = jackknife(np.tensordot(member, information, 1), member @ gradient, model)
    spread = float(scatter[0]), float(scatter[1])
    return AxzbSolution((X, Z), statistics.covariance, statistics.inflation, e, heldout, spread)


def _linearise_axzb(A: Array, B: Array, X: Array, Z: Array) -> tuple[Array, Array]:
    """Residual twists (V, 6) and their Jacobian (V, 6, 12) at X and Z.

    With the left and right inverse Jacobians of SE(3) at small twists, to first order (Barfoot 7.84).
    """
    e = frames.log(frames.inverse(A @ X) @ Z @ B)
    half = np.zeros((len(e), 6, 6))
    half[:, :3, :3] = half[:, 3:, 3:] = 0.5 * frames.skew(e[:, :3])
    half[:, 3:, :3] = 0.5 * frames.skew(e[:, 3:])
    by_x, by_z = half - np.eye(6), (np.eye(6) + half) @ frames.adjoint(frames.inverse(B))
    return e, np.concatenate([by_x, by_z], axis=2)


def _student_variance(free: int) -> float:
    """Variance of Student's t where each of the two scatters is found from half of the free numbers; at most 3."""
    return min(free / 2 / max(free / 2 - 2, 1e-9), 3.0)


def _normal_equations(jacobian: Array, e: Array, robust: bool) -> tuple[Array, Array]:
    """JᵀWJ and JᵀWe of each view, each coordinate weighted as the loss weighs it."""
    w = 1 / np.maximum(1.0, np.abs(e) / _HUBER) if robust else np.ones_like(e)
    weighted = jacobian * w[..., None]
    information = np.swapaxes(weighted, 1, 2) @ jacobian
    return np.asarray(information), np.einsum("vij,vi->vj", weighted, e)


def _residual_scatter(e: Array, robust: bool) -> tuple[float, float]:
    """σ of rotations and of translations; each half of the residuals pays for half of the unknowns."""
    free = max(1 - _UNKNOWNS / e.size, 1 / e.size)
    rotation, translation = (mad_sigma(half) if robust else _rms(half) for half in (e[:, :3], e[:, 3:]))
    # Exact data have no scatter; what rounding leaves of lengths keeps the weights finite.
    return max(rotation / np.sqrt(free), 1e-12), max(translation / np.sqrt(free), 1e-9)


def _rms(e: Array) -> float:
    return float(np.sqrt(np.mean(e**2)))
