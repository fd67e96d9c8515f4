"""Hand-eye, centre and radius together from all points of all views; covariance counted in views.

A pose error shifts the whole sphere in its view, and turning it about its centre changes nothing: all
that a view's points say is the circle or sphere that they lie on. So the sum over the points of a view
is carried by their robust circle (centre in the laser plane, radius) or sphere (centre, radius) with the
normal matrix of its own fit, and nothing is lost. What the views then scatter by no number of points
averages out: a shift σ_p per axis of the sphere (the robot), an error σ_ρ of its apparent radius and an
error of the points σ_c that is one over the view (both the scanner). Near the equator of the sphere a
radius off by σ_ρ puts the centre ρ/h·σ_ρ off, h its distance from the laser plane. All three are found by
restricted maximum likelihood (Patterson & Thompson 1971).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from stitch import frames
from stitch.calibrate.jackknife import Jackknife, jackknife
from stitch.calibrate.sphere_scatter import covariances, find_scatter, find_shares
from stitch.calibrate.sphere_views import SphereView
from stitch.errors import NoResultError
from stitch.frames import Array

_ROUNDS = 20
# Numbers that the views must leave over for their scatter.
_FREE = 6
# Relative change of the scatters that ends the search.
_SMALL = 0.01
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
    scatter: Array  # (σ_p, σ_ρ, σ_c) of the views
    point_sigma: float  # median over the views of the points' sigma about their own circle or sphere
    rms: float  # of all points' distances from the one sphere
    view_rms: Array  # (V,) the same by view
    left_out: Array  # (V, 9 or 10) change of the parameters without each view
    shares: Array  # (V,) how much each view counts: below 1 where it contradicts the others


@dataclass(frozen=True)
class _State:
    T_mount: Array
    centre: Array
    radius: float

    def moved(self, x: Array) -> "_State":
        radius = self.radius + (x[9] if len(x) > 9 else 0.0)
        return _State(self.T_mount @ frames.exp(x[:6]), self.centre + x[6:9], radius)


def fit_sphere(
    G: Array, views: Sequence[SphereView], T_mount: Array, radius: float,
    radius_free: bool = False, by_views: bool = False,
) -> SphereFit:  # fmt: skip
    """Refine from a start that has every laser line on the right side of the centre.

    Args:
        G: (V, 4, 4) T_reference_mount.
        T_mount: (4, 4) first hand-eye.
        by_views: weigh the views by the scatter found (generalised least squares); else every point counts
            the same, which minimises the rms distance of the points from the sphere.

    Raises:
        NoResultError: too few views.
    """
    n = 10 if radius_free else 9
    free = 3 * len(views) - n
    if free < _FREE:
        needed = -(-(n + _FREE) // 3)
        raise NoResultError(f"{len(views)} views for {n} unknowns; scan the sphere from {needed} or more poses")
    feet = np.array([v.foot for v in views])
    state = _State(T_mount, np.median(frames.transform(G @ T_mount, feet[:, None])[:, 0], axis=0), radius)
    # Distances from a circle of radius ρ are R/ρ times those from the sphere.
    by_points: list[Array] = [
        np.linalg.inv(v.covariance) * (v.sigma * min(v.measured[-1] / radius, 1.0)) ** 2 for v in views
    ]
    weights, shares = by_points, np.ones(len(views))
    scatter = np.array([0.005 * radius, 0.002 * radius, 2 * np.median([v.sigma for v in views])])
    # The points' own sum has side minima for laser lines; the views' leads to the right one.
    for weighed in (True,) if by_views else (True, False):
        for _ in range(_ROUNDS):
            response = _residuals(G, views, state)[1]
            weights = [np.asarray(np.linalg.inv(V)) for V in covariances(views, response, scatter, shares)]
            if not weighed:
                weights = [w * share for w, share in zip(by_points, shares, strict=True)]
            state = _solve(G, views, state, weights, n)
            e, jacobian, response = _linearise(G, views, state, n)
            if weighed:
                shares = find_shares(e, covariances(views, response, scatter, np.ones(len(views))))
            newer = find_scatter(views, e, jacobian, response, scatter, shares)
            change, scatter = float(np.abs(np.log(newer / scatter)).max()), newer
            if change < _SMALL:
                break
    statistics = _statistics(e, jacobian, weights, covariances(views, response, scatter, shares), free)
    off = [_distances(G[v], view.points, state) for v, view in enumerate(views)]
    return SphereFit(
        state.T_mount, state.centre, state.radius, statistics.covariance, statistics.inflation, scatter,
        float(np.median([v.sigma for v in views])), float(np.sqrt(np.mean(np.concatenate(off) ** 2))),
        np.array([np.sqrt(np.mean(d**2)) for d in off]), statistics.steps, shares,
    )  # fmt: skip


def _statistics(
    e: Sequence[Array], jacobian: Sequence[Array], weights: Sequence[Array], covariances: Sequence[Array], free: int
) -> Jackknife:
    """Sandwich of the weights and of the covariances that the scatter gives, and the jackknife over it.

    A scatter found from `free` numbers is itself uncertain: the error over it is Student's, not normal.
    """
    left = [J.T @ w for J, w in zip(jacobian, weights, strict=True)]
    information = np.array([a @ J for a, J in zip(left, jacobian, strict=True)])
    gradient = np.array([a @ r for a, r in zip(left, e, strict=True)])
    middle = np.sum([a @ V @ a.T for a, V in zip(left, covariances, strict=True)], axis=0)
    bread = np.linalg.inv(information.sum(axis=0))
    return jackknife(information, gradient, bread @ middle @ bread * free / (free - 2))


def _distances(G: Array, points: Array, state: _State) -> Array:
    return np.asarray(np.linalg.norm(frames.transform(G @ state.T_mount, points) - state.centre, axis=1) - state.radius)


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


def _solve(G: Array, views: Sequence[SphereView], state: _State, weights: Sequence[Array], n: int) -> _State:
    W = [np.linalg.cholesky(w).T for w in weights]

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
