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

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from scipy.special import logsumexp

from stitch.diagnosis import thresholds as limits
from stitch.diagnosis.smooth_processes import SmoothProcess, leading_trends, size_process
from stitch.diagnosis.systematic_laws import could_be_base
from stitch.effects.contract import EFFECTS
from stitch.model.model import term_of
from stitch.numerics import parameter_selection
from stitch.numerics.frames import Array
from stitch.numerics.kernels import (
    SmoothErrors,
    direction_reach,
    exponential_kernel,
    joint_kernel_factors,
    periodic_kernel,
    rbf_joints,
    short_range_kernel,
)
from stitch.numerics.parameter_selection import log_mean_exp
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

# What not knowing its size costs an unmodelled effect, nats: as much as one with a name (`try_form`), so that neither
# has an advantage.
ANY_SIZE = -float(np.log(parameter_selection.ANY_SIZE[1.0]))
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
_PLACES = 25  # of a curve, over the range of a joint


@dataclass(frozen=True)
class JointEffect:
    """One joint that errs by an unmodelled effect."""

    joint: int  # counted from 1
    follows: str  # ALL_ANGLES, TWO_ANGLES, OWN_ANGLE, WAVES, …
    process: int  # of that kind; the likeliest, where a joint has several
    log_bayes_factor: float  # over everything else that may be there, at the likeliest size; their mean, of several
    base: LinearModel  # without the effect
    fit: VarianceFit | None = None  # of the views with it; None where it was only sized at the null's variances
    may_follow: tuple[str, ...] = ()  # in words, the likeliest first: what 20 to 1 does not tell apart

    @property
    def errors(self) -> SmoothErrors:
        """The errors of its kind, of all joints."""
        return _joint_processes(self.base)[self.follows]

    @property
    def usual(self) -> float:
        """The size of which its columns are, rad."""
        return float(term_of(self.base.measurement, EFFECTS["joint_offset"]).typical[self.joint - 1])

    @cached_property
    def place(self) -> str:
        """Where the effect acts, in words: joint 2, or also the base where that would explain the views as well."""
        kernel = self.errors.kernel_of(self.process)
        error = _given_views(self, kernel, kernel)[0] / self.usual
        motions = self.errors.columns[:, self.process].reshape(len(error), 6)
        turned = self.model.reduce((motions * error[:, None]).reshape(-1, 1))[:, 0]
        joint = f"joint {self.joint}"
        in_time = self.follows in (WITH_TIME, TIME_ONLY)
        or_base = in_time and could_be_base(self.model, turned, error[:, None])
        return f"{joint}, or the base about the same axis (these views cannot tell)" if or_base else joint

    @cached_property
    def model(self) -> LinearModel:
        """The model with the effect as the last pose error, all sizes fitted."""
        base = self.base
        assert base.pose_errors is not None
        component = base.reduce(base.reduce(self.errors.twist_covariance(self.process)).T)
        errors = base.pose_errors.with_component(f"joint {self.joint} by no known law", component, SMOOTH_SCALE)
        mixed = with_pose_errors(base.mixed, errors)
        null = self.fit
        if null is None:
            # At the maximum, sought from the likeliest of several starts.
            nulls = [at.null.variances for at in (base, *base.alternative_starts)]
            sizes = [times * SMOOTH_SCALE**2 for times in limits.UNMODELLED_VARIANCES]
            starts: list[Array] = [np.append(variances, size) for variances in nulls for size in sizes]
            null = fit_variances(mixed, start=min(starts, key=lambda start: at_variances(mixed, start).deviance))
        return replace(base, mixed=mixed, pose_errors=errors, null=null, full_model=None)


def joint_effects(base: LinearModel, kinds: Sequence[str] | None = None) -> tuple[JointEffect, ...]:
    """Return the unmodelled effect of each kind for each joint with its log Bayes factor, likeliest first.

    An unmodelled effect is a smooth random function of what it follows, such as the joint's angle. All variances are
    fitted again for the likeliest few; the others have a bound, their gain at the null's variances. Sizes are fitted,
    for which `log_posterior_of_any` charges. () without joints, or where pose errors have no prior.

    Args:
        kinds: what the effects follow; None: all kinds.
    """
    processes = _joint_processes(base)
    tried = list[JointEffect]()
    for follows, errors in processes.items():
        if kinds is not None and follows not in kinds:
            continue
        for process, joint in enumerate(errors.joints):
            kernel = errors.kernel_of(process)
            shapes = kernel @ leading_trends(kernel, len(kernel))
            motions = errors.columns[:, process].reshape(-1, 6, 1)
            _, gain = size_process(base, SmoothProcess(joint + 1, motions, shapes))
            tried.append(JointEffect(joint + 1, follows, process, gain, base))
    tried.sort(key=lambda effect: -effect.log_bayes_factor)
    for k, effect in enumerate(tried[: limits.JOINT_EFFECTS_FITTED]):
        null = effect.model.null
        tried[k] = replace(effect, log_bayes_factor=0.5 * (base.null.deviance - null.deviance), fit=null)
    by_kind: dict[tuple[int, str], list[JointEffect]] = {}
    for effect in tried:
        by_kind.setdefault((effect.joint, effect.follows), []).append(effect)
    # Which of a joint's effects of a kind it is, nobody knows: the likeliest has the mean Bayes factor of all.
    likeliest = [
        replace(
            max(effects, key=lambda effect: effect.log_bayes_factor),
            log_bayes_factor=float(log_mean_exp([effect.log_bayes_factor for effect in effects])),
        )
        for effects in by_kind.values()
    ]
    return tuple(sorted(likeliest, key=lambda effect: -effect.log_bayes_factor))


def joint_effect_log_posterior(base: LinearModel) -> float:
    """Return the log posterior that some joint has an unmodelled effect, comparable with those of effects (`Ranked`).

    −∞ where none can be tested.
    """
    effects = joint_effects(base)
    factors = np.array([effect.log_bayes_factor for effect in effects])
    return float(log_posterior_of_any(factors)) if effects else -np.inf


def log_posterior_of_any(log_bayes_factors: Array) -> Array:
    """Return (…) log posterior that one of the effects is there, from the log Bayes factors (L, …) of each.

    All kinds of effects of all joints share the prior alike, and none of their sizes is known.
    """
    return log_mean_exp(log_bayes_factors) + np.log(limits.PRIOR_UNKNOWN) - ANY_SIZE


def joint_effect_covariances(base: LinearModel) -> list[list[Array]]:
    """Return covariances (n, n) of unmodelled effects of usual size in the reduced observations.

    Each inner list holds those of one kind for one joint.
    """
    return [
        [SMOOTH_SCALE**2 * base.reduce(base.reduce(smooth.twist_covariance(p)).T) for p in smooth.of_joint(joint)]
        for smooth in _joint_processes(base).values()
        for joint in dict.fromkeys(smooth.joints)
    ]


def significant_joint_effects(linear: LinearModel) -> tuple[JointEffect, ...]:
    """Return unmodelled effects of single joints of which one is there, likeliest first, () if none is.

    With the likeliest joint come those that 20 to 1 does not tell from it, each by its likeliest kind of effect, with
    the log Bayes factor of its kinds together over all that the prior holds. Where none stands out beside all else, one
    that is 20 to 1 over none where joints and links err by it alone, and explains no less than all of them together.
    """
    beside_all = _likeliest_per_joint(joint_effects(linear))
    if beside_all or not _joint_processes(linear):
        return beside_all
    without_arm = linear.restricted(NOT_OF_ARM)
    alone = joint_effects(without_arm)
    of_all = 0.5 * (without_arm.null.deviance - linear.null.deviance)
    if alone[0].log_bayes_factor < of_all:
        return ()
    likeliest = _likeliest_per_joint(alone)
    return tuple(replace(effect, log_bayes_factor=effect.log_bayes_factor - of_all) for effect in likeliest)


def _joint_processes(base: LinearModel) -> dict[str, SmoothErrors]:
    """Return what each joint alone may do without a name, by kind; empty where pose errors have no prior."""
    return {} if base.pose_errors is None else base.pose_errors.joint_processes


def _likeliest_per_joint(effects: Sequence[JointEffect]) -> tuple[JointEffect, ...]:
    """Return the likeliest effect of every joint that is within 20 to 1 of the likeliest joint.

    `may_follow` lists the kinds within 20 to 1 of it. () where all effects together are not 20 to 1 over nothing.

    Args:
        effects: of all kinds and joints, likeliest first.
    """
    if not effects or log_mean_exp([effect.log_bayes_factor for effect in effects]) <= limits.ODDS:
        return ()
    of_joint = {k: [e for e in effects if e.joint == k] for k in dict.fromkeys(effect.joint for effect in effects)}
    together = {
        k: float(logsumexp([effect.log_bayes_factor for effect in of_joint[k]]) - np.log(len(effects)))
        for k in of_joint
    }
    likeliest = list[JointEffect]()
    for k in sorted(together, key=lambda k: -together[k]):
        if together[k] <= max(together.values()) - limits.ODDS:
            continue
        best = of_joint[k][0]
        near = [e for e in of_joint[k] if e.log_bayes_factor > best.log_bayes_factor - limits.ODDS]
        may_follow = tuple(dict.fromkeys(_FOLLOWED[effect.follows] for effect in near))
        likeliest.append(replace(best, log_bayes_factor=together[k], may_follow=may_follow))
    return tuple(likeliest)


@dataclass(frozen=True)
class JointCurve:
    """How far a joint is off along one number that it follows, the rest where these views had it; beside its mean over
    the views."""

    joint: int  # that errs, counted from 1
    covariate: str  # j3_deg; j3_move_deg, how far it came; time_s or view; j3_torque_nm, or j3_torque_nm_per_kg
    share: float  # of what the effect does over the views, 0 … 1
    at: Array  # (G,) of the covariate, in the unit that its name ends with
    error: Array  # (G,) of the joint that errs, rad
    sigma: Array  # (G,) of `error`, rad
    view_values: Array  # (V,) the covariate in the views
    place: str  # the joint, and what turns the views alike
    may_follow: tuple[str, ...] = ()  # what these views do not tell apart, the likeliest first

    @property
    def extremes(self) -> tuple[int, int]:
        """Places at which the error is smallest and largest."""
        return int(np.argmin(self.error)), int(np.argmax(self.error))


def joint_curves(effects: Sequence[JointEffect]) -> tuple[JointCurve, ...]:
    """Return curves of each effect along everything that it follows, the largest share of its variance first.

    A curve is a partial dependence (Friedman 2001, Ann. Stat. 29:1189): averaged over the other arguments. The effect
    is a random function; its mean and covariance given the observations are those of a Gaussian process (Rasmussen &
    Williams 2006, eq. 2.41), with the hand-eye free. Curves with a small share are left out.
    """
    curves = list[JointCurve]()
    for effect in effects:
        kernel = effect.errors.kernel_of(effect.process)
        variance = float(_given_views(effect, kernel, kernel)[0].var())
        curves += [_curve_along(effect, covariate, variance) for covariate in _covariates(effect)]
    return tuple(sorted((c for c in curves if c.share > limits.CURVE_LEAST_SHARE), key=lambda c: -c.share))


@dataclass(frozen=True)
class _Covariate:
    """One number that an effect follows, and the factors of the effect's covariance."""

    name: str
    view_values: Array  # (V,)
    kernel: Callable[[Array, Array], Array]  # (S, O) between places (S,) and (O,)
    remaining_kernel: Array | float = 1.0  # (V, V) between views, by all that the effect follows beside it
    unit: float = 1.0  # of the covariate per unit of `view_values`


def _covariates(effect: JointEffect) -> list[_Covariate]:
    """Return the arguments of an effect, by its kind, with the factors of its covariance for each.

    Covariances are products, one factor an argument: the remaining kernel is the product of the other factors.
    """
    k = effect.joint - 1
    views = effect.base.measurement.views
    q = views.joints
    if effect.follows == ALL_ANGLES:
        factors = joint_kernel_factors(q, q)
        others = [np.prod(np.delete(factors, j, axis=2), axis=2) for j in range(q.shape[1])]
        return [_along_angle(j, q, _smooth_in_angle, others[j]) for j in range(q.shape[1])]
    if effect.follows == TWO_ANGLES:
        partner = effect.errors.others[effect.process]
        pairs = ((k, partner), (partner, k))
        return [_along_angle(a, q, _one_of_two_angles, _one_of_two_angles(q[:, b], q[:, b])) for a, b in pairs]
    if effect.follows == OWN_ANGLE:
        return [_along_angle(k, q, short_range_kernel)]
    if effect.follows == WAVES:
        return [_along_angle(k, q, partial(periodic_kernel, period=effect.errors.periods[effect.process]))]
    if effect.follows == TRAVEL:
        angle = q[:, k]
        move = angle - views.previous[:, k]
        along_move = partial(exponential_kernel, reach=direction_reach(angle))
        return [
            _along_angle(k, q, _smooth_in_angle, along_move(move, move)),
            _Covariate(f"j{effect.joint}_move_deg", move, along_move, _smooth_in_angle(angle, angle), _DEGREES),
        ]
    if effect.follows == JOINT_LOAD:
        return _along_torques(effect)
    seconds = usual_time_step(effect.base.measurement)
    name, unit = ("time_s", seconds) if seconds else ("view", 1.0)
    along_time = partial(exponential_kernel, reach=DRIFT_MEMORY["slowly wandering"])
    rest = (1 + rbf_joints(q)) / 2 if effect.follows == WITH_TIME else 1.0
    return [_Covariate(name, time_in_steps(effect.base.measurement), along_time, rest, unit)]


def _along_torques(effect: JointEffect) -> list[_Covariate]:
    """Return the torques that bend a joint."""
    torques = effect.base.measurement.views.torques
    kernel = effect.errors.kernel_of(effect.process)
    bending = [t for t, k in enumerate(torques.joint) if k == effect.joint - 1 and np.ptp(torques.values[:, t]) > STILL]
    covariates = []
    for t in bending:
        torque = torques.values[:, t]
        along_torque = partial(exponential_kernel, reach=len(bending) * float(np.ptp(torque)))
        # Of what is known to weigh something, or of 1 kg at a link.
        name = f"j{torques.names[t]}_torque_nm" + ("_per_kg" if "_" in torques.names[t] else "")
        covariates.append(_Covariate(name, torque, along_torque, kernel / along_torque(torque, torque)))
    return covariates


def _along_angle(
    joint: int, joints: Array, kernel: Callable[[Array, Array], Array], remaining_kernel: Array | float = 1.0
) -> _Covariate:
    """Return the angle of a joint, counted from 0, of the views' joints (V, n) rad."""
    return _Covariate(f"j{joint + 1}_deg", joints[:, joint], kernel, remaining_kernel, _DEGREES)


def _smooth_in_angle(some: Array, others: Array) -> Array:
    """Return (S, O) of a smooth function of one angle, (S,) and (O,) rad."""
    return rbf_joints(some[:, None], others[:, None])


def _one_of_two_angles(some: Array, others: Array) -> Array:
    """Return (S, O) the factor of one angle, (S,) and (O,) rad, in what follows two."""
    return 2 * _smooth_in_angle(some, others) - 1


def _curve_along(effect: JointEffect, covariate: _Covariate, variance: float) -> JointCurve:
    """Return the error of a joint along one covariate, averaged over where all else that it follows stood.

    Args:
        variance: over the views of all that the effect does, rad²: the curve's share is of this.
    """
    at = covariate.view_values
    views = len(at)
    grid = np.linspace(at.min(), at.max(), _PLACES)
    places = np.append(grid, at)
    rest = np.broadcast_to(covariate.remaining_kernel, (views, views))
    with_views = rest.mean(axis=0) * covariate.kernel(places, at)
    with_places = rest.mean() * covariate.kernel(places, places)
    centred = np.eye(len(places)) - np.repeat([0.0, 1.0 / views], [_PLACES, views])
    mean, covariance = _given_views(effect, centred @ with_views, centred @ with_places @ centred.T)
    return JointCurve(
        joint=effect.joint,
        covariate=covariate.name,
        share=min(float(mean[_PLACES:].var() / max(variance, 1e-300)), 1.0),
        at=covariate.unit * grid,
        error=mean[:_PLACES],
        sigma=np.sqrt(np.maximum(np.diag(covariance)[:_PLACES], 0)),
        view_values=covariate.unit * at,
        may_follow=effect.may_follow,
        place=effect.place,
    )


def _given_views(effect: JointEffect, with_views: Array, prior: Array) -> tuple[Array, Array]:
    """Return by how much a joint errs at G places of its curve, given the views: regression of a Gaussian process.

    Args:
        with_views: (G, V) prior covariance of the error there with that at the views, per unit of its variance.
        prior: (G, G) prior covariance of the errors there.

    Returns:
        Mean (G,), rad, and covariance (G, G), rad².
    """
    linear = effect.model
    variance = linear.null.variances[-1]
    motions = effect.errors.columns[:, effect.process].reshape(-1, 6, 1)
    white = linear.residual(linear.reduce((motions * with_views.T[:, None, :]).reshape(-1, len(with_views))))
    mean = variance * white.T @ linear.white_residual
    return effect.usual * mean, effect.usual**2 * (variance * prior - variance**2 * white.T @ white)
