"""Hand-eye, centre and radius together from all views, the robot's pose scatter included.

A pose error shifts the whole sphere in its view, and turning it about its centre changes nothing: all
that a view's points say is the circle or sphere that they lie on. So the points enter by their robust
circle (centre in the laser plane, radius) or sphere (centre, radius) and its covariance, and every view
gets one shift ~ N(0, σ_p²) per axis and one error of its apparent radius ~ N(0, σ_ρ²), the scanner's
own; no number of points averages them out. The second matters for laser lines: near the equator a
radius off by σ_ρ puts the centre ρ/h·σ_ρ off, h its distance from the plane. Both scatters are found by
restricted maximum likelihood (Patterson & Thompson 1971).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares, minimize

from stitch import frames
from stitch.calibrate.jackknife import jackknife
from stitch.calibrate.sphere_views import SphereView
from stitch.errors import NoResultError
from stitch.frames import Array

_ROUNDS = 30
# Step of the central differences (rad and lengths).
_STEP = 1e-5


@dataclass(frozen=True)
class SphereFit:
    """Parameters in the order: hand-eye twist (right, rotation first), centre, radius if free."""

    T_mount: Array  # (4, 4) T_mount_scanner
    centre: Array  # (3,) in the reference frame
    radius: float
    covariance: Array  # (9, 9) or (10, 10), counted in views
    inflation: float  # what leaving views out put on it, ≥ 1
    pose_sigma: float  # σ_p of one coordinate of a view's shift
    radius_sigma: float  # σ_ρ of a view's apparent radius
    point_sigma: float  # median over the views of the points' sigma about their own circle or sphere
    rms: float  # of all points' distances from the one sphere
    view_rms: Array  # (V,) the same by view
    left_out: Array  # (V, 9 or 10) change of the parameters without each view


@dataclass(frozen=True)
class _State:
    T_mount: Array
    centre: Array
    radius: float

    def moved(self, x: Array) -> "_State":
        radius = self.radius + (x[9] if len(x) > 9 else 0.0)
        return _State(self.T_mount @ frames.exp(x[:6]), self.centre + x[6:9], radius)


def fit_sphere(
    G: Array, views: Sequence[SphereView], T_mount: Array, radius: float, radius_free: bool = False
) -> SphereFit:
    """Refine from a start that has every laser line on the right side of the centre.

    Args:
        G: (V, 4, 4) T_reference_mount.
        T_mount: (4, 4) first hand-eye.

    Raises:
        NoResultError: too few views.
    """
    n = 10 if radius_free else 9
    if 3 * len(views) < n + 3:
        raise NoResultError(f"{len(views)} views for {n} unknowns; scan the sphere from {n // 3 + 2} or more poses")
    feet = np.array([v.foot for v in views])
    state = _State(T_mount, np.median(frames.transform(G @ T_mount, feet[:, None])[:, 0], axis=0), radius)
    scatter = np.array([0.005, 0.005]) * radius
    for _ in range(_ROUNDS):
        state = _solve(G, views, state, scatter, n)
        e, jacobian, response = _linearise(G, views, state, n)
        newer = _scatter(views, e, jacobian, response, scatter)
        change, scatter = float(np.abs(np.log(newer / scatter)).max()), newer
        if change < 1e-3:
            break
    W = _whitening(views, response, scatter)
    white = [(w @ J, w @ r) for w, J, r in zip(W, jacobian, e, strict=True)]
    statistics = jackknife(np.array([J.T @ J for J, _ in white]), np.array([J.T @ r for J, r in white]))
    off = [_distances(G[v], view.points, state) for v, view in enumerate(views)]
    return SphereFit(
        state.T_mount, state.centre, state.radius, statistics.covariance, statistics.inflation,
        float(scatter[0]), float(scatter[1]), float(np.median([v.sigma for v in views])),
        float(np.sqrt(np.mean(np.concatenate(off) ** 2))), np.array([np.sqrt(np.mean(d**2)) for d in off]),
        statistics.steps,
    )  # fmt: skip


def _distances(G: Array, points: Array, state: _State) -> Array:
    return np.linalg.norm(frames.transform(G @ state.T_mount, points) - state.centre, axis=1) - state.radius


def _residuals(G: Array, views: Sequence[SphereView], state: _State) -> tuple[list[Array], list[Array]]:
    """Predicted less measured circle or sphere of each view, (k + 1,), and its response to a shift, (k + 1, 3)."""
    seen = frames.transform(frames.inverse(G @ state.T_mount), state.centre[None])[:, 0]
    out, response = [], []
    for view, q in zip(views, seen, strict=True):
        if view.normal.any():
            height = float((q - view.foot) @ view.normal)
            rho = np.sqrt(max(state.radius**2 - height**2, 1e-4 * state.radius**2))
            last = -height / rho * view.normal
        else:
            rho, last = state.radius, np.zeros(3)
        out.append(np.append(view.directions @ q, rho) - view.measured)
        response.append(np.vstack([view.directions, last]))
    return out, response


def _whitening(views: Sequence[SphereView], response: Sequence[Array], scatter: Array) -> list[Array]:
    """Inverse Cholesky factors of each view's covariance: points, shift, apparent radius."""
    out = []
    for view, S in zip(views, response, strict=True):
        covariance = view.covariance + scatter[0] ** 2 * S @ S.T
        covariance[-1, -1] += scatter[1] ** 2
        out.append(np.linalg.inv(np.linalg.cholesky(covariance)))
    return out


def _solve(G: Array, views: Sequence[SphereView], state: _State, scatter: Array, n: int) -> _State:
    """Least squares with the covariances of the state it starts from."""
    W = _whitening(views, _residuals(G, views, state)[1], scatter)

    def residual(x: Array) -> Array:
        return np.concatenate([w @ r for w, r in zip(W, _residuals(G, views, state.moved(x))[0], strict=True)])

    return state.moved(least_squares(residual, np.zeros(n), "3-point", x_scale="jac").x)


def _linearise(
    G: Array, views: Sequence[SphereView], state: _State, n: int
) -> tuple[list[Array], list[Array], list[Array]]:
    """Residuals, their Jacobians (k + 1, n) and responses to a shift, by view."""
    e, response = _residuals(G, views, state)
    sides = [[_residuals(G, views, state.moved(s * h))[0] for s in (1, -1)] for h in _STEP * np.eye(n)]
    jacobian = [
        np.column_stack([(plus[v] - minus[v]) / (2 * _STEP) for plus, minus in sides]) for v in range(len(views))
    ]
    return e, jacobian, response


def _scatter(
    views: Sequence[SphereView], e: Sequence[Array], jacobian: Sequence[Array], response: Sequence[Array], last: Array
) -> Array:
    """(σ_p, σ_ρ) of the largest restricted likelihood of the linear model."""

    def cost(log_scatter: Array) -> float:
        W = _whitening(views, response, np.exp(log_scatter))
        J = np.concatenate([w @ j for w, j in zip(W, jacobian, strict=True)])
        r = np.concatenate([w @ x for w, x in zip(W, e, strict=True)])
        R, Q = np.linalg.qr(J)[::-1]
        spread = -sum(np.log(np.diag(w)).sum() for w in W)
        return float(2 * spread + 2 * np.log(np.abs(np.diag(R))).sum() + r @ r - np.sum((Q.T @ r) ** 2))

    start = np.log(last)
    # Below a thousandth of the points' sigma a scatter is none.
    floor = np.log(1e-3 * np.median([v.sigma for v in views]))
    bounds = [(max(x - 2, floor), max(x + 2, floor + 1)) for x in start]
    return np.exp(np.asarray(minimize(cost, np.maximum(start, floor), method="L-BFGS-B", bounds=bounds).x))
