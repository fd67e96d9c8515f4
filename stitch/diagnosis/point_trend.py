"""Trends of effects that change points: the distances between scans over what moves their points, in bins of points.

A dot is the mean over the points of a bin; its line is what the effect explains of it. Effects are read along the rays
where they move points along these.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from stitch.diagnosis.fitted_effect import EffectTrend, FittedEffect
from stitch.diagnosis.residual_structure import predicted_distances
from stitch.diagnosis.score import Score
from stitch.model.forward import point_correction, scan_points
from stitch.model.model import Term
from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices, Mask
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.surface_model import SurfaceObservation, surfaces_of
from stitch.session.measurement import ScanView, Views

# Bins of the points of effects of the scanner and of the part's shape.
_BINS = 16
# Correspondences at the most that one trend takes.
_MOST_CORRESPONDENCES = 60_000
# Effects of points that grow with a covariate of views, or else with time.
_TEMPERATURES = {"part_growth": "part_temperature_c", "scanner_thermal_scale": "scanner_temperature_c"}


class _Axis(NamedTuple):
    """What an effect of points depends on, and its unit; None for the session's."""

    follows: str
    unit: str | None
    values: Callable[[Array, ScanView, Array], Array]  # (N,) of points (N, 3) in the scanner's frame, their view, pose


_RANGE = _Axis("distance from the scanner", None, lambda points, view, _: np.linalg.norm(view.away(points), axis=1))
_AXES = {
    "range_scale": _RANGE,
    "range_nonlinearity": _RANGE,
    "incidence_bias": _Axis(
        "angle of incidence", "°", lambda points, view, _: np.degrees(np.arccos(np.clip(view.cosine, 0, 1)))
    ),
    "intensity_bias": _Axis("intensity, in standard deviations", "", lambda _, view, __: np.asarray(view.intensity)),
    "part_sag": _Axis("height above the clamp", None, lambda points, _, pose: frames.transform(pose, points)[:, 2]),
}
_FIELD = _Axis(
    "angle from the middle of the field",
    "°",
    lambda points, view, _: np.degrees(np.arctan(np.sqrt(view.rho2(points)))),
)


def trends_of_points(
    linear: LinearModel, effects: Sequence[FittedEffect], scores: Sequence[Score]
) -> dict[str, EffectTrend]:
    """Return trends of effects that change points, by name: means over bins of points in place of dots of views.

    A dot is the distance that the model leaves in a bin, divided by the cosine between the first effect's motion and
    the normal. A line is the part of that which an effect explains. Its sigma is |line| / √W, with the Wald statistic
    W = vᵀ C⁻¹ v of the effect's values v. Empty without clouds.

    Args:
        effects: fitted effects; the first chooses both axes.
        scores: of these effects, in the same order.
    """
    surfaces = surfaces_of(linear)
    left = predicted_distances(linear)
    if surfaces is None or left is None:
        return {}
    term = effects[0].term
    axis = _axis_of(term.name, linear.measurement.views)
    at, cosine, row, view_of = _points_of_matches(linear, surfaces, term, axis, len(left))
    bins = _bins(at, cosine)
    if not bins:
        return {}
    length = linear.measurement.length_unit
    places = np.array([at[inside].mean() for inside in bins])
    plots = [predicted_distances(linear, scored) for scored in scores]
    if plots[0] is None:
        return {}
    sigma = _scatter(bins, cosine, plots[0][row], view_of)
    trends = {}
    for effect, remaining in zip(effects, plots, strict=True):
        if remaining is None:
            continue
        predicted = _means(bins, cosine, (left - remaining)[row])
        change = effect.change
        wald = float(change.values @ np.linalg.pinv(change.covariance) @ change.values)
        trends[effect.term.name] = EffectTrend(
            follows=axis.follows,
            unit=length if axis.unit is None else axis.unit,
            of=_owner(term),
            value_unit=length,
            at=places,
            views=np.zeros(0, np.int64),
            measured=_means(bins, cosine, left[row]),
            sigma=sigma,
            predicted=predicted,
            predicted_sigma=np.abs(predicted) / np.sqrt(max(wald, 1e-300)),
            moves=_owner(effect.term),
            effect=predicted,
        )
    return trends


def _axis_of(name: str, views: Views) -> _Axis:
    """Return what an effect depends on, by name; unknown ones on the angle from the middle of the field."""
    if (temperature := _TEMPERATURES.get(name)) is None:
        return _AXES.get(name, _FIELD)
    known = temperature in views.covariates
    follows, unit = (temperature, "°C") if known else ("time", "s")
    at = views.covariates[temperature] if known else views.time
    return _Axis(follows, unit, lambda points, view, _: np.full(len(points), float(at[view.index])))


def _owner(term: Term) -> str:
    """Return what an effect of points belongs to."""
    return "the part" if term.effect.place == "shape" else "the scanner"


def _points_of_matches(
    linear: LinearModel, surfaces: SurfaceObservation, term: Term, axis: _Axis, count: int
) -> list[Any]:
    """Return four arrays (N,) on both points of at most `_MOST_CORRESPONDENCES` correspondences.

    1. The value of what the effect depends on.
    2. The cosine between the effect's motion and the normal, with the sign of the distance: first view less second.
    3. The number of the correspondence.
    4. The point's view.

    Args:
        count: number of all correspondences.
    """
    poses = surfaces.capture.poses(linear.model.T_mount)
    matches = surfaces.unconstrained.overlaps.matches
    step = max(count // _MOST_CORRESPONDENCES, 1)
    rows = list[tuple[Any, ...]]()
    start = 0
    for m in matches:
        some = np.arange(0, len(m.residual), step)
        number = start + some
        start += len(m.residual)
        for v, index, sign in ((m.v, m.index_v[some], 1.0), (m.w, m.index_w[some], -1.0)):
            points, view = scan_points(linear.measurement, v, index)
            direction = _directions(term, points, view, poses[v])
            cosine = np.einsum("ni,ni->n", frames.rotate(poses[v], direction), m.normal[some])
            rows.append((axis.values(points, view, poses[v]), sign * cosine, number, np.full(len(some), v)))
    return [np.concatenate(column) for column in zip(*rows, strict=True)]


def _directions(term: Term, points: Array, view: ScanView, pose: Array) -> Array:
    """Return unit vectors (N, 3) of the direction in which an effect moves points, scanner frame.

    If more than 90 % of the squared motion lies along the rays, these are returned: their sign is the same everywhere.
    """
    moved = -point_correction([term], points, view, pose)
    rays: Array = view.along(points)
    along = np.einsum("ni,ni->n", moved, rays)
    length = np.linalg.norm(moved, axis=1)
    if np.sum(along**2) > 0.9 * np.sum(length**2):
        return rays
    return moved / np.maximum(length, 1e-300)[:, None]


def _bins(at: Array, cosine: Array) -> list[Mask]:
    """Return masks (N,) of bins of equal counts of points in which the effect can be seen; [] if all points are alike.

    Args:
        at: (N,) what the bins divide.
        cosine: (N,) between the effect's motion and the normal.
    """
    edges = np.unique(np.quantile(at, np.linspace(0, 1, _BINS + 1)))
    inside = [(at >= low) & (at <= high) for low, high in pairwise(edges)]
    return [some for some in inside if np.sum(cosine[some] ** 2) > 0] if len(edges) > 2 else []


def _means(bins: Sequence[Mask], cosine: Array, distances: Array) -> Array:
    """Return the motion (D,) of each bin's points by least squares: Σ cosine · distance / Σ cosine².

    Args:
        bins: D masks (N,).
        cosine: (N,) between the motion and the normal.
        distances: (N,) along the normal, length_unit.
    """
    return np.array([np.sum(cosine[b] * distances[b]) / np.sum(cosine[b] ** 2) for b in bins])


def _scatter(bins: Sequence[Mask], cosine: Array, remaining: Array, view_of: Indices) -> Array:
    """Return the standard deviation (D,) of `_means`, views as the independent samples.

    With t_v = Σ cosine · (distance − cosine · mean) over the points of view v, it is √(Σ t_v²) / Σ cosine².

    Args:
        remaining: (N,) distances that the effect leaves, length_unit.
        view_of: (N,) view of each point.
    """
    sigma = []
    for b, mean in zip(bins, _means(bins, cosine, remaining), strict=True):
        products = np.bincount(view_of[b], (cosine * remaining)[b])
        squares = np.bincount(view_of[b], cosine[b] ** 2)
        sigma.append(np.sqrt(np.sum((products - mean * squares) ** 2)) / squares.sum())
    return np.array(sigma)
