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

from stitch import frames
from stitch.calibrate.sphere_model import SphereState, linearise_sphere, solve_sphere, sphere_distances
from stitch.calibrate.sphere_scatter import find_scatter, find_shares, view_covariances
from stitch.calibrate.sphere_views import SphereView
from stitch.calibrate.view_jackknife import Jackknife, jackknife
from stitch.errors import NoResultError
from stitch.frames import Array

_ROUNDS = 20
# Numbers that the views must leave over for their scatter.
_FREE = 6
# Relative change of the scatters that ends the search.
_SMALL = 0.01


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
class _LinearisedSphere:
    """Residuals, Jacobians and responses to a shift by view, at a state; the weights and scatters that go with it."""

    state: SphereState
    e: list[Array]  # (k + 1,) predicted less measured circle or sphere
    jacobian: list[Array]  # (k + 1, n)
    response: list[Array]  # (k + 1, 3)
    weights: list[Array]  # (k + 1, k + 1)
    scatter: Array  # (σ_p, σ_ρ, σ_c)
    shares: Array  # (V,)


def fit_sphere(
    G: Array,
    views: Sequence[SphereView],
    T_mount: Array,
    radius: float,
    radius_free: bool = False,
    by_views: bool = False,
) -> SphereFit:
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
    free = _free_numbers(len(views), n)
    # The points' own sum has side minima for laser lines; the views' leads to the right one.
    found = _reweight(G, views, _initial_linearisation(G, views, T_mount, radius, n))
    if not by_views:
        found = _reweight(G, views, found, _points_weights(views, radius))
    state, statistics = found.state, _statistics(found, views, free)
    off = [sphere_distances(G[v], view.points, state) for v, view in enumerate(views)]
    return SphereFit(
        T_mount=state.T_mount,
        centre=state.centre,
        radius=state.radius,
        covariance=statistics.covariance,
        inflation=statistics.inflation,
        scatter=found.scatter,
        point_sigma=float(np.median([v.sigma for v in views])),
        rms=float(np.sqrt(np.mean(np.concatenate(off) ** 2))),
        view_rms=np.array([np.sqrt(np.mean(d**2)) for d in off]),
        left_out=statistics.steps,
        shares=found.shares,
    )


def _free_numbers(views: int, n: int) -> int:
    """Numbers that the views leave over for their scatter; refused where they are too few."""
    free = 3 * views - n
    if free < _FREE:
        needed = -(-(n + _FREE) // 3)
        raise NoResultError(f"{views} views for {n} unknowns; to fix: scan the sphere from {needed} or more poses")
    return free


def _initial_linearisation(
    G: Array, views: Sequence[SphereView], T_mount: Array, radius: float, n: int
) -> _LinearisedSphere:
    feet = np.array([v.foot for v in views])
    state = SphereState(T_mount, np.median(frames.transform(G @ T_mount, feet[:, None])[:, 0], axis=0), radius)
    e, jacobian, response = linearise_sphere(G, views, state, n)
    scatter = np.array([0.005 * radius, 0.002 * radius, 2 * np.median([v.sigma for v in views])])
    return _LinearisedSphere(state, e, jacobian, response, weights=[], scatter=scatter, shares=np.ones(len(views)))


def _points_weights(views: Sequence[SphereView], radius: float) -> list[Array]:
    """Weights under which every point counts the same."""
    # Distances from a circle of radius ρ are R/ρ times those from the sphere.
    return [np.linalg.inv(v.covariance) * (v.sigma * min(v.measured[-1] / radius, 1.0)) ** 2 for v in views]


def _reweight(
    G: Array, views: Sequence[SphereView], linearised: _LinearisedSphere, by_points: Sequence[Array] | None = None
) -> _LinearisedSphere:
    """Fit and scatters in turn until the scatters stand; weights of the points, or else from the scatters."""
    for _ in range(_ROUNDS):
        if by_points is None:
            spread = view_covariances(views, linearised.response, linearised.scatter, linearised.shares)
            weights = [np.asarray(np.linalg.inv(V)) for V in spread]
        else:
            weights = [w * share for w, share in zip(by_points, linearised.shares, strict=True)]
        n = linearised.jacobian[0].shape[1]
        state = solve_sphere(G, views, linearised.state, weights, n)
        e, jacobian, response = linearise_sphere(G, views, state, n)
        shares = linearised.shares
        if by_points is None:
            shares = find_shares(e, view_covariances(views, response, linearised.scatter, np.ones(len(views))))
        scatter = find_scatter(views, e, jacobian, response, last=linearised.scatter, shares=shares)
        change = float(np.abs(np.log(scatter / linearised.scatter)).max())
        linearised = _LinearisedSphere(state, e, jacobian, response, weights=weights, scatter=scatter, shares=shares)
        if change < _SMALL:
            break
    return linearised


def _statistics(linearised: _LinearisedSphere, views: Sequence[SphereView], free: int) -> Jackknife:
    """Sandwich of the weights and of the covariances that the scatter gives, and the jackknife over it.

    A scatter found from `free` numbers is itself uncertain: the error over it is Student's, not normal.
    """
    spread = view_covariances(views, linearised.response, linearised.scatter, linearised.shares)
    left = [J.T @ w for J, w in zip(linearised.jacobian, linearised.weights, strict=True)]
    information = np.array([a @ J for a, J in zip(left, linearised.jacobian, strict=True)])
    gradient = np.array([a @ r for a, r in zip(left, linearised.e, strict=True)])
    middle = np.sum([a @ V @ a.T for a, V in zip(left, spread, strict=True)], axis=0)
    bread = np.linalg.inv(information.sum(axis=0))
    return jackknife(information, gradient, bread @ middle @ bread * free / (free - 2))
