"""How far every view lies off along what an effect does, over what the effect lives on: the effect, to the eye.

A view's value is its displacement at the part along its unit motion: that of one joint where an effect is in a joint,
that of the mount or the part along the fitted twist, else the direction in which the effect displaces the views most.
The line is what the effect predicts; a dot is the line and what the whole model with the effect leaves, so that dots
off the line are what the effect does not explain. Effects of points are read along the rays, in bins of points.
"""

from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np

from stitch.diagnosis.candidates import Form, candidate_as_fitted
from stitch.diagnosis.residual_structure import Dependence, predicted_distances
from stitch.diagnosis.score import Score, score
from stitch.diagnosis.unmodelled_joint_effects import JointCurve
from stitch.effects.contract import EFFECTS, Effect, parameters_in, twist
from stitch.model.forward import moves_points, point_correction, scan_points
from stitch.model.model import Term
from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices
from stitch.numerics.units import covariate_text
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.surface_model import SurfaceObservation, surfaces_of
from stitch.session.measurement import ScanView, Views

# Dots along one trend: more cannot be told apart.
_MOST = 300
# Bins of the points of effects of the scanner and of the part's shape.
_BINS = 16
# Correspondences that are asked for one trend.
_ASKED = 60_000
_TEMPERATURES = {"part_growth": "part_temperature_c", "scanner_thermal_scale": "scanner_temperature_c"}
# What effects of points live on, with its unit, None for the session's; all others the angle in the field.
_POINT_AXES = {
    "range_scale": ("distance from the scanner", None),
    "range_nonlinearity": ("distance from the scanner", None),
    "incidence_bias": ("angle of incidence", "°"),
    "intensity_bias": ("intensity, in standard deviations", ""),
    "part_sag": ("height above the clamp", None),
}

# What an effect lives on, its unit, and where the views stand along it (V,).
_Axis = tuple[str, str, Array]


@dataclass(frozen=True)
class EffectTrend:
    """The trend of one effect over what it lives on; lengths in length_unit, angles in rad."""

    follows: str  # what it lives on: view order, time_s, angle of joint 2, …
    unit: str  # of `at`: "", s, °, N m, °C, length_unit
    of: str  # what is off: the part, the mount, joint 2, …
    value_unit: str  # of measured, sigma and predicted: rad, or length_unit
    at: Array  # (D,)
    views: Indices  # (D,) number of the view of each dot; empty where dots are bins of points
    measured: Array  # (D,)
    sigma: Array  # (D,) standard deviation of a dot, by the scatter about the line
    predicted: Array  # (D,)
    # The effect between the dots, (2, G): places and values; empty where the dots alone are known.
    law: Array = field(default_factory=lambda: np.zeros((2, 0)))

    def only(self, dots: Indices) -> "EffectTrend":
        """Return the trend with some of its dots."""
        numbers = {name: getattr(self, name)[dots] for name in ("at", "views", "measured", "sigma", "predicted")}
        return replace(self, **numbers)


def trend_of_candidate(linear: LinearModel, scored: Score) -> EffectTrend | None:
    """Return the trend of a candidate's best form; None where nothing of it was fitted."""
    if not scored.fitted:
        return None
    fitted = linear.restricted(())
    # As the field of the part predicts it: beside scatter alone, hand-eye and effects in use fitted anew.
    if fitted is not linear:
        scored = score(fitted, scored.candidate)
        if not scored.fitted:
            return None
    form = scored.form
    points = scored.candidate.points
    X = np.hstack([fitted.design, form.response])
    solution = fitted.trial(X, None if points is None else points.select(form.keep)).solve()
    values = solution[len(solution) - len(scored.values) :]
    term = form.at(values)
    if moves_points([term]):
        return _trend_of_points(fitted, scored, term)
    return _trend_of_views(fitted, term, form, values, X @ solution)


def trend_in_model(linear: LinearModel, term: Term) -> EffectTrend | None:
    """Return the trend of an effect that is in the model, as it was fitted; None for one that changes points."""
    if moves_points([term]) or not (~term.gridded & (term.values != 0)).any():
        return None
    fitted = linear.restricted(())
    form = candidate_as_fitted(fitted, term).forms[0]
    return _trend_of_views(fitted, term, form, term.values[form.keep], fitted.design @ fitted.baseline_trial.solve())


def trend_of_curve(linear: LinearModel, curve: JointCurve) -> EffectTrend | None:
    """Return how far a joint is off along what its error follows without a name, beside its mean."""
    fitted = linear.restricted(())
    joint = curve.joint - 1
    error = np.interp(curve.view_values, curve.at, curve.error)
    turned = _joint_columns(fitted)[:, joint : joint + 1]
    X = np.hstack([fitted.design, turned * _of_rows(fitted, error[:, None], len(turned))])
    solution = fitted.trial(X).solve()
    columns = _displacements(fitted, turned)[..., 0]
    motion = _Motion(f"joint {curve.joint}", "rad", columns, solution[-1] * error[:, None] * columns, joint)
    name, unit = (covariate_text(curve.covariate), "") if curve.covariate != "time_s" else ("time", "s")
    return _along_motion(fitted, motion, X @ solution, 1, (name, unit, curve.view_values))


def trend_of_dependence(linear: LinearModel, dependence: Dependence) -> EffectTrend:
    """Return where the views lie off along what their displacement follows without a name, and its means in bins."""
    predicted = np.interp(dependence.at, dependence.bins, dependence.mean)
    sigma = float(np.std(dependence.moved - predicted, ddof=1)) if len(predicted) > 1 else 0.0
    trend = EffectTrend(
        follows=dependence.covariate,
        unit="",
        of="the views",
        value_unit=linear.measurement.length_unit,
        at=dependence.at,
        views=np.arange(len(predicted)),
        measured=dependence.moved,
        sigma=np.full(len(predicted), sigma),
        predicted=predicted,
    )
    return trend.only(_shown(len(predicted)))


def _shown(views: int) -> Indices:
    """Return the numbers of the views that are shown."""
    return np.unique(np.linspace(0, views - 1, min(views, _MOST)).astype(np.int64))


@dataclass(frozen=True)
class _Motion:
    """What is off, and how a unit of that displaces each view."""

    of: str
    unit: str
    columns: Array  # (V, k) displacements
    response: Array  # (V, k) displacements by the effect
    joint: int | None = None  # counted from 0

    @property
    def line(self) -> Array:
        """(V,) displacement by the effect along that of a unit, times the latter."""
        return np.sum(self.columns * self.response, axis=1)


def _trend_of_views(linear: LinearModel, term: Term, form: Form, values: Array, explained: Array) -> EffectTrend | None:
    """Return the trend of an effect of views.

    Args:
        values: (p,) of the form's free parameters.
        explained: response of the whole model with the effect.
    """
    motion = _motion(linear, term, form, values)
    views = linear.measurement.views
    # Where the part sat at first is nobody's error.
    from_first = term.effect.place == "part"
    trend = _along_motion(linear, motion, explained, len(values), _axis(views, term, motion), from_first=from_first)
    if trend is None or motion.joint is None or not trend.follows.startswith("angle"):
        return trend
    return replace(trend, law=_over_a_turn(views, form.at(values), motion.joint))


def _over_a_turn(views: Views, fitted: Term, joint: int) -> Array:
    """Return what an effect does to a joint over its whole turn (2, G), ° and rad: over the angles seen alone, a gear
    that runs out of true looks like a slope. Empty where it takes more than this joint's angle, or does not vary.
    """
    turn = np.radians(np.linspace(-180, 180, 121))
    asked = np.concatenate([turn, views.joints[:, joint]])
    others_still = np.tile(views.joints[0], (len(asked), 1))
    others_still[:, joint] = asked
    errors = _joint_errors(replace(views.only([0] * len(asked)), joints=others_still), fitted)[:, joint]
    over_turn, in_views = errors[: len(turn)], errors[len(turn) :]
    alone = np.allclose(in_views, _joint_errors(views, fitted)[:, joint], rtol=1e-6, atol=1e-12)
    if alone and np.ptp(over_turn) > 1e-6 * np.abs(over_turn).max():
        return np.stack([np.degrees(turn), over_turn])
    return np.zeros((2, 0))


def _along_motion(
    linear: LinearModel, motion: _Motion, explained: Array, free: int, axis: _Axis, *, from_first: bool = False
) -> EffectTrend | None:
    """Return every view along its unit motion: the line, and beside it what the model with the effect leaves.

    Args:
        explained: response of the whole model with the effect.
        free: number of fitted parameters of the effect.
        from_first: count from where the first view is.
    """
    square = np.sum(motion.columns**2, axis=1)
    if not (square > 0).any():
        return None
    # Where a unit moves a view by next to nothing, the view says nothing of it.
    square = np.maximum(square, 1e-2 * np.median(square))
    left = linear.mixed.z.ravel() - linear.reduce(explained[:, None])[:, 0]
    line = motion.line / square
    off = np.sum(motion.columns * _displacements(linear, linear.observation.expand(left[:, None]))[..., 0], axis=1)
    scatter = float(np.sqrt(np.mean(off**2 / square) * len(line) / max(len(line) - free, 1)))
    follows, unit, at = axis
    if from_first:
        line = line - line[np.argmin(at)]
    sign = 1.0 if motion.joint is not None or line[np.argmax(np.abs(line))] >= 0 else -1.0
    trend = EffectTrend(
        follows,
        unit,
        motion.of,
        motion.unit,
        at,
        np.arange(len(line)),
        measured=sign * (line + off / square),
        sigma=scatter / np.sqrt(square),
        predicted=sign * line,
    )
    return trend.only(_shown(len(line)))


def _motion(linear: LinearModel, term: Term, form: Form, values: Array) -> _Motion:
    """Return what an effect moves, by its place in the chain of frames."""
    response = _displacements(linear, form.response @ values[:, None])[..., 0]
    unit = linear.measurement.length_unit
    fitted = form.at(values)
    if term.effect.place == "robot":
        turned = _joint_columns(linear)
        errors = _joint_errors(linear.measurement.views, fitted)
        reduced = linear.reduce(turned * _of_rows(linear, errors, len(turned)))
        joint = int(np.argmax(np.sum(reduced**2, axis=0)))
        columns = _displacements(linear, turned[:, joint : joint + 1])[..., 0]
        return _Motion(f"joint {joint + 1}", "rad", columns, errors[:, joint : joint + 1] * columns, joint)
    if term.effect.place == "mount":
        specs = {"xi": twist("", 1e-3, 1.0)}
        constant = Effect(
            "constant", "mount", specs, lambda views, xi: np.tile(xi, (views.count, 1)), (), (), "empirical"
        )
        twists = fitted.effect.function(linear.measurement.views, **fitted.arguments)
        along = (twists - twists.mean(axis=0))[np.argmax(np.sum(response**2, axis=1))]
        at_constant = linear.responses([Term(constant, parameters_in(linear.measurement, constant))])[0].columns
        columns = _displacements(linear, at_constant @ along[:, None])[..., 0]
        # Rows of a mean length of one.
        columns = columns / max(float(np.mean(np.linalg.norm(columns, axis=1))), 1e-300)
        return _Motion("the scanner's mount", unit, columns, response)
    direction = np.linalg.svd(response - response.mean(axis=0), full_matrices=False)[2][0]
    of = "the part" if term.effect.place == "part" else "the arm"
    return _Motion(of, unit, np.tile(direction, (len(response), 1)), response)


def _joint_columns(linear: LinearModel) -> Array:
    """Return (·, n) response to a turn of each joint."""
    offset = EFFECTS["joint_offset"]
    return linear.responses([Term(offset, parameters_in(linear.measurement, offset))])[0].columns


def _joint_errors(views: Views, fitted: Term) -> Array:
    """Return (V, n) rad by which an effect turns the joints."""
    errors: Array = fitted.effect.function(views.joints, views, **fitted.arguments) - views.joints
    return errors


def _of_rows(linear: LinearModel, values: Array, count: int) -> Array:
    """Return (count, P) values of the views (V, P) for every row of a response; zero for rows of no view."""
    rows = np.repeat(values, len(linear.mixed.z[0]) if surfaces_of(linear) is None else 6, axis=0)
    return np.vstack([rows, np.zeros((count - len(rows), values.shape[1]))])


def _displacements(linear: LinearModel, response: Array) -> Array:
    """Return (V, k, P) displacements at the part of responses (·, P); of surfaces a turn counts by what it does at the
    rim."""
    observation = linear.observation
    surfaces = surfaces_of(linear)
    if surfaces is None:
        columns = observation.reduce(response).T
        return np.stack([observation.part_displacements(column) for column in columns], axis=2)
    twists = response.reshape(linear.measurement.views.count, 6, -1).copy()
    twists[:, :3] *= surfaces.reach
    return twists


def _axis(views: Views, term: Term, motion: _Motion) -> _Axis:
    """Return what an effect of views lives on, its unit, and where the views stand along it."""
    effect = term.effect
    if motion.joint is not None:
        return _joint_axis(views, term, motion.joint)
    for weight in ("gravity_at_mount", "gravity_at_part"):
        if weight in effect.needs:
            # What gives way under its weight lives on the pull of gravity along the direction that moves it most.
            gravity = getattr(views, weight)
            line = motion.line / np.maximum(np.sum(motion.columns**2, axis=1), 1e-300)
            slope = np.linalg.lstsq(np.column_stack([gravity, np.ones(len(line))]), line, rcond=1e-6)[0][:3]
            pull = gravity @ slope / max(float(np.linalg.norm(slope)), 1e-300)
            return "pull of gravity where it gives way most", "g", pull
    covariate = next((name for name in (*effect.prefers, *effect.needs) if name in views.covariates), None)
    if covariate is not None:
        return covariate, "", views.covariates[covariate]
    is_event = any(p.discrete for p in term.parameters)
    if views.has("time") and not is_event and ("time" in effect.needs or effect.prefers):
        return "time", "s", views.time
    return "view order", "", np.arange(views.count, dtype=float)


def _joint_axis(views: Views, term: Term, joint: int) -> _Axis:
    """Return what an effect of a joint, counted from 0, lives on."""
    number = joint + 1
    bending = [k for k, bent in enumerate(views.torques.joint) if bent == joint]
    if "torque" in term.effect.needs and bending:
        torques = views.torques.values
        largest = max(bending, key=lambda k: abs(term.values[k]) * float(np.ptp(torques[:, k])))
        return f"torque on joint {number}", "N m", torques[:, largest]
    if term.name == "backlash":
        return f"last move of joint {number}: −1 down, +1 up", "", views.approach[:, joint]
    if term.name == "settling":
        return f"last move of joint {number}", "°", np.degrees(views.joints - views.previous)[:, joint]
    if "velocity" in term.effect.needs and views.velocity is not None:
        return f"speed of joint {number}", "°/s", np.degrees(views.velocity[:, joint])
    return f"angle of joint {number}", "°", np.degrees(views.joints[:, joint])


def _trend_of_points(linear: LinearModel, scored: Score, term: Term) -> EffectTrend | None:
    """Return means over bins of points, each the effect and what the model with it leaves along its motion."""
    surfaces = surfaces_of(linear)
    distances = predicted_distances(linear, scored)
    if distances is None or surfaces is None:
        return None
    rows = _points_of_matches(linear, surfaces, term, distances)
    dots = _binned(*rows)
    if dots is None:
        return None
    at, measured, sigma, predicted = dots
    views = linear.measurement.views
    length = linear.measurement.length_unit
    temperature = _TEMPERATURES.get(term.name)
    unit: str | None
    if temperature is not None:
        follows, unit = (temperature, "°C") if temperature in views.covariates else ("time", "s")
    else:
        follows, unit = _POINT_AXES.get(term.name, ("angle from the middle of the field", "°"))
    return EffectTrend(
        follows=follows,
        unit=length if unit is None else unit,
        of="the part" if term.effect.place == "shape" else "the scanner",
        value_unit=length,
        at=at,
        views=np.zeros(0, np.int64),
        measured=measured,
        sigma=sigma,
        predicted=predicted,
    )


def _points_of_matches(linear: LinearModel, surfaces: SurfaceObservation, term: Term, distances: Array) -> list[Any]:
    """Return of points (N,) of some correspondences: where each stands along what the effect lives on, how far the
    effect moves it, the cosine of that motion to the normal, the distance that is left, and its view."""
    poses = surfaces.capture.poses(linear.model.T_mount)
    matches = surfaces.unconstrained.overlaps.matches
    step = max(sum(len(m.residual) for m in matches) // _ASKED, 1)
    rows = list[tuple[Array, ...]]()
    start = 0
    for m in matches:
        some = np.arange(0, len(m.residual), step)
        left = distances[start + some]
        start += len(m.residual)
        for v, index, sign in ((m.v, m.index_v[some], 1.0), (m.w, m.index_w[some], -1.0)):
            points, view = scan_points(linear.measurement, v, index)
            size, direction = _sizes(term, points, view, poses[v])
            facing = np.einsum("ni,ni->n", frames.rotate(poses[v], direction), m.normal[some])
            place = _place_of(term.name, points, view, poses[v])
            rows.append((place, size, sign * facing, left, np.full(len(some), v)))
    return [np.concatenate(column) for column in zip(*rows, strict=True)]


def _sizes(term: Term, points: Array, view: ScanView, pose: Array) -> tuple[Array, Array]:
    """Return (N,) how far an effect moves points, and (N, 3) where to, scanner frame: along the rays where it does
    so."""
    moved = -point_correction([term], points, view, pose)
    rays = view.along(points)
    along = np.einsum("ni,ni->n", moved, rays)
    length = np.linalg.norm(moved, axis=1)
    if np.sum(along**2) > 0.9 * np.sum(length**2):
        return along, rays
    return length, moved / np.maximum(length, 1e-300)[:, None]


def _place_of(name: str, points: Array, view: ScanView, pose: Array) -> Array:
    """Return (N,) where points stand along what an effect of points lives on."""
    match name:
        case "range_scale" | "range_nonlinearity":
            return np.linalg.norm(view.away(points), axis=1)
        case "incidence_bias":
            return np.degrees(np.arccos(np.clip(view.cosine, 0, 1)))
        case "intensity_bias":
            assert view.intensity is not None
            return view.intensity
        case "part_sag":
            return frames.transform(pose, points)[:, 2]
        case "part_growth" | "scanner_thermal_scale":
            at = view.views.covariates.get(_TEMPERATURES[name], view.views.time)
            return np.full(len(points), float(at[view.index]))
    return np.degrees(np.arctan(np.sqrt(view.rho2(points))))


def _binned(at: Array, size: Array, cosine: Array, left: Array, view_of: Indices) -> Array | None:
    """Return (4, D) place, measured value, sigma and prediction of a dot for each of equal counts of points; its sigma
    is the scatter of the views' own means about it."""
    edges = np.unique(np.quantile(at, np.linspace(0, 1, _BINS + 1)))
    if len(edges) < 3:
        return None
    dots = []
    for low, high in pairwise(edges):
        inside = (at >= low) & (at <= high)
        weight = np.sum(cosine[inside] ** 2)
        if weight <= 0:
            continue
        off = float(np.sum(cosine[inside] * left[inside]) / weight)
        of_views = view_of[inside]
        top = np.bincount(of_views, (cosine * left)[inside])
        below = np.bincount(of_views, (cosine**2)[inside])
        known = below > 0
        spread = np.sqrt(np.sum((top[known] - off * below[known]) ** 2)) / weight
        predicted = float(size[inside].mean())
        dots.append((float(at[inside].mean()), predicted + off, float(spread), predicted))
    return np.array(dots).T
