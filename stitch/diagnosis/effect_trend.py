"""How far every view lies off along what an effect does, over what the effect lives on: the effect, to the eye.

The dots are measurements: the displacement of each view from where the model without any candidate puts it, along
one direction, with the standard deviation of what is independent between views. They are the same whatever candidate
is drawn. The direction and the axis are those of the candidate that is named first: the turn of one joint where the
effect is in a joint, the fitted twist of the mount, else the direction in which the effect displaces the views most.
A candidate's line is by how much it moves what the model predicts for these views, hand-eye and effects in use fitted
anew beside it, with its standard deviation. Effects of points have bins of points in place of views (`point_trend`).
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from stitch.diagnosis.candidate_views import candidate_measurement
from stitch.diagnosis.candidates import Form, candidate_as_fitted
from stitch.diagnosis.deciding_view import model_beside, predict_views
from stitch.diagnosis.dependence import Dependence
from stitch.diagnosis.fitted_effect import Change, EffectTrend, FittedEffect, fit_change, fit_effect
from stitch.diagnosis.point_trend import trends_of_points
from stitch.diagnosis.ranking import Ranked, conditioned_on_effects
from stitch.diagnosis.score import Score, score
from stitch.diagnosis.systematic_laws import law_of
from stitch.diagnosis.unmodelled_joint_effects import JointCurve
from stitch.effects.contract import EFFECTS, Effect, by_joint, twist
from stitch.model.forward import moves_points, pose_derivatives
from stitch.model.model import Model, Term, term_of
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.reml import NOISE
from stitch.numerics.units import covariate_text
from stitch.observations.linear_model import LinearModel
from stitch.observations.pose_errors import JOINT_SCATTER
from stitch.observations.surfaces.surface_model import surfaces_of
from stitch.session.capture import build_capture
from stitch.session.measurement import Measurement, Views
from stitch.session.scan import even_indices

# Dots along one trend: more cannot be told apart.
_MOST_DOTS = 300
# What else moves as a whole, by the place of its effects.
_BODIES = {"part": "the part", "base": "the robot's base", "axis": "the external axis"}
_CONSTANT = Effect(
    "constant",
    "mount",
    {"xi": twist("", 1e-3, 1.0)},
    lambda views, xi: np.tile(xi, (views.count, 1)),
    (),
    (),
    "empirical",
)

# The horizontal axis of a trend: what it shows in words, its unit, and the views' values (V,) along it.
_Axis = tuple[str, str, Array]


def trends_of_candidates(linear: LinearModel, scores: Sequence[Score]) -> dict[str, EffectTrend]:
    """Return the trends of candidates, by name: one set of dots, whose axes the first candidate chooses, a line each.

    Candidates that cannot be fitted are left out. Empty where nothing can be fitted or drawn.
    """
    # Poses scatter independently here, as for the field of the part, so that both pictures predict the same.
    fitted = linear.restricted(())
    given = [scored for scored in scores if scored.fitted]
    refitted = [scored if fitted is linear else score(fitted, scored.candidate) for scored in given]
    pairs = [(scored, again) for scored, again in zip(given, refitted, strict=True) if again.fitted]
    if not pairs:
        return {}
    effects = [fit_effect(fitted, scored, again) for scored, again in pairs]
    if moves_points([effects[0].term]):
        return trends_of_points(fitted, effects, [again for _, again in pairs])
    axes = _axes(fitted, effects[0])
    plot = _Plot(fitted, model_beside(linear, pairs[0][0]), *axes)
    return {effect.term.name: _trend_in_plot(plot, effect) for effect in effects} if plot.moves_views else {}


def expected_in_view(
    linear: LinearModel, rivals: Sequence[Score], joints: Array, wait: float = 0.0
) -> tuple[float, float, dict[str, tuple[float, float]]] | None:
    """Return where each of several rival effects expects the dot of one further view, in their common plot.

    None where that cannot be computed: for labelled points, effects that change points, and dots drawn along gravity.

    Args:
        rivals: scores of the effects; the first chooses direction and axis, as in the plot.
        joints: (n,) joint angles of the view, rad.
        wait: s, beside the usual pause before the view.

    Returns:
        The dot's place along the horizontal axis; the standard deviation of a dot by scatter of the flange; and by
        effect, the height that it expects, with the standard deviation of what would be seen. Units as in the trends.
    """
    fitted = linear.restricted(())
    surfaces = surfaces_of(fitted)
    anew = score(fitted, rivals[0].candidate)
    if surfaces is None or not anew.fitted or moves_points([scored.form.term for scored in rivals]):
        return None
    effect = fit_effect(fitted, rivals[0], anew)
    motion, (follows, _, _) = _axes(fitted, effect)
    if "gravity" in follows:
        return None
    further = candidate_measurement(linear.measurement, joints[None], wait)
    match follows:
        case "time":
            at = further.views.time[0]
        case "view order":
            at = linear.measurement.views.count
        case _:
            at = _axis(further.views, effect.term, motion)[2][0]
    # Twists count as displacements: rotations (rad) times the part's reach. The height of a twist is its product with
    # the unit motion, over that motion's square, so that the unit motion itself has the height 1.
    to_displacement = np.repeat([surfaces.reach, 1.0], 3)
    unit = _unit_twist(fitted, motion, further, surfaces.centre) * to_displacement
    to_height = unit * to_displacement / max(float(unit @ unit), 1e-300)
    # A dot is what the model without any candidate leaves: its prediction is subtracted from the rivals'.
    without = fitted.baseline_trial.solve()
    expected = {}
    for scored, prediction in zip(rivals, predict_views(linear, rivals, joints[None], np.array([wait])), strict=True):
        mean, covariance = prediction.of_sets([], np.zeros(1, np.int64))
        height = to_height @ (mean[0] - prediction.design[0] @ without)
        expected[scored.name] = (float(height), float(np.sqrt(to_height @ covariance[0] @ to_height)))
    # Scatter moves a view by a twist of the flange, carried to the surface's centre.
    base = model_beside(linear, rivals[0])
    flange = build_capture("candidate", (), further.T_base_flange, further.mount).T_reference_flange
    by_flange = to_height @ frames.adjoint_about(base.observation.centre, flange)[0]
    variances = np.repeat(np.maximum(base.flange_scatter(base.null), 1e-300), 3)
    return float(at), float(np.sqrt(by_flange**2 @ variances)), expected


def _unit_twist(linear: LinearModel, motion: "_Motion", measurement: Measurement, centre: Array) -> Array:
    """Return the twist (6,) of a further view per unit of the motion that is drawn, about `centre`, reference frame.

    A joint turns by 1 rad, the mount by its unit twist; any other body moves along the direction, alike in all views.
    """
    bare = Model(linear.model.T_mount)
    if motion.joint is not None:
        offset = term_of(linear.measurement, EFFECTS["joint_offset"])
        return next(pose_derivatives(measurement, bare, [offset], centre))[motion.joint, 0]
    if motion.twist is not None:
        constant = term_of(linear.measurement, _CONSTANT)
        return motion.twist @ next(pose_derivatives(measurement, bare, [constant], centre))[:, 0]
    return np.append(np.zeros(3), motion.per_unit[0, -3:])


def trend_in_model(linear: LinearModel, term: Term) -> EffectTrend | None:
    """Return the trend of an effect that is in the model: dots as if it were not, its line, and the dots with it.

    None for an effect that changes points, of which nothing was fitted, or whose motion moves no view.
    """
    is_fitted = ~term.gridded & (term.values != 0)  # gridded ones, as the time of an event, are held
    if moves_points([term]) or not is_fitted.any():
        return None
    # Poses scatter independently here, as in the trends of candidates.
    fitted = linear.restricted(())
    form = candidate_as_fitted(fitted, term).forms[0]
    without = _without_effect(fitted, term, form)
    effect = FittedEffect(term, form, fit_change(without, form.columns, beside=without))
    axes = _axes(without, _clearest_joint(effect))
    # The dots with the effect are what is left of observations without its share, beside its free columns.
    with_effect = _Plot(replace(fitted, design=np.hstack([without.design, form.response])), linear, *axes)
    if not with_effect.moves_views:
        return None
    return _trend_in_plot(_Plot(without, linear, *axes, after=with_effect.measured), effect)


def _without_effect(fitted: LinearModel, term: Term, form: Form) -> LinearModel:
    """Return a linear model from which an effect in it is taken out, at the variances that were fitted with it.

    Its share is added to the reduced observations, which are residuals from a model with it, and its columns leave the
    design.

    Args:
        form: of the effect as it was fitted.
    """
    # Of all its parameters, also of those that the fit holds at zero. The design does not say whose a column is: those
    # of the effect are equal to these, but for rounding.
    of_effect = fitted.responses([term])[0].columns
    off = np.linalg.norm(fitted.design[:, :, None] - of_effect[:, None], axis=0).min(axis=1)
    others = off > 1e-6 * np.linalg.norm(fitted.design, axis=0)
    share = (form.columns @ term.values[form.keep]).reshape(fitted.mixed.z.shape)
    mixed = replace(fitted.mixed, z=fitted.mixed.z + share)
    return replace(fitted, design=fitted.design[:, others], mixed=mixed)


def _clearest_joint(effect: FittedEffect) -> FittedEffect:
    """Return an effect of several joints reduced to the joint that differs most from zero; any other as it is.

    The measure is vᵀ C⁻¹ v, with values v of that joint's free parameters and their covariance C.
    """
    term, change = effect.term, effect.change
    free = np.flatnonzero(effect.form.keep)
    # Masks over the free parameters, one for each joint that has any.
    joints = [np.isin(free, joint) for joint in by_joint(term.effect, term.parameters)]
    joints = [joint for joint in joints if joint.any()]
    if not joints:
        return effect
    squares = [
        change.values[joint] @ np.linalg.pinv(change.covariance[np.ix_(joint, joint)]) @ change.values[joint]
        for joint in joints
    ]
    clearest = joints[int(np.argmax(squares))]
    of_joint = np.isin(np.arange(len(term.values)), free[clearest])
    alone = np.where(of_joint | term.gridded, term.values, 0.0)
    values = np.where(clearest, change.values, 0.0)
    return replace(effect, term=term.at(alone), change=replace(change, values=values))


def trend_of_curve(linear: LinearModel, curve: JointCurve) -> EffectTrend | None:
    """Return the trend of a joint whose error follows one covariate by no known law; None if it moves no view."""
    error = np.interp(curve.view_values, curve.at, curve.error)
    return _trend_of_joint(linear, linear, curve.joint, error, (*_axis_words(curve.covariate), curve.view_values))


def trend_of_law(linear: LinearModel, ranked: Ranked) -> EffectTrend | None:
    """Return the trend of a joint that errs by a law of the dictionary; None for a law of something else."""
    law, scored = law_of(ranked), ranked.score
    if law.place.joint is None:
        return None
    scattering = linear.restricted({JOINT_SCATTER})
    beside = conditioned_on_effects(scattering, [ranked], scattering.null.variances)
    axis = (*_axis_words(law.driver.covariate), law.driver.values)
    return _trend_of_joint(linear, beside, law.place.joint, law.shapes @ scored.values, axis)


def _axis_words(covariate: str) -> tuple[str, str]:
    """Return the title of a covariate's axis and its unit; "" where the title contains it or there is none."""
    if covariate == "time_s":
        return "time", "s"
    angle = re.fullmatch(r"j(\d+)_deg", covariate)
    return (f"angle of joint {angle[1]}", "°") if angle else (covariate_text(covariate), "")


def _trend_of_joint(
    linear: LinearModel, scatter: LinearModel, number: int, error: Array, axis: _Axis
) -> EffectTrend | None:
    """Return the trend of an error of one joint that no effect of the library makes; None if it moves no view.

    Args:
        scatter: the model with the variances of what is independent between views.
        number: of the joint, counted from 1.
        error: (V,) rad, the shape of the error; its size and a constant are fitted.
        axis: horizontal axis of the trend.
    """
    fitted = linear.restricted(())
    turned = _joint_columns(fitted)[:, number - 1 : number]
    # With a constant, since the zero of the joint is not known either.
    shapes = np.column_stack([error, np.ones_like(error)])
    response = turned * _repeat_for_rows(fitted, shapes, len(turned))
    per_unit = _displacements(fitted, turned)[..., 0]
    motion = _Motion(f"joint {number}", "rad", per_unit, error[:, None] * per_unit, number - 1)
    plot = _Plot(fitted, scatter, motion, axis)
    change = fit_change(fitted, fitted.reduce(response), beside=fitted)
    return plot.trend(change, motion.of, shapes @ change.values) if plot.moves_views else None


def trend_of_dependence(linear: LinearModel, dependence: Dependence) -> EffectTrend:
    """Return the views' displacements over the covariate that they depend on, with a line through the means of bins.

    The standard deviation of a dot is that of all dots about the line.
    """
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
        predicted_sigma=np.interp(dependence.at, dependence.bins, dependence.sigma),
        moves="the views",
        effect=predicted,
    )
    return trend.with_dots(even_indices(len(predicted), _MOST_DOTS))


@dataclass(frozen=True)
class _Motion:
    """The vertical axis of a plot: what is off, and how one unit of that displaces each view (`_displacements`)."""

    of: str  # the part, joint 2, …
    unit: str
    per_unit: Array  # (V, k) displacements by a unit of the motion
    by_effect: Array  # (V, k) displacements by the effect that chose the motion
    joint: int | None = None  # that turns, counted from 0
    twist: Array | None = None  # (6,) of the mount, a unit

    @property
    def products(self) -> Array:
        """(V,) inner products of the effect's displacement with that of a unit."""
        return np.sum(self.per_unit * self.by_effect, axis=1)

    @cached_property
    def unit_square(self) -> Array:
        """(V,) squared displacement by a unit of the motion; not less than 1 % of the median over the views.

        A view that a unit hardly moves would get a dot of noise.
        """
        square = np.sum(self.per_unit**2, axis=1)
        return np.maximum(square, 1e-2 * np.median(square))


def _axes(linear: LinearModel, effect: FittedEffect) -> tuple[_Motion, _Axis]:
    """Return the vertical axis of an effect's plot, a motion, and the horizontal one.

    The sign is chosen so that the largest displacement is positive; the turn of a joint keeps its own sign.
    """
    motion = _motion(linear, effect)
    products = motion.products
    if motion.joint is None and products[np.argmax(np.abs(products))] < 0:
        reversed_twist = None if motion.twist is None else -motion.twist
        motion = replace(motion, per_unit=-motion.per_unit, twist=reversed_twist)
    return motion, _axis(linear.measurement.views, effect.term, motion)


def _trend_in_plot(plot: "_Plot", effect: FittedEffect) -> EffectTrend:
    """Return the trend of an effect over the dots of a plot whose axes another effect may have chosen."""
    motion = _motion(plot.linear, effect)
    amount = motion.products / motion.unit_square
    if effect.term.effect.place == "part":
        # Where the part sat at first is nobody's error.
        amount = amount - amount[np.argmin(plot.axis[2])]
    return plot.trend(effect.change, motion.of, amount)


@dataclass(frozen=True)
class _Plot:
    """The dots of all views, between a horizontal and a vertical axis; lines of candidates are drawn over them."""

    linear: LinearModel  # without any candidate
    scatter: LinearModel  # with the variances of what is independent between views
    motion: _Motion  # vertical axis
    axis: _Axis  # horizontal axis
    after: Array | None = None  # (V,) dots with an effect in the model that `measured` is without

    @property
    def moves_views(self) -> bool:
        """False where the motion moves no view: then nothing can be drawn."""
        return bool(self.motion.per_unit.any())

    @cached_property
    def measured(self) -> Array:
        """(V,) what the model leaves of each view along the motion, in units of it."""
        linear = self.linear
        explained = linear.design @ linear.baseline_trial.solve()[-linear.design.shape[1] :]
        residual = linear.mixed.z.ravel() - linear.reduce(explained[:, None])[:, 0]
        return self.amounts(residual[:, None])[:, 0]

    @cached_property
    def sigma(self) -> Array:
        """(V,) standard deviation of the dots, by what is independent between views."""
        root = np.linalg.cholesky(_independent_covariance(self.scatter)).astype(float)
        # With cov = root rootᵀ, sigma² is the sum over columns of `root`. Columns are those of all blocks side by side:
        # an observation moves views of its own block alone, but for the mean of all.
        amounts = self.amounts(root.reshape(-1, root.shape[2]))
        return np.asarray(np.sqrt(np.sum(amounts**2, axis=1)))

    def amounts(self, reduced: Array) -> Array:
        """Return by how many units of the motion (V, P) reduced observations (n, P) displace the views, per column."""
        moved = _displacements(self.linear, self.linear.observation.expand(reduced))
        return np.einsum("vk,vkp->vp", self.motion.per_unit, moved) / self.motion.unit_square[:, None]

    def trend(self, change: Change, moves: str, effect: Array) -> EffectTrend:
        """Return the trend of an effect: the dots, with the line that the model would predict with it, and its sigma.

        Args:
            change: of the model's prediction by the effect, per unit of each parameter.
            moves: what the effect itself moves: the part, joint 2, …
            effect: (V,) what it does itself in units of the motion, before hand-eye and effects in use adapt to it.
        """
        per_unit = self.amounts(change.per_unit)
        follows, unit, at = self.axis
        trend = EffectTrend(
            follows,
            unit,
            self.motion.of,
            self.motion.unit,
            at,
            np.arange(len(at)),
            self.measured,
            self.sigma,
            predicted=per_unit @ change.values,
            predicted_sigma=np.sqrt(np.einsum("vp,pq,vq->v", per_unit, change.covariance, per_unit).clip(0)),
            moves=moves,
            effect=effect,
            after=self.after,
        )
        return trend.with_dots(even_indices(len(at), _MOST_DOTS))


def _independent_covariance(linear: LinearModel) -> Array:
    """Return the covariance (B, m, m) of what is independent between views: scatter of flange and joints, and noise.

    There are B blocks of m reduced observations. A small multiple of the identity keeps it positive definite.
    """
    names = linear.component_names
    independent = [*range(NOISE + 1), *(NOISE + 1 + k for k, name in enumerate(names) if name == JOINT_SCATTER)]
    covariance = np.einsum("c,cbij->bij", linear.null.variances[independent], linear.mixed.components[independent])
    size = np.einsum("bii->b", covariance) / covariance.shape[1]
    return covariance + 1e-12 * size[:, None, None] * np.eye(covariance.shape[1])


def _motion(linear: LinearModel, effect: FittedEffect) -> _Motion:
    """Return the motion that is the vertical axis of an effect's plot, by the place where the effect acts.

    Effects of joints: the turn of the joint that moves the views most, rad. Effects of the mount: its twist in the view
    that moves most, less the mean, of such a size that it displaces the views by one length_unit on average. All
    others: a shift along the first principal direction of the views' displacements, length_unit.
    """
    term, views = effect.term, linear.measurement.views
    by_effect = _displacements(linear, effect.form.response @ effect.change.values[:, None])[..., 0]
    unit = linear.measurement.length_unit
    if term.effect.place == "robot":
        per_rad = _joint_columns(linear)
        joint_errors = term.effect.function(views.joints, views, **term.arguments) - views.joints
        # Square sums of the reduced observations tell how much each joint is seen to move.
        reduced = linear.reduce(per_rad * _repeat_for_rows(linear, joint_errors, len(per_rad)))
        joint = int(np.argmax(np.sum(reduced**2, axis=0)))
        per_unit = _displacements(linear, per_rad[:, joint : joint + 1])[..., 0]
        return _Motion(f"joint {joint + 1}", "rad", per_unit, joint_errors[:, joint : joint + 1] * per_unit, joint)
    if term.effect.place == "mount":
        twists = term.effect.function(views, **term.arguments)
        twist = (twists - twists.mean(axis=0))[np.argmax(np.sum(by_effect**2, axis=1))]
        # As if the mount were displaced by this twist in all views alike.
        per_constant_twist = linear.responses([term_of(linear.measurement, _CONSTANT)])[0].columns
        by_twist = _displacements(linear, per_constant_twist @ twist[:, None])[..., 0]
        size = max(float(np.mean(np.linalg.norm(by_twist, axis=1))), 1e-300)
        return _Motion("the scanner's mount", unit, by_twist / size, by_effect, twist=twist / size)
    direction = np.linalg.svd(by_effect - by_effect.mean(axis=0), full_matrices=False)[2][0]
    of = _BODIES.get(term.effect.place, "the arm")
    return _Motion(of, unit, np.tile(direction, (len(by_effect), 1)), by_effect)


def _joint_columns(linear: LinearModel) -> Array:
    """Return the response (·, n) of the observation to a turn of each joint, per rad."""
    return linear.responses([term_of(linear.measurement, EFFECTS["joint_offset"])])[0].columns


def _repeat_for_rows(linear: LinearModel, values: Array, count: int) -> Array:
    """Return values (V, P) of the views repeated for the `count` rows of a response; zero for rows of no view."""
    rows = np.repeat(values, len(linear.mixed.z[0]) if surfaces_of(linear) is None else 6, axis=0)
    return np.vstack([rows, np.zeros((count - len(rows), values.shape[1]))])


def _displacements(linear: LinearModel, response: Array) -> Array:
    """Return displacements (V, k, P) of the views at the part, length_unit, from responses (·, P) of the observation.

    Of surfaces they are twists (k = 6) with rotations times the part's reach; of labelled points, k = 3 translations.
    """
    observation = linear.observation
    surfaces = surfaces_of(linear)
    if surfaces is None:
        columns = observation.reduce(response).T
        return np.stack([observation.part_displacements(column) for column in columns], axis=2)
    twists = response.reshape(linear.measurement.views.count, 6, -1).copy()
    twists[:, :3] *= surfaces.reach
    return twists


def _axis(views: Views, term: Term, motion: _Motion) -> _Axis:
    """Return the horizontal axis of an effect's plot: what it shows, in words, its unit, and its value (V,) per view.

    That is what the effect depends on: a joint's quantity, gravity, a covariate or time; else the order of the views.
    """
    effect = term.effect
    if motion.joint is not None:
        return _joint_axis(views, term, motion.joint)
    for weight in ("gravity_at_mount", "gravity_at_part"):
        if weight in effect.needs:
            # What gives way under its weight follows the pull of gravity along the direction that moves it most.
            gravity = getattr(views, weight)
            amount = motion.products / np.maximum(np.sum(motion.per_unit**2, axis=1), 1e-300)
            slope = np.linalg.lstsq(np.column_stack([gravity, np.ones(len(amount))]), amount, rcond=1e-6)[0][:3]
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
    """Return the horizontal axis of an effect of one joint: its torque, last move, speed or angle, by the effect.

    Args:
        joint: counted from 0.
    """
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
