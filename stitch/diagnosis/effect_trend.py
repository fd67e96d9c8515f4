"""How far every view lies off along what an effect does, over what the effect lives on: the law, to the eye.

A view's value is its displacement at the part along its unit motion: that of one joint where an effect is in a joint,
that of the mount or the part along the fitted twist, else the direction in which the effect displaces the views most.
The line is what the effect predicts; a dot is the line and what the whole model with the effect leaves, so that dots
off the line are what the effect does not explain. Effects of points are read along the rays, in bins of points.
"""

from dataclasses import dataclass, field, replace
from itertools import pairwise

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
from stitch.observations.surfaces.surface_model import surfaces_of
from stitch.session.measurement import ScanView, Views

# Dots along one course: more cannot be told apart.
_MOST = 300
# Bins of the points of effects of the scanner and of the part's shape.
_BINS = 16
# Correspondences that are asked for one course.
_ASKED = 60_000


@dataclass(frozen=True)
class EffectTrend:
    """The course of one effect over what it lives on; lengths in length_unit, angles in rad."""

    follows: str  # what it lives on: view order, time_s, angle of joint 2, …
    unit: str  # of `at`: "", s, °, N m, °C, length_unit
    of: str  # what is off: the part, the mount, joint 2, …
    value_unit: str  # of measured, sigma and predicted: rad, or length_unit
    at: Array  # (D,)
    views: Indices  # (D,) number of the view of each dot; empty where dots are bins of points
    measured: Array  # (D,)
    sigma: Array  # (D,) standard deviation of a dot, by the scatter about the line
    predicted: Array  # (D,)
    # The law between the dots, (2, G): places and values; empty where the dots alone are known.
    law: Array = field(default_factory=lambda: np.zeros((2, 0)))


def trend_of_candidate(linear: LinearModel, scored: Score) -> EffectTrend | None:
    """The course of a candidate's best form; None where nothing of it was fitted."""
    if not scored.fitted:
        return None
    fitted = linear.restricted(())
    # As the field of the part predicts it: beside scatter alone, hand-eye and effects in use fitted anew.
    own = scored if fitted is linear else score(fitted, scored.candidate)
    if not own.fitted:
        return None
    X = np.hstack([fitted.design, own.form.response])
    sums = own.candidate.points
    found = fitted.trial(X, None if sums is None else sums.select(own.form.keep)).solve()
    term = own.form.at(found[len(found) - own.form.response.shape[1] :])
    if moves_points([term]):
        return _course_of_points(fitted, own, term)
    return _course_of_views(fitted, term, own.form, found[len(found) - len(own.values) :], X @ found)


def trend_in_model(linear: LinearModel, term: Term) -> EffectTrend | None:
    """The course of an effect that is in the model, as it was fitted; None for one that changes points."""
    if moves_points([term]) or not (~term.gridded & (term.values != 0)).any():
        return None
    fitted = linear.restricted(())
    form = candidate_as_fitted(fitted, term).forms[0]
    return _course_of_views(fitted, term, form, term.values[form.keep], fitted.design @ fitted.baseline_trial.solve())


def trend_of_curve(linear: LinearModel, curve: JointCurve) -> EffectTrend | None:
    """How far a joint is off along what its error follows without a name, beside its mean."""
    fitted, joint = linear.restricted(()), curve.joint - 1
    law = np.interp(curve.view_values, curve.at, curve.error)
    turned = _joint_columns(fitted)[:, joint : joint + 1]
    response = turned * _of_rows(fitted, law[:, None], len(turned))
    X = np.hstack([fitted.design, response])
    found = fitted.trial(X).solve()
    columns = _displacements(fitted, turned)[..., 0]
    motion = _Motion(f"joint {curve.joint}", "rad", columns, found[-1] * law[:, None] * columns, joint)
    axis = (covariate_text(curve.covariate), "") if curve.covariate != "time_s" else ("time", "s")
    return _along_motion(fitted, motion, X @ found, 1, (*axis, curve.view_values))


def trend_of_dependence(linear: LinearModel, found: Dependence) -> EffectTrend:
    """Where the views lie off along what their displacement follows without a name, and its means in bins."""
    shown = _some(len(found.at))
    fitted = np.interp(found.at, found.bins, found.mean)
    sigma = float(np.std(found.moved - fitted, ddof=1)) if len(fitted) > 1 else 0.0
    dots = {"measured": found.moved, "sigma": np.full(len(fitted), sigma), "predicted": fitted}
    return EffectTrend(
        follows=found.covariate,
        unit="",
        of="the views",
        value_unit=linear.measurement.length_unit,
        at=found.at[shown],
        views=shown,
        **{name: x[shown] for name, x in dots.items()},
    )


def _some(views: int) -> Indices:
    """Return the numbers of the views that are shown."""
    return np.unique(np.linspace(0, views - 1, min(views, _MOST)).astype(np.int64))


# Effects that move views.


@dataclass(frozen=True)
class _Motion:
    """What is off, and how a unit of that displaces each view."""

    of: str
    unit: str
    columns: Array  # (V, k) displacements
    response: Array  # (V, k) displacements by the effect
    joint: int | None = None


def _course_of_views(
    linear: LinearModel, term: Term, form: Form, values: Array, explained: Array
) -> EffectTrend | None:
    """The course of an effect of views.

    Args:
        values: (p,) of the form's free parameters.
        explained: response of the whole model with the effect.
    """
    motion = _motion(linear, term, form, values)
    views = linear.measurement.views
    axis = _lives_on(views, term, motion)
    # Where the part sat at first is nobody's error.
    course = _along_motion(linear, motion, explained, len(values), axis, from_first=term.effect.place == "part")
    if course is None or motion.joint is None or not course.follows.startswith("angle"):
        return course
    return replace(course, law=_over_a_turn(views, form.at(values), motion.joint))


def _over_a_turn(views: Views, fitted: Term, joint: int) -> Array:
    """Return the law of a joint over its whole turn (2, G), ° and rad: over the angles seen alone, a gear that runs
    out of true looks like a slope. Empty where the law takes more than this joint's angle, or does not vary.
    """
    turn = np.radians(np.linspace(-180, 180, 121))
    asked = np.concatenate([turn, views.joints[:, joint]])
    others_still = np.tile(views.joints[0], (len(asked), 1))
    others_still[:, joint] = asked
    law = _joint_laws(replace(views.only([0] * len(asked)), joints=others_still), fitted)[:, joint]
    over_turn, seen = law[: len(turn)], law[len(turn) :]
    alone = np.allclose(seen, _joint_laws(views, fitted)[:, joint], rtol=1e-6, atol=1e-12)
    return (
        np.stack([np.degrees(turn), over_turn])
        if alone and np.ptp(over_turn) > 1e-6 * np.abs(over_turn).max()
        else np.zeros((2, 0))
    )


def _along_motion(
    linear: LinearModel,
    motion: _Motion,
    explained: Array,
    free: int,
    axis: tuple[str, str, Array],
    *,
    from_first: bool = False,
) -> EffectTrend | None:
    """Return every view along its unit motion: the line, and beside it what the model with the effect leaves.

    Args:
        explained: response of the whole model with the effect.
        free: number of fitted parameters of the effect.
        axis: what the effect lives on, its unit, and where the views stand along it (V,).
        from_first: count from where the first view is.
    """
    square = np.sum(motion.columns**2, axis=1)
    if not (square > 0).any():
        return None
    # Where a unit moves a view by next to nothing, the view says nothing of it.
    square = np.maximum(square, 1e-2 * np.median(square))
    left = linear.mixed.z.ravel() - linear.reduce(explained[:, None])[:, 0]
    line = np.sum(motion.columns * motion.response, axis=1) / square
    off = np.sum(motion.columns * _displacements(linear, linear.observation.expand(left[:, None]))[..., 0], axis=1)
    scatter = float(np.sqrt(np.mean(off**2 / square) * len(line) / max(len(line) - free, 1)))
    follows, unit, at = axis
    if from_first:
        line = line - line[np.argmin(at)]
    sign = 1.0 if motion.joint is not None or line[np.argmax(np.abs(line))] >= 0 else -1.0
    shown = _some(len(line))
    values_of = {"measured": sign * (line + off / square), "sigma": scatter / np.sqrt(square), "predicted": sign * line}
    return EffectTrend(
        follows, unit, motion.of, motion.unit, at[shown], shown, **{name: x[shown] for name, x in values_of.items()}
    )


def _motion(linear: LinearModel, term: Term, form: Form, values: Array) -> _Motion:
    """What an effect moves, by its place in the chain of frames."""
    response = _displacements(linear, form.response @ values[:, None])[..., 0]
    unit, fitted = linear.measurement.length_unit, form.at(values)
    if term.effect.place == "robot":
        turned = _joint_columns(linear)
        law = _joint_laws(linear.measurement.views, fitted)
        seen = linear.reduce(turned * _of_rows(linear, law, len(turned)))
        joint = int(np.argmax(np.sum(seen**2, axis=0)))
        columns = _displacements(linear, turned[:, joint : joint + 1])[..., 0]
        return _Motion(f"joint {joint + 1}", "rad", columns, law[:, joint : joint + 1] * columns, joint)
    if term.effect.place == "mount":
        constant = Effect("constant", "mount", {"xi": twist("", 1e-3, 1.0)}, _constant, (), (), "empirical")
        own = Term(constant, parameters_in(linear.measurement, constant))
        twists = fitted.effect.function(linear.measurement.views, **fitted.arguments)
        along = (twists - twists.mean(axis=0))[np.argmax(np.sum(response**2, axis=1))]
        columns = _displacements(linear, linear.responses([own])[0].columns @ along[:, None])[..., 0]
        return _Motion("the scanner's mount", unit, _unit_rows(columns), response)
    direction = np.linalg.svd(response - response.mean(axis=0), full_matrices=False)[2][0]
    of = "the part" if term.effect.place == "part" else "the arm"
    return _Motion(of, unit, np.tile(direction, (len(response), 1)), response)


def _joint_columns(linear: LinearModel) -> Array:
    """(·, n) response to a turn of each joint."""
    of_joints = Term(EFFECTS["joint_offset"], parameters_in(linear.measurement, EFFECTS["joint_offset"]))
    return linear.responses([of_joints])[0].columns


def _of_rows(linear: LinearModel, values: Array, count: int) -> Array:
    """(count, P) values of the views (V, P) for every row of a response; zero for rows of no view."""
    each = len(linear.mixed.z[0]) if surfaces_of(linear) is None else 6
    own = np.repeat(values, each, axis=0)
    return np.vstack([own, np.zeros((count - len(own), values.shape[1]))])


def _constant(views: Views, xi: Array) -> Array:
    """M·exp(ξ)"""
    return np.tile(xi, (views.count, 1))


def _joint_laws(views: Views, fitted: Term) -> Array:
    """(V, n) rad by which an effect turns the joints."""
    return np.asarray(fitted.effect.function(views.joints, views, **fitted.arguments)) - views.joints


def _unit_rows(columns: Array) -> Array:
    """Rows of a mean length of one."""
    return columns / max(float(np.mean(np.linalg.norm(columns, axis=1))), 1e-300)


def _displacements(linear: LinearModel, response: Array) -> Array:
    """(V, k, P) displacements at the part of responses (·, P); of surfaces a turn counts by what it does at the rim."""
    observation, surfaces = linear.observation, surfaces_of(linear)
    if surfaces is None:
        return np.stack([observation.part_displacements(own) for own in observation.reduce(response).T], axis=2)
    out = response.reshape(linear.measurement.views.count, 6, -1).copy()
    out[:, :3] *= surfaces.reach
    return np.asarray(out)


def _lives_on(views: Views, term: Term, motion: _Motion) -> tuple[str, str, Array]:
    """What an effect lives on, its unit, and where the views stand along it."""
    name, joint = term.name, motion.joint
    covariate = next((n for n in (*term.effect.prefers, *term.effect.needs) if n in views.covariates), None)
    if joint is not None:
        number = joint + 1
        if "torque" in term.effect.needs:
            own = [k for k, bent in enumerate(views.torques.joint) if bent == joint]
            if own:
                size = max(own, key=lambda k: abs(term.values[k]) * float(np.ptp(views.torques.values[:, k])))
                return f"torque on joint {number}", "N m", views.torques.values[:, size]
        if name == "backlash":
            return f"last move of joint {number}: −1 down, +1 up", "", views.approach[:, joint]
        if name == "settling":
            moved = np.degrees(views.joints - views.previous)
            return f"last move of joint {number}", "°", moved[:, joint]
        if "velocity" in term.effect.needs and views.velocity is not None:
            return f"speed of joint {number}", "°/s", np.degrees(views.velocity[:, joint])
        return f"angle of joint {number}", "°", np.degrees(views.joints[:, joint])
    for weight in ("gravity_at_mount", "gravity_at_part"):
        if weight in term.effect.needs:
            return _along_gravity(getattr(views, weight), motion)
    if covariate is not None:
        return covariate, "", views.covariates[covariate]
    if any(p.discrete for p in term.parameters) or not views.has("time"):
        return "view order", "", np.arange(views.count, dtype=float)
    if "time" in (*term.effect.needs, *term.effect.prefers) or term.effect.prefers:
        return "time", "s", views.time
    return "view order", "", np.arange(views.count, dtype=float)


def _along_gravity(gravity: Array, motion: _Motion) -> tuple[str, str, Array]:
    """What gives way under its weight lives on the pull of gravity (V, 3) along the direction that moves it most."""
    line = np.sum(motion.columns * motion.response, axis=1) / np.maximum(np.sum(motion.columns**2, axis=1), 1e-300)
    slope = np.linalg.lstsq(np.column_stack([gravity, np.ones(len(line))]), line, rcond=1e-6)[0][:3]
    return "pull of gravity where it gives way most", "g", gravity @ slope / max(float(np.linalg.norm(slope)), 1e-300)


# Effects that change points: along the rays of the scanner, or as the part's shape moves.


def _course_of_points(linear: LinearModel, scored: Score, term: Term) -> EffectTrend | None:
    """Means over bins of points, each the effect and what the model with it leaves along its motion."""
    observation, left = surfaces_of(linear), predicted_distances(linear, scored)
    if left is None or observation is None:
        return None
    poses = observation.capture.poses(linear.model.T_mount)
    matches, rows = observation.unconstrained.overlaps.matches, list[tuple[Array, Array, Array, Array, Array]]()
    total = sum(len(m.residual) for m in matches)
    start = 0
    for m in matches:
        some = np.arange(0, len(m.residual), max(total // _ASKED, 1))
        own, start = left[start + some], start + len(m.residual)
        for v, index, sign in ((m.v, m.index_v[some], 1.0), (m.w, m.index_w[some], -1.0)):
            points, view = scan_points(linear.measurement, v, index)
            size, direction = _sizes(term, points, view, poses[v])
            facing = np.einsum("ni,ni->n", frames.rotate(poses[v], direction), m.normal[some])
            at = _place_of(term.name, points, view, poses[v])
            rows.append((at, size, sign * facing, own, np.full(len(some), v)))
    at, size, cosine, rest, view_of = (np.concatenate(x) for x in zip(*rows, strict=True))
    return _binned(linear, term, at, size, cosine, rest, view_of)


def _sizes(term: Term, points: Array, view: ScanView, pose: Array) -> tuple[Array, Array]:
    """(N,) how far an effect moves points, and (N, 3) where to, scanner frame: along the rays where it does so."""
    moved = -point_correction([term], points, view, pose)
    rays = view.along(points)
    along = np.einsum("ni,ni->n", moved, rays)
    length = np.linalg.norm(moved, axis=1)
    if np.sum(along**2) > 0.9 * np.sum(length**2):
        return along, rays
    return length, moved / np.maximum(length, 1e-300)[:, None]


def _place_of(name: str, points: Array, view: ScanView, pose: Array) -> Array:
    """(N,) where points stand along what an effect of points lives on."""
    match name:
        case "range_scale" | "range_nonlinearity":
            return np.asarray(np.linalg.norm(view.away(points), axis=1))
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


_TEMPERATURES = {"part_growth": "part_temperature_c", "scanner_thermal_scale": "scanner_temperature_c"}
# What effects of points live on, with its unit, None for the session's; all others the angle in the field.
_POINT_AXES = {
    "range_scale": ("distance from the scanner", None),
    "range_nonlinearity": ("distance from the scanner", None),
    "incidence_bias": ("angle of incidence", "°"),
    "intensity_bias": ("intensity, in standard deviations", ""),
    "part_sag": ("height above the clamp", None),
}


def _point_axis(name: str, views: Views) -> tuple[str, str | None]:
    """What an effect of points lives on, and its unit."""
    temperature = _TEMPERATURES.get(name)
    if temperature is not None:
        return (temperature, "°C") if temperature in views.covariates else ("time", "s")
    return _POINT_AXES.get(name, ("angle from the middle of the field", "°"))


def _binned(
    linear: LinearModel, term: Term, at: Array, size: Array, cosine: Array, rest: Array, view_of: Indices
) -> EffectTrend | None:
    """A dot for each of equal counts of points; its sigma is the scatter of the views' own means about it."""
    edges = np.unique(np.quantile(at, np.linspace(0, 1, _BINS + 1)))
    if len(edges) < 3:
        return None
    dots = []
    for low, high in pairwise(edges):
        here = (at >= low) & (at <= high)
        weight = np.sum(cosine[here] ** 2)
        if weight <= 0:
            continue
        off = float(np.sum(cosine[here] * rest[here]) / weight)
        views = view_of[here]
        top, below = (np.bincount(views, x[here]) for x in (cosine * rest, cosine**2))
        known = below > 0
        spread = np.sqrt(np.sum((top[known] - off * below[known]) ** 2)) / weight
        law = float(size[here].mean())
        dots.append((float(at[here].mean()), law + off, float(spread), law))
    place, measured, sigma, predicted = np.array(dots).T
    length = linear.measurement.length_unit
    follows, unit = _point_axis(term.name, linear.measurement.views)
    of = "the part" if term.effect.place == "shape" else "the scanner"
    return EffectTrend(
        follows=follows,
        unit=length if unit is None else unit,
        of=of,
        value_unit=length,
        at=place,
        views=np.zeros(0, np.int64),
        measured=measured,
        sigma=sigma,
        predicted=predicted,
    )
