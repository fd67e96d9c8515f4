"""Features of a part fitted to the points of a run by least squares, and how their numbers answer to every point.

A fit makes Σ f(θ, p)² smallest. Where its points move by dp, what is fitted moves by dθ = −J⁺ (∂f/∂p · dp): the
implicit derivative of the normal equations, for residuals that are small against the feature. No fit is repeated.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import numpy as np
from scipy.optimize import least_squares

from stitch.errors import NoResultError
from stitch.numerics.distributions import mad_sigma
from stitch.numerics.frames import Array, Indices, Mask
from stitch.plugins.metrology.place_errors import RunPoints
from stitch.system.values import Value

# What a feature is, and the numbers that are told of it; the first is the one that a tolerance is of.
Kind = Literal["point", "deviation", "plane", "sphere", "cylinder", "circle", "distance"]
NUMBERS: dict[Kind, tuple[str, ...]] = {
    "point": ("deviation",),
    "deviation": ("deviation",),
    "plane": ("offset", "slope_u", "slope_v"),
    "sphere": ("diameter", "x", "y", "z"),
    "cylinder": ("diameter", "x", "y", "z"),
    "circle": ("diameter", "x", "y", "z"),
    "distance": ("distance",),
}
# More points of one feature tell nothing more: what counts is where the views are.
_MOST_POINTS = 20_000
# Normals of points and of the feature may part by 45°; residuals beyond 4 robust sigmas are no part of it.
_SAME_NORMAL, _OUTLYING = np.cos(np.radians(45.0)), 4.0
_FEWEST = 12
# Points that spread by more than this share of a diameter about a sphere, cylinder or circle are of other surfaces too.
_LARGEST_FORM = 0.25
# Of Gauss and Newton from a fit to the same points moved a little: each leaves a thousandth of what is missing.
_STEPS = 3
_Surface = Callable[[Array, Array], tuple[Array, Array, Array]]


@dataclass(frozen=True, eq=False)
class Feature(Value):
    """Feature that is asked for; lengths in length_unit of the run, reference frame.

    Example:
        >>> bore = stitch.Feature("bore", "cylinder", at=[10.0, 0.0, 5.0], axis=[0, 0, 1], size=8.0, radius=6.0)
        >>> bore.kind, bore.tolerance is None
        ('cylinder', True)
    """

    name: str
    kind: Kind
    at: Any = field(default_factory=lambda: np.zeros(3))  # (3,) nominal place
    axis: Any = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))  # (3,) unit: normal or axis
    size: float = 0.0  # nominal diameter
    radius: float = 0.0  # of the patch of a point, plane or deviation; half the length of a cylinder
    within: float = 0.0  # points count up to this distance from the nominal surface
    between: tuple[str, str] = ("", "")  # of a distance
    nominal: float | None = None  # of a distance; None: as the nominal places have it
    tolerance: tuple[float, float] | None = None  # limits of the deviation of its first number from nominal
    calibrated: float | None = None  # its first number as a laboratory measured it
    calibrated_U: float = 0.0  # expanded uncertainty (k = 2) of that
    cad: Any = field(default=None, compare=False)  # trimesh.Trimesh in the reference frame, of a deviation

    @property
    def R(self) -> Array:
        """(3, 3) axes u, v and the feature's own as columns, reference frame."""
        least = np.eye(3)[np.abs(self.axis).argmin()]
        u = np.cross(least, self.axis)
        u /= np.linalg.norm(u)
        return np.column_stack([u, np.cross(self.axis, u), self.axis])


@dataclass(frozen=True)
class FittedFeature:
    """A feature as the points show it."""

    feature: Feature
    at: RunPoints  # N points that count
    parameters: Array  # (k,) of its surface
    values: Array  # (q,) of NUMBERS
    slopes: Array  # (q, N) of the values in displacements of the points along `normal`
    normal: Array  # (N, 3) of the fitted surface
    residual: Array  # (N,)

    @property
    def position_slopes(self) -> Array:
        """(3, q) of `position_of` in the values."""
        if "x" in NUMBERS[self.feature.kind]:
            return np.eye(4)[1:]
        return np.outer(self.feature.axis, np.eye(len(self.values))[0])

    @property
    def form(self) -> float:
        """Width of the band that holds 95 % of the residuals (as ISO 10360-13 takes form from 95 % of the points)."""
        low, high = np.quantile(self.residual, [0.025, 0.975])
        return float(high - low)

    @property
    def noise(self) -> Array:
        """(N,) by which each point may lie off along the normal of the surface: its residual, for want of k of them.

        A scanner errs along the ray, so less across a surface at a slant: what a residual's square has on average is
        the variance at that point, and sums over the points are those of it (White 1980, Econometrica 48:817; times
        N/(N − k), MacKinnon and White 1985, J. Econometrics 29:305).
        """
        count = len(self.residual)
        return self.residual * np.sqrt(count / (count - len(self.parameters)))

    @property
    def gradient(self) -> Array:
        """(q, N, 3) of the values in the points."""
        return self.slopes[:, :, None] * self.normal

    def refit(self, points: Array) -> Array:
        """Return the values (q,) where the points that count lie at (N, 3)."""
        surface = _surface_of(self.feature, self.at)
        local = (points - self.feature.at) @ self.feature.R
        theta = self.parameters
        for _ in range(_STEPS):
            residual, J, _ = surface(theta, local)
            theta = theta - np.linalg.solve(J.T @ J, J.T @ residual)
        return _values(self.feature, theta)

    def thinned(self, most: int) -> "FittedFeature":
        """The same fitted to at most so many of its points."""
        keep = np.unique(np.linspace(0, len(self.residual) - 1, most).astype(np.int64))
        return fit_points(self.feature, self.at.take(keep), self.parameters)


def _sphere(theta: Array, p: Array) -> tuple[Array, Array, Array]:
    away = p - theta[:3]
    distance = np.linalg.norm(away, axis=1)
    normal = away / distance[:, None]
    return distance - theta[3], np.column_stack([-normal, -np.ones(len(p))]), normal


def _cylinder(theta: Array, p: Array) -> tuple[Array, Array, Array]:
    """Axis through (x, y, 0) along (a, b, 1), and the radius."""
    direction = np.array([theta[2], theta[3], 1.0])
    length = np.linalg.norm(direction)
    away = p - [theta[0], theta[1], 0.0]
    along = away @ direction / length**2
    across = away - along[:, None] * direction
    distance = np.linalg.norm(across, axis=1)
    normal = across / distance[:, None]
    J = np.column_stack([-normal[:, :2], -along[:, None] * normal[:, :2], -np.ones(len(p))])
    return distance - theta[4], J, normal


def _circle(theta: Array, p: Array) -> tuple[Array, Array, Array]:
    away = p[:, :2] - theta[:2]
    distance = np.linalg.norm(away, axis=1)
    normal = np.column_stack([away / distance[:, None], np.zeros(len(p))])
    return distance - theta[2], np.column_stack([-normal[:, :2], -np.ones(len(p))]), normal


def _plane(theta: Array, p: Array) -> tuple[Array, Array, Array]:
    J = np.column_stack([np.ones(len(p)), p[:, :2]])
    normal = np.broadcast_to([-theta[1], -theta[2], 1.0], p.shape)
    return p[:, 2] - J @ theta, -J, normal


def _from_cad(places: Array, normals: Array, theta: Array, p: Array) -> tuple[Array, Array, Array]:
    """An even offset of the CAD surface, at its places (N, 3) that are nearest to the points as they were found."""
    distance = np.einsum("ni,ni->n", p - places, normals)
    return distance - theta[0], -np.ones((len(p), 1)), normals


_SURFACES: dict[str, _Surface] = {
    "sphere": _sphere,
    "cylinder": _cylinder,
    "circle": _circle,
    "plane": _plane,
    "point": _plane,
}


def _surface_of(feature: Feature, at: RunPoints) -> _Surface:
    """Return the surface that a feature fits to some points."""
    if feature.kind != "deviation":
        return _SURFACES[feature.kind]
    places, normals = nearest_on_mesh(feature.cad, at.points)
    return partial(_from_cad, (places - feature.at) @ feature.R, normals @ feature.R)


def nearest_on_mesh(mesh: Any, points: Array) -> tuple[Array, Array]:
    """Return the nearest places (N, 3) of a trimesh and its normals (N, 3) there."""
    import igl

    faces = np.ascontiguousarray(mesh.faces, np.int64)
    _, face, place = igl.point_mesh_squared_distance(
        np.ascontiguousarray(points, float), np.ascontiguousarray(mesh.vertices, float), faces
    )
    return place, mesh.face_normals[face]


def nominal_parameters(feature: Feature) -> Array:
    """Return the parameters (k,) of the nominal surface in the frame of a feature."""
    count = {"sphere": 3, "cylinder": 4, "circle": 2}.get(feature.kind)
    if count is None:
        return np.zeros(1 if feature.kind == "deviation" else 3)
    return np.append(np.zeros(count), feature.size / 2)


def reach_of(feature: Feature) -> float:
    """Return the distance from its place within which all points of a feature lie."""
    side = feature.size / 2 + feature.within
    return float(np.hypot(side, feature.radius) if feature.size else np.hypot(feature.radius, feature.within))


def fit_feature(feature: Feature, points: RunPoints, near: Indices) -> FittedFeature:
    """Return a feature fitted to the points of a run that lie on it.

    Args:
        near: (M,) indices of points within `reach_of` the feature.

    Raises:
        NoResultError: too few points lie there, or they are of other surfaces too.
    """
    near = near[np.linspace(0, len(near) - 1, min(len(near), 4 * _MOST_POINTS)).astype(np.int64)]
    theta = nominal_parameters(feature)
    kept = near[_on_surface(feature, points.take(near), theta, feature.within)]
    for _ in range(2):
        if len(kept) < _FEWEST:
            raise NoResultError(
                f"{feature.name}: {len(kept)} points lie within {feature.within:g} of its nominal surface; "
                "to fix: correct its place, widen `within`, or scan it from more sides"
            )
        kept = kept[np.linspace(0, len(kept) - 1, min(len(kept), _MOST_POINTS)).astype(np.int64)]
        fit = fit_points(feature, points.take(kept), theta)
        kept = kept[np.abs(fit.residual) <= _OUTLYING * mad_sigma(fit.residual)]
    if feature.size and fit.form > _LARGEST_FORM * feature.size:
        raise NoResultError(
            f"{feature.name}: its points spread by {fit.form:.2g} about a {feature.kind} of {feature.size:g}; "
            f"to fix: correct its place, or narrow `within` (now {feature.within:.2g}), so that no other surface counts"
        )
    return fit


def fit_points(feature: Feature, at: RunPoints, start: Array) -> FittedFeature:
    """Return a feature fitted to all of some points, from parameters to begin with."""
    surface = _surface_of(feature, at)
    local = (at.points - feature.at) @ feature.R
    theta = least_squares(
        lambda x: surface(x, local)[0], start, jac=lambda x: surface(x, local)[1], method="lm", x_scale="jac"
    ).x
    residual, J, normal = surface(theta, local)
    # The numbers are linear in the parameters.
    zero = _values(feature, np.zeros(len(theta)))
    to_values = np.column_stack([_values(feature, unit) - zero for unit in np.eye(len(theta))])
    return FittedFeature(
        feature=feature,
        at=at,
        parameters=theta,
        values=_values(feature, theta),
        slopes=to_values @ -np.linalg.pinv(J),
        normal=normal @ feature.R.T,
        residual=residual,
    )


def _on_surface(feature: Feature, at: RunPoints, theta: Array, within: float) -> Mask:
    """(M,) points that lie on a surface (k,) of a feature, look as it does, and lie inside its bounds."""
    local = (at.points - feature.at) @ feature.R
    residual, _, normal = _surface_of(feature, at)(theta, local)
    if feature.kind == "circle":
        bounded = np.abs(local[:, 2]) <= within
    elif feature.kind == "cylinder":
        bounded = np.abs(local[:, 2]) <= feature.radius
    elif feature.kind == "sphere":
        bounded = np.ones(len(local), bool)
    else:
        bounded = np.linalg.norm(local[:, :2], axis=1) <= feature.radius
    same = np.abs(np.einsum("ni,ni->n", normal, at.normals @ feature.R)) > _SAME_NORMAL
    return bounded & same & (np.abs(residual) <= within)


def _values(feature: Feature, theta: Array) -> Array:
    """(q,) numbers of a feature from its parameters (k,)."""
    if "x" not in NUMBERS[feature.kind]:
        return theta[: len(NUMBERS[feature.kind])]
    centre = np.zeros(3)
    centre[: min(len(theta) - 1, 3 if feature.kind == "sphere" else 2)] = theta[: 3 if feature.kind == "sphere" else 2]
    return np.append(2 * theta[-1], feature.at + feature.R @ centre)


def position_of(feature: Feature, values: Array) -> Array:
    """Return the place (..., 3) of a feature with the values (..., q): a centre, or where its axis meets it."""
    if "x" in NUMBERS[feature.kind]:
        return values[..., 1:]
    return feature.at + values[..., :1] * feature.axis
