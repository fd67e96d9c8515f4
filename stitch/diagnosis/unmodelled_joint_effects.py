"""Unmodelled effects of single joints, as rivals of effects that have a name: what no law of the library describes.

A name is worth no more than what it is compared with. All joints and links following the pose at once (`smooth` in the
prior of pose errors) is a poor rival: it may do so much that it is believed to do little of anything. One joint that is
off by a smooth function of the joint angles is what a coupling, a hose or a gear with play really does, and where it
explains the views about as well as an effect of the library, these views cannot tell which it is. Likewise one joint
that is off by a function of its own angle that changes within a few degrees, as by a worn tooth or a wave of a gear, or
by any function of the way it came, as by friction, which is neither play nor settling; or that changes as time passes,
as where its motor warms, which is no drift of mount or part; or by a function of its load that is not that of a spring.

Three more such functions hold too, but with a number of their own in nearly every view: a joint that follows its own
angle and one other's, as two do that drag each other, one that errs in waves along its angle, as teeth of gears and
belts do, and one that errs in time alone, whatever the pose.

Which joint errs is told beside all else that an arm may do, or in place of it. All joints and links following the pose
at once can do what one joint does, and beside them its effect gains nothing. But where one joint alone explains the
views at least as well as all of them together, the errors live there. Compared are maxima of likelihood and prior: the
sizes of all together are charged some three nats for being there at all. An arm of which every joint and link is off is
hardly ever explained by one of its joints alone.

Of all kinds of effects of all joints one may be there, each as likely before: what counts is their mean Bayes factor,
and of a joint the mean of its kinds.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from operator import attrgetter

import numpy as np
from scipy.special import logsumexp

from stitch.diagnosis import thresholds as limits
from stitch.diagnosis.law_ranking import could_be_base
from stitch.diagnosis.smooth_processes import SmoothProcess, leading_trends, size_process
from stitch.effects.contract import EFFECTS
from stitch.model.model import term_of
from stitch.numerics.frames import Array
from stitch.numerics.kernels import (
    SmoothErrors,
    direction_reach,
    exponential_kernel,
    periodic_kernel,
    rbf_joints,
    short_range_kernel,
)
from stitch.numerics.parameter_selection import ANY_SIZE, log_mean_exp
from stitch.numerics.reml import VarianceFit, at_variances, fit_variances
from stitch.observations.linear_model import LinearModel, with_pose_errors
from stitch.observations.pose_errors import (
    ALL_ANGLES,
    DRIFT_MEMORY,
    JOINT_LOAD,
    NOT_OF_ARM,
    OWN_ANGLE,
    SMOOTH_SCALE,
    TIME_ONLY,
    TRAVEL,
    TWO_ANGLES,
    WAVES,
    WITH_TIME,
    time_in_steps,
    usual_time_step,
)
from stitch.session.torques import STILL

# What a fitted size costs an unmodelled effect, nats. The prior of a named effect spreads over several sizes
# (`try_form`), of which the plausible one has this share: an unmodelled effect pays as much, so that neither has an
# advantage.
SIZE_PENALTY = -float(np.log(ANY_SIZE[1.0]))
JOINT_ANGLES = "the joint angles"
# By kind of effect what it follows, in words.
_FOLLOWED = {
    ALL_ANGLES: JOINT_ANGLES,
    TWO_ANGLES: JOINT_ANGLES,
    OWN_ANGLE: JOINT_ANGLES,
    WAVES: JOINT_ANGLES,
    TRAVEL: "the way it came",
    WITH_TIME: "time",
    TIME_ONLY: "time",
    JOINT_LOAD: "its load",
}
_DEGREES = float(np.degrees(1.0))
_EVIDENCE = attrgetter("log_bayes_factor")
_CURVE_POINTS = 25  # over the range of the covariate
# Covariances below this are none: such a factor of a product cannot be divided out of it.
_NO_COVARIANCE = 1e-290

# One number that an effect follows: its name, its values (V,) in the views, the unit in which it is reported per unit
# of these, and the factor of the effect's covariance by it: function from values (S,) and (O,) to (S, O).
_Covariate = tuple[str, Array, float, Callable[[Array, Array], Array]]


@dataclass(frozen=True)
class JointEffect:
    """One joint that errs by an unmodelled effect."""

    joint: int  # counted from 1
    follows: str  # what its function depends on: ALL_ANGLES, TWO_ANGLES, OWN_ANGLE, WAVES, …
    process: int  # index of its random function in `errors`
    log_bayes_factor: float  # over the model `base`, at the fitted size
    base: LinearModel  # without the effect, with all other pose errors
    fit: VarianceFit | None = None  # of the views with it; None where it was only sized at the null's variances
    may_follow: tuple[str, ...] = ()  # in words, the likeliest first: what 20 to 1 does not tell apart

    @property
    def errors(self) -> SmoothErrors:
        """The random functions of this kind, of all joints."""
        return _joint_processes(self.base)[self.follows]

    @property
    def typical_size(self) -> float:
        """The joint's error, rad, for which `errors` hold the twists of the views."""
        return float(term_of(self.base.measurement, EFFECTS["joint_offset"]).typical[self.joint - 1])

    @cached_property
    def place(self) -> str:
        """Where the effect acts, in words: "joint 2", with the base where that would explain the views as well."""
        joint = f"joint {self.joint}"
        if self.follows not in (WITH_TIME, TIME_ONLY):
            # The base has no joint angle that it could follow.
            return joint
        # At the views themselves, so that both of its covariances are those between views.
        kernel = self.errors.kernel_of(self.process)
        error, _ = _posterior_error(self, with_views=kernel, prior=kernel)
        # (V, 1) in typical sizes of the joint's error: the columns are twists of the views per such a size.
        sizes = error[:, None] / self.typical_size
        twists = self.errors.columns[:, self.process].reshape(-1, 6) * sizes
        effect = self.model.reduce(twists.reshape(-1, 1))[:, 0]
        or_base = could_be_base(self.model, effect, shapes=sizes)
        return f"{joint}, or the base about the same axis (these views cannot tell)" if or_base else joint

    @cached_property
    def model(self) -> LinearModel:
        """The model `base` with the effect as the last component of its pose errors, all variances fitted.

        With C the covariance (6V, 6V) of the views' twists by an effect of unit size, and R the reduction to n
        numbers, the component is R C Rᵀ (n, n).
        """
        base = self.base
        assert base.pose_errors is not None
        component = base.reduce(base.reduce(self.errors.twist_covariance(self.process)).T)
        errors = base.pose_errors.with_component(f"joint {self.joint} by no known law", component, SMOOTH_SCALE)
        mixed = with_pose_errors(base.mixed, errors)
        null = self.fit
        if null is None:
            # The likelihood has several maxima: the fit begins at the likeliest of several starts, each of the
            # variances of all other errors with each of the effect's.
            of_others = [at.null.variances for at in (base, *base.alternative_starts)]
            of_effect = [times * SMOOTH_SCALE**2 for times in limits.UNMODELLED_VARIANCES]
            starts = [np.append(others, variance) for others in of_others for variance in of_effect]
            null = fit_variances(mixed, start=min(starts, key=lambda start: at_variances(mixed, start).deviance))
        return replace(base, mixed=mixed, pose_errors=errors, null=null, full_model=None)


def joint_effects(base: LinearModel) -> tuple[JointEffect, ...]:
    """Return one unmodelled effect for each joint and each kind, likeliest first.

    An unmodelled effect is a smooth random function of what it follows, such as the joint's angle. Where a joint has
    several functions of a kind, as for each other joint, the likeliest stands for all, with their mean Bayes factor.
    Sizes are fitted, for which `log_posterior_of_any` charges. () without joints, or where pose errors have no prior.
    """
    effects = sorted(_effects_at_null_variances(base), key=_EVIDENCE, reverse=True)
    # All variances are fitted again for the likeliest few. The others keep a lower bound: their gain without that.
    for k, effect in enumerate(effects[: limits.JOINT_EFFECTS_FITTED]):
        null = effect.model.null
        effects[k] = replace(effect, log_bayes_factor=0.5 * (base.null.deviance - null.deviance), fit=null)
    by_kind: dict[tuple[int, str], list[JointEffect]] = {}
    for effect in effects:
        by_kind.setdefault((effect.joint, effect.follows), []).append(effect)
    likeliest = [
        replace(
            max(of_kind, key=_EVIDENCE),
            log_bayes_factor=float(log_mean_exp([effect.log_bayes_factor for effect in of_kind])),
        )
        for of_kind in by_kind.values()
    ]
    return tuple(sorted(likeliest, key=_EVIDENCE, reverse=True))


def _effects_at_null_variances(base: LinearModel) -> Iterator[JointEffect]:
    """Yield all unmodelled effects of single joints, with the log Bayes factors of their likeliest sizes.

    The variances of all other errors stay those of the null fit.
    """
    for follows, errors in _joint_processes(base).items():
        for process, joint in enumerate(errors.joints):
            kernel = errors.kernel_of(process)
            shapes = kernel @ leading_trends(kernel, len(kernel))
            motions = errors.columns[:, process].reshape(-1, 6, 1)
            _, gain = size_process(base, SmoothProcess(joint + 1, motions, shapes))
            yield JointEffect(joint + 1, follows, process, gain, base)


def log_posterior_of_any(log_bayes_factors: Array) -> Array:
    """Return (…) the log posterior, not yet normalised, that one of L unmodelled effects is there.

    It is log(prior × mean Bayes factor) − `SIZE_PENALTY`: the effects share one prior equally, hence the mean over L.

    Args:
        log_bayes_factors: (L, …) of each effect over nothing, at its fitted size.
    """
    return log_mean_exp(log_bayes_factors) + np.log(limits.PRIOR_UNKNOWN) - SIZE_PENALTY


def joint_effect_covariances(base: LinearModel) -> list[list[Array]]:
    """Return for each joint and kind the covariances (n, n) of its unmodelled effects in the reduced observations.

    The effects are of usual size.
    """
    return [
        [SMOOTH_SCALE**2 * base.reduce(base.reduce(smooth.twist_covariance(p)).T) for p in smooth.of_joint(joint)]
        for smooth in _joint_processes(base).values()
        for joint in dict.fromkeys(smooth.joints)
    ]


def significant_joint_effects(linear: LinearModel) -> tuple[JointEffect, ...]:
    """Return the unmodelled effects of single joints of which one is there, likeliest first; () where none is clear.

    Joints are scored beside all other pose errors first. If none is clear there, they are scored again without the
    random errors of all joints and links, which can do what one joint does: then the likeliest joint has to explain at
    least as much as all of those together. Joints that 20 to 1 does not tell from the likeliest are returned with it.
    """
    beside_arm = _likeliest_per_joint(joint_effects(linear))
    if beside_arm or not _joint_processes(linear):
        return beside_arm
    without_arm = linear.restricted(NOT_OF_ARM)
    in_place_of_arm = joint_effects(without_arm)
    gain_of_arm = 0.5 * (without_arm.null.deviance - linear.null.deviance)
    if in_place_of_arm[0].log_bayes_factor < gain_of_arm:
        return ()
    likeliest = _likeliest_per_joint(in_place_of_arm)
    return tuple(replace(effect, log_bayes_factor=effect.log_bayes_factor - gain_of_arm) for effect in likeliest)


def _joint_processes(base: LinearModel) -> dict[str, SmoothErrors]:
    """Return by kind the random functions by which a single joint may err; empty where pose errors have no prior."""
    return {} if base.pose_errors is None else base.pose_errors.joint_processes


def _likeliest_per_joint(effects: Sequence[JointEffect]) -> tuple[JointEffect, ...]:
    """Return the likeliest effect of every joint that is within 20 to 1 of the likeliest joint.

    Its log Bayes factor is that of all kinds of effects of the joint together: each of the L effects has 1/L of the
    prior. `may_follow` lists the kinds within 20 to 1 of it. () where all together are not 20 to 1 over nothing.

    Args:
        effects: L of all kinds and joints, likeliest first.
    """
    if not effects or log_mean_exp([effect.log_bayes_factor for effect in effects]) <= limits.ODDS:
        return ()
    of_joint = {k: [e for e in effects if e.joint == k] for k in dict.fromkeys(effect.joint for effect in effects)}
    of_all_kinds = {
        k: float(logsumexp([effect.log_bayes_factor for effect in of_joint[k]]) - np.log(len(effects)))
        for k in of_joint
    }
    likeliest = list[JointEffect]()
    for k in sorted(of_all_kinds, key=lambda k: -of_all_kinds[k]):
        if of_all_kinds[k] <= max(of_all_kinds.values()) - limits.ODDS:
            continue
        best = of_joint[k][0]
        near = [e for e in of_joint[k] if e.log_bayes_factor > best.log_bayes_factor - limits.ODDS]
        may_follow = tuple(dict.fromkeys(_FOLLOWED[effect.follows] for effect in near))
        likeliest.append(replace(best, log_bayes_factor=of_all_kinds[k], may_follow=may_follow))
    return tuple(likeliest)


@dataclass(frozen=True)
class JointCurve:
    """Error of a joint along one covariate, averaged over all else that it follows, less its mean over the views."""

    joint: int  # that errs, counted from 1
    covariate: str  # j3_deg; j3_move_deg, how far it came; time_s or view; j3_torque_nm, or j3_torque_nm_per_kg
    share: float  # of the effect's variance over the views, 0 … 1
    at: Array  # (G,) of the covariate, in the unit that its name ends with
    error: Array  # (G,) of the joint that errs, rad
    sigma: Array  # (G,) of `error`, rad
    view_values: Array  # (V,) the covariate in the views
    place: str  # the joint in words, and what turns the views as it does
    may_follow: tuple[str, ...] = ()  # what these views do not tell apart, the likeliest first

    @property
    def extremes(self) -> tuple[int, int]:
        """Indices (into `at`) of the smallest and of the largest error."""
        return int(np.argmin(self.error)), int(np.argmax(self.error))


def joint_curves(effects: Sequence[JointEffect]) -> tuple[JointCurve, ...]:
    """Return the curve of each effect along each of its covariates, those with the largest share of its variance first.

    A curve is a partial dependence (Friedman 2001, Ann. Stat. 29:1189): averaged over the other arguments. The effect
    is a random function; its mean and covariance given the observations are those of a Gaussian process (Rasmussen &
    Williams 2006, eq. 2.41), with the hand-eye free. Curves with a small share are left out.
    """
    curves = list[JointCurve]()
    for effect in effects:
        kernel = effect.errors.kernel_of(effect.process)
        error, _ = _posterior_error(effect, with_views=kernel, prior=kernel)
        variance = float(error.var())
        curves += [_curve_along(effect, covariate, variance) for covariate in _covariates(effect)]
    return tuple(sorted((c for c in curves if c.share > limits.CURVE_LEAST_SHARE), key=lambda c: -c.share))


def _covariates(effect: JointEffect) -> list[_Covariate]:
    """Return all numbers that an effect follows; its covariance is the product of a factor for each."""
    k = effect.joint - 1
    views = effect.base.measurement.views
    angles = views.joints.T
    degrees = [(f"j{j + 1}_deg", angle, _DEGREES) for j, angle in enumerate(angles)]
    if effect.follows == ALL_ANGLES:
        return [(*of_joint, _smooth_in_angle) for of_joint in degrees]
    if effect.follows == TWO_ANGLES:
        return [(*degrees[j], _one_of_two_angles) for j in (k, effect.errors.others[effect.process])]
    if effect.follows == OWN_ANGLE:
        return [(*degrees[k], short_range_kernel)]
    if effect.follows == WAVES:
        return [(*degrees[k], partial(periodic_kernel, period=effect.errors.periods[effect.process]))]
    if effect.follows == TRAVEL:
        move = angles[k] - views.previous[:, k]
        along_move = partial(exponential_kernel, reach=direction_reach(angles[k]))
        return [(*degrees[k], _smooth_in_angle), (f"j{effect.joint}_move_deg", move, _DEGREES, along_move)]
    if effect.follows == JOINT_LOAD:
        return _bending_torques(effect)
    seconds = usual_time_step(effect.base.measurement)
    name, unit = ("time_s", seconds) if seconds else ("view", 1.0)
    along_time = partial(exponential_kernel, reach=DRIFT_MEMORY["slowly wandering"])
    return [(name, time_in_steps(effect.base.measurement), unit, along_time)]


def _bending_torques(effect: JointEffect) -> list[_Covariate]:
    """Return the torques that bend the joint of an effect; not those that never change."""
    torques = effect.base.measurement.views.torques
    bending = [t for t, k in enumerate(torques.joint) if k == effect.joint - 1 and np.ptp(torques.values[:, t]) > STILL]
    covariates = list[_Covariate]()
    for t in bending:
        torque = torques.values[:, t]
        along_torque = partial(exponential_kernel, reach=len(bending) * float(np.ptp(torque)))
        # The name of a torque between two joints, as 2_3, means 1 kg at a link whose mass nobody states.
        name = f"j{torques.names[t]}_torque_nm" + ("_per_kg" if "_" in torques.names[t] else "")
        covariates.append((name, torque, 1.0, along_torque))
    return covariates


def _smooth_in_angle(some: Array, others: Array) -> Array:
    """Return the covariance (S, O) of a smooth random function between angles (S,) and (O,), rad."""
    return rbf_joints(some[:, None], others[:, None])


def _one_of_two_angles(some: Array, others: Array) -> Array:
    """Return the factor (S, O) of `two_joint_kernel` for one of its two angles, between values (S,) and (O,), rad."""
    return 2 * _smooth_in_angle(some, others) - 1


def _curve_along(effect: JointEffect, covariate: _Covariate, variance: float) -> JointCurve:
    """Return the error of a joint along one covariate, averaged over the views' values of all else that it follows.

    Args:
        variance: of the effect over the views, rad²; the curve's share is of this.
    """
    name, of_views, unit, kernel = covariate
    views = len(of_views)
    grid = np.linspace(of_views.min(), of_views.max(), _CURVE_POINTS)
    places = np.append(grid, of_views)
    # The factor by all else that the effect follows; 1 where nothing is left of that by the covariate.
    alone = kernel(of_views, of_views)
    remaining = np.ones((views, views))
    np.divide(effect.errors.kernel_of(effect.process), alone, out=remaining, where=alone > _NO_COVARIANCE)
    # Averaged over what else the effect follows: with each view's values of that, and with all pairs of views.
    with_views = remaining.mean(axis=0) * kernel(places, of_views)
    with_places = remaining.mean() * kernel(places, places)
    # Takes off the mean over the views, the last of the places.
    centred = np.eye(len(places)) - np.repeat([0.0, 1.0 / views], [_CURVE_POINTS, views])
    prior = centred @ with_places @ centred.T
    mean, covariance = _posterior_error(effect, with_views=centred @ with_views, prior=prior)
    return JointCurve(
        joint=effect.joint,
        covariate=name,
        share=min(float(mean[_CURVE_POINTS:].var() / max(variance, 1e-300)), 1.0),
        at=unit * grid,
        error=mean[:_CURVE_POINTS],
        sigma=np.sqrt(np.maximum(np.diag(covariance)[:_CURVE_POINTS], 0)),
        view_values=unit * of_views,
        may_follow=effect.may_follow,
        place=effect.place,
    )


def _posterior_error(effect: JointEffect, with_views: Array, prior: Array) -> tuple[Array, Array]:
    """Return mean (G,), rad, and covariance (G, G), rad², of a joint's error at G places, given the views.

    Regression of a Gaussian process (Rasmussen & Williams 2006, eq. 2.41), with the fitted variance of the effect.

    Args:
        with_views: (G, V) prior covariance of the error at these places with that in the views, for variance 1.
        prior: (G, G) prior covariance of the error among these places, for variance 1.
    """
    linear = effect.model
    variance = linear.null.variances[-1]
    motions = effect.errors.columns[:, effect.process].reshape(-1, 6, 1)
    white = linear.residual(linear.reduce((motions * with_views.T[:, None, :]).reshape(-1, len(with_views))))
    mean = variance * white.T @ linear.white_residual
    size = effect.typical_size
    return size * mean, size**2 * (variance * prior - variance**2 * white.T @ white)
