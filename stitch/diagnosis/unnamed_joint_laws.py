"""Laws without a name as rivals of those that have one: what a single joint does by no law that anybody wrote down.

A name is worth no more than what it is compared with. All joints and links following the pose at once (`smooth` in the
prior of pose errors) is a poor rival: it may do so much that it is believed to do little of anything. One joint that is
off by a smooth function of the joint angles is what a coupling, a hose or a gear with play really does, and where it
explains the views about as well as an effect of the library, these views cannot tell which it is. Likewise one joint
that is off by a function of its own angle that changes within a few degrees, as by a worn tooth or a wave of a gear, or
by any function of the way it came, as by friction, which is neither play nor settling; or that changes as time passes,
as where its motor warms, which is no drift of mount or part; or by a law of its load that is not that of a spring.

Three more laws such functions hold too, but with a number of their own in nearly every view: a joint that follows its
own angle and one other's, as two do that drag each other, one that errs in waves along its angle, as teeth of gears and
belts do, and one that errs in time alone, whatever the pose.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial

import numpy as np
from scipy.linalg.lapack import dpstrf
from scipy.special import logsumexp

from stitch.diagnosis import thresholds as limits
from stitch.effects.contract import EFFECTS
from stitch.model.forward import pose_derivatives
from stitch.model.model import term_of
from stitch.numerics import parameter_selection
from stitch.numerics.common_covariance import SelectedColumns
from stitch.numerics.frames import Array, Indices
from stitch.numerics.kernels import (
    REACH,
    SHORT_REACH,
    SmoothErrors,
    direction_reach,
    exponential_kernel,
    joint_kernel_factors,
    ornstein_uhlenbeck,
    periodic_kernel,
    rbf_joints,
    short_range_kernel,
)
from stitch.numerics.parameter_selection import log_mean_exp
from stitch.numerics.reml import MixedModel, VarianceFit, at_variances, fit_variances
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
    flange_twists,
    time_in_steps,
    usual_time_step,
)
from stitch.session.measurement import STILL

# Smooth processes by which a joint or the flange may err, as columns of the channel with unit coefficients: the
# leading eigenvectors of their covariance between views.

# Below this share of the largest variance nothing is left of a covariance.
_ROUNDING = 1e-8
# Of so many processes the courses are kept: those of a session with six or seven joints. Of thousands of poses each
# takes a megabyte or two.
_KEPT = 40


@dataclass(frozen=True)
class SmoothProcess:
    """Motions of the views that follow courses with unit coefficients; far smaller than its columns."""

    joint: int | None  # that errs, counted from 1; None: the flange
    motions: Array  # (V, 6, p) twists
    shapes: Array  # (V, R) courses

    def columns(self, linear: LinearModel) -> Array:
        """(n, p·R) of the channel: each motion in each course."""
        moved = self.motions[:, :, :, None] * self.shapes[:, None, None, :]
        return linear.observation.from_twists(moved.reshape(6 * len(moved), -1))


def joint_motions(linear: LinearModel) -> Array:
    """(n, V, 6, 1) twists of the views by a radian of each joint."""
    offset = term_of(linear.measurement, EFFECTS["joint_offset"])
    return next(pose_derivatives(linear.measurement, linear.model, [offset], linear.observation.centre))[..., None]


def single_joint_processes(linear: LinearModel, motions: Array, k: int) -> Iterator[SmoothProcess]:
    """Joint k, counted from 0, that follows all joints, its own angle closely, or its own and the one that it comes
    from."""
    views = linear.measurement.views
    own, came = views.joints[:, [k]], views.previous[:, [k]]
    for angles, reach in ((views.joints, REACH), (own, SHORT_REACH), (np.hstack([own, came]), REACH)):
        yield SmoothProcess(k + 1, motions[k], _smooth_courses(angles, reach))


def joint_pair_processes(linear: LinearModel, motions: Array, k: int) -> Iterator[SmoothProcess]:
    """Joint k, counted from 0, that follows its own angle and that of one other."""
    joints = linear.measurement.views.joints
    for other in range(joints.shape[1]):
        if other != k:
            yield SmoothProcess(k + 1, motions[k], _smooth_courses(joints[:, [k, other]]))


def wandering_flange(linear: LinearModel) -> SmoothProcess:
    """A flange that wanders."""
    measurement, time = linear.measurement, time_in_steps(linear.measurement)
    knots = _knots(len(time))
    alike = ornstein_uhlenbeck(time, DRIFT_MEMORY["slowly wandering"], time[knots])
    carried = flange_twists([measurement], [linear.observation.centre]).reshape(len(alike), 6, 6)
    return SmoothProcess(None, carried, alike @ _leading_courses(alike[knots], limits.PROCESS_COLUMNS // 6))


def _smooth_courses(angles: Array, reach: float = REACH) -> Array:
    """(V, R) smooth courses over some angles (V, a), without what is alike in all views: that has a name."""
    return _smooth_courses_cached(np.ascontiguousarray(angles).tobytes(), len(angles), reach)


@lru_cache(maxsize=_KEPT)
def _smooth_courses_cached(angles: bytes, views: int, reach: float) -> Array:
    """(V, R) of the views whose angles these are: the same in every diagnosis of a session."""
    every = np.frombuffer(angles).reshape(views, -1)
    among_knots = rbf_joints(every, every[_knots(views)], reach)
    shapes = among_knots @ _leading_courses(among_knots[_knots(views)], limits.PROCESS_COLUMNS)
    return np.asarray(shapes - shapes.mean(axis=0))


def _knots(views: int) -> Indices:
    return np.unique(np.linspace(0, views - 1, min(views, limits.PROCESS_KNOTS)).astype(np.int64))


def _leading_courses(covariance: Array, most: int) -> Array:
    """(K, R) of which the courses with unit coefficients of a process are made, by its covariance with the knots."""
    # What is smooth is a product of few columns: theirs are its courses, found in a third of the time.
    factor, order, rank, _ = dpstrf(covariance, lower=1, tol=_ROUNDING * covariance.diagonal().max())
    root = np.zeros((len(covariance), rank))
    root[order - 1] = np.tril(factor[:, :rank])
    few = rank < len(covariance) / 2
    values, vectors = np.linalg.eigh(root.T @ root if few else covariance)
    values, vectors = values[::-1][:most], vectors[:, ::-1][:, :most]
    keep = values > limits.PROCESS_LEAST_VARIANCE * values[0]
    courses = vectors[:, keep] / np.sqrt(values[keep])
    return np.asarray(root @ (courses / np.sqrt(values[keep])) if few else courses)


# How large a smooth process without a name is beside a model, and how much likelier the views are with it.

# Sizes that are tried, as multiples of the one at which the clearest column is as large as its own sigma.
_SIZES = np.geomspace(0.1, 1e5, 49)


@dataclass(frozen=True)
class SizedProcess:
    """A process at the size that is likeliest at the null's variances, and its log Bayes factor there."""

    process: SmoothProcess
    size: float
    gain: float


@dataclass(frozen=True)
class FittedProcess:
    """A process at its likeliest size, all variances fitted beside it."""

    base: LinearModel  # without it
    process: SmoothProcess
    columns: Array  # (n, R) of the channel, per unit of that size
    size: float
    fit: VarianceFit  # of the views with the process
    log_bayes_factor: float  # over the model without it, less the number of processes that were tried

    @property
    def joint(self) -> int | None:
        """Return the joint that follows it, counted from 1; None: the flange, in time."""
        return self.process.joint

    @property
    def flange_scatter(self) -> Array:
        """(2,) variances along an axis by which the flange turns and moves anew in every view, beside the process."""
        return self.base.flange_scatter(self.fit)

    @property
    def numbers(self) -> Array:
        """(n,) of the channel that it explains."""
        return np.asarray(self.columns @ self.fit.mean[-self.columns.shape[1] :])


def size_process(linear: LinearModel, process: SmoothProcess) -> SizedProcess:
    """Its size at the null's variances.

    Over the eigenvalues k of the columns' information and the shares g of what was seen: log BF(s) =
    ½ Σ g²/(k + 1/s²) − ½ Σ log(1 + s²k).
    """
    told, vector = next(linear.information([SelectedColumns(process.columns(linear))]))
    k, vectors = np.linalg.eigh(told)
    k, g = np.maximum(k, 0.0), vectors.T @ vector
    if not k[-1] > 0:
        return SizedProcess(process, 1.0, -np.inf)
    sizes = _SIZES / np.sqrt(k[-1])
    gains = g**2 / (k + 1 / sizes[:, None] ** 2) - np.log1p(sizes[:, None] ** 2 * k)
    found = 0.5 * gains.sum(axis=1)
    return SizedProcess(process, float(sizes[found.argmax()]), float(found.max()))


def fit_process(linear: LinearModel, sized: SizedProcess, tried: int) -> FittedProcess:
    """Fit all variances anew: what a process explains is no scatter, and where the scatter is less it is
    likelier of another size."""
    columns = sized.process.columns(linear)
    G, unit = linear.in_blocks(columns), np.ones(columns.shape[1])
    fit = fit_variances(linear.mixed, G, sized.size * unit, start=linear.null.variances)
    size = size_process(replace(linear, null=fit), sized.process).size
    again = fit_variances(linear.mixed, G, size * unit, start=fit.variances)
    size, fit = (size, again) if again.deviance < fit.deviance else (sized.size, fit)
    gained = 0.5 * (linear.null.deviance - fit.deviance) - float(np.log(tried))
    return FittedProcess(linear, sized.process, columns, size, fit, gained)


# What not knowing its size costs a law, nats: as much as an effect (`try_form`), so that neither has an advantage.
ANY_SIZE = -float(np.log(parameter_selection.ANY_SIZE[1.0]))


@dataclass(frozen=True)
class JointLaw:
    """One joint that follows a law without a name."""

    joint: int  # counted from 1
    follows: str  # ALL_ANGLES, TWO_ANGLES, OWN_ANGLE, WAVES, …
    process: int  # of that kind; the likeliest, where a joint has several
    log_bayes_factor: float  # over everything else that may be there, at the likeliest size; their mean, of several
    base: LinearModel  # without the law
    fit: VarianceFit | None = None  # of the views with it; None where it was only sized at the null's variances
    may_follow: tuple[str, ...] = ()  # in words, the likeliest first: what 20 to 1 does not tell apart

    @property
    def errors(self) -> SmoothErrors:
        """Return the errors of its kind, of all joints."""
        return _joint_processes(self.base)[self.follows]

    @cached_property
    def model(self) -> LinearModel:
        """Return the model with the law as the last pose error, all sizes fitted."""
        errors = self.base.pose_errors
        assert errors is not None
        own = self.base.reduce(self.base.reduce(self.errors.twist_covariance(self.process)).T)
        every = errors.with_component(f"joint {self.joint} by no known law", own, SMOOTH_SCALE)
        mixed = with_pose_errors(self.base.mixed, every)
        null = self.fit or _fit_law(self.base, mixed)
        return replace(self.base, mixed=mixed, pose_errors=every, null=null, full_model=None)

    def fitted(self) -> "JointLaw":
        """Fit all variances anew: what a law explains is no scatter."""
        null = self.model.null
        return replace(self, log_bayes_factor=0.5 * (self.base.null.deviance - null.deviance), fit=null)


def joint_laws(base: LinearModel) -> tuple[JointLaw, ...]:
    """Find what a law of each kind of each joint explains, likeliest first; () without joints or prior of errors.

    Its size is fitted with all others; `some_law` charges it for that.
    """
    return tuple(sorted(laws_of_kinds(base, tuple(_joint_processes(base))), key=lambda law: -law.log_bayes_factor))


def joint_law_log_posterior(base: LinearModel) -> float:
    """Return the log posterior that some joint follows such a law, as those of effects in the same model
    (`Ranked`); −∞ where the views tell of none."""
    laws = joint_laws(base)
    return float(log_posterior_of_any(np.array([law.log_bayes_factor for law in laws]))) if laws else -np.inf


def log_posterior_of_any(log_bayes_factors: Array) -> Array:
    """(…) log posterior that one of the laws is there, from the log Bayes factors (L, …) of each: all kinds of laws of
    all joints share the prior alike, and none of their sizes is known."""
    return np.asarray(log_mean_exp(log_bayes_factors) + np.log(limits.PRIOR_UNKNOWN) - ANY_SIZE)


def law_covariances(base: LinearModel) -> list[list[Array]]:
    """(n, n) in the channel of the laws of usual size, those of one kind of one joint together."""
    return [
        [SMOOTH_SCALE**2 * base.reduce(base.reduce(smooth.twist_covariance(p)).T) for p in smooth.of_joint(joint)]
        for smooth in _joint_processes(base).values()
        for joint in dict.fromkeys(smooth.joints)
    ]


def _joint_processes(base: LinearModel) -> dict[str, SmoothErrors]:
    """What each joint alone may do without a name, by kind; empty where pose errors have no prior."""
    return {} if base.pose_errors is None else base.pose_errors.joint_processes


def laws_of_kinds(base: LinearModel, kinds: Sequence[str]) -> list[JointLaw]:
    """Return the laws of every joint, by each of these kinds that the views show.

    All variances are sought anew for the likeliest few; for the others their likelihood at the null's is a bound.
    """
    processes = _joint_processes(base)
    tried = [
        _law_at_null(base, follows, process)
        for follows in kinds
        if follows in processes
        for process in range(len(processes[follows].joints))
    ]
    tried.sort(key=lambda law: -law.log_bayes_factor)
    tried = [law.fitted() if k < limits.JOINT_LAWS_FITTED else law for k, law in enumerate(tried)]
    every: dict[tuple[int, str], list[JointLaw]] = {}
    for law in tried:
        every.setdefault((law.joint, law.follows), []).append(law)
    # Which of a joint's laws of a kind it is, nobody knows: the likeliest has the mean Bayes factor of all.
    return [
        replace(
            max(laws, key=lambda law: law.log_bayes_factor),
            log_bayes_factor=float(log_mean_exp([law.log_bayes_factor for law in laws])),
        )
        for laws in every.values()
    ]


def _law_at_null(base: LinearModel, follows: str, process: int) -> JointLaw:
    smooth = _joint_processes(base)[follows]
    joint, motions = smooth.joints[process] + 1, smooth.columns[:, process].reshape(-1, 6, 1)
    kernel = smooth.kernel_of(process)
    sized = size_process(base, SmoothProcess(joint, motions, kernel @ _leading_courses(kernel, len(kernel))))
    return JointLaw(joint, follows, process, sized.gain, base)


def _fit_law(base: LinearModel, mixed: MixedModel) -> VarianceFit:
    """At the maximum, sought from the likeliest of several starts."""
    nulls = [at.null.variances for at in (base, *base.alternative_starts)]
    starts: list[Array] = [np.append(null, times * SMOOTH_SCALE**2) for null in nulls for times in limits.LAW_VARIANCES]
    return fit_variances(mixed, start=min(starts, key=lambda start: at_variances(mixed, start).deviance))


# What a law without a name of one joint follows: the numbers along which its course can be told.

JOINT_ANGLES = "the joint angles"
_DEGREES = float(np.degrees(1.0))


@dataclass(frozen=True)
class LawCovariate:
    """One number that a law follows, and the factors of the law's covariance."""

    covariate: str
    view_values: Array  # (V,)
    kernel: Callable[[Array, Array], Array]  # (S, O) between places (S,) and (O,)
    remaining_kernel: Array | float = 1.0  # (V, V) between views, by all that the law follows beside it
    unit: float = 1.0  # of the covariate per unit of `stood`


def _angle(joint: int, stood: Array, of_it: Callable[[Array, Array], Array], rest: Array | float = 1.0) -> LawCovariate:
    """Along the angle of a joint, counted from 0; `stood` (V,) rad."""
    return LawCovariate(f"j{joint + 1}_deg", stood, of_it, rest, _DEGREES)


def _all_angles(law: JointLaw) -> list[LawCovariate]:
    joints = law.base.measurement.views.joints
    factors = joint_kernel_factors(joints, joints)
    return [
        _angle(j, q, _smooth_in_angle, np.asarray(np.prod(np.delete(factors, j, axis=2), axis=2)))
        for j, q in enumerate(joints.T)
    ]


def _two_angles(law: JointLaw) -> list[LawCovariate]:
    joints, two = law.base.measurement.views.joints, (law.joint - 1, law.errors.others[law.process])
    return [
        _angle(j, joints[:, j], _factor_of_one_angle, _factor_of_one_angle(joints[:, other], joints[:, other]))
        for j, other in (two, two[::-1])
    ]


def _own_angle(law: JointLaw) -> list[LawCovariate]:
    own = law.joint - 1
    return [_angle(own, law.base.measurement.views.joints[:, own], short_range_kernel)]


def _periodic_angle(law: JointLaw) -> list[LawCovariate]:
    own = law.joint - 1
    of_it = partial(periodic_kernel, period=law.errors.periods[law.process])
    return [_angle(own, law.base.measurement.views.joints[:, own], of_it)]


def _approach(law: JointLaw) -> list[LawCovariate]:
    own, views = law.joint - 1, law.base.measurement.views
    q, came = views.joints[:, own], views.joints[:, own] - views.previous[:, own]
    of_move = partial(exponential_kernel, reach=direction_reach(q))
    return [
        _angle(own, q, _smooth_in_angle, of_move(came, came)),
        LawCovariate(f"j{law.joint}_move_deg", came, of_move, _smooth_in_angle(q, q), _DEGREES),
    ]


def _time(law: JointLaw) -> list[LawCovariate]:
    measurement = law.base.measurement
    seconds = usual_time_step(measurement)
    name, unit = ("time_s", seconds) if seconds else ("view", 1.0)
    of_it = partial(exponential_kernel, reach=DRIFT_MEMORY["slowly wandering"])
    rest = (1 + rbf_joints(measurement.views.joints)) / 2 if law.follows == WITH_TIME else 1.0
    return [LawCovariate(name, time_in_steps(measurement), of_it, rest, unit)]


def _joint_load(law: JointLaw) -> list[LawCovariate]:
    torques, whole = law.base.measurement.views.torques, law.errors.kernel_of(law.process)
    own = [t for t, k in enumerate(torques.joint) if k == law.joint - 1 and np.ptp(torques.values[:, t]) > STILL]
    found = []
    for t in own:
        stood = torques.values[:, t]
        of_it = partial(exponential_kernel, reach=len(own) * float(np.ptp(stood)))
        # Of what is known to weigh something, or of 1 kg at a link.
        name = f"j{torques.names[t]}_torque_nm" + ("_per_kg" if "_" in torques.names[t] else "")
        found.append(LawCovariate(name, stood, of_it, whole / of_it(stood, stood)))
    return found


# By kind of law what it follows, in words and along what its course is told.
_COVARIATES_OF_KIND: dict[str, tuple[str, Callable[[JointLaw], list[LawCovariate]]]] = {
    ALL_ANGLES: (JOINT_ANGLES, _all_angles),
    TWO_ANGLES: (JOINT_ANGLES, _two_angles),
    OWN_ANGLE: (JOINT_ANGLES, _own_angle),
    WAVES: (JOINT_ANGLES, _periodic_angle),
    TRAVEL: ("the way it came", _approach),
    WITH_TIME: ("time", _time),
    TIME_ONLY: ("time", _time),
    JOINT_LOAD: ("its load", _joint_load),
}


def _smooth_in_angle(some: Array, others: Array) -> Array:
    """(S, O) of a smooth function of one angle, (S,) and (O,) rad."""
    return rbf_joints(some[:, None], others[:, None])


def _factor_of_one_angle(some: Array, others: Array) -> Array:
    """(S, O) the factor of one angle, (S,) and (O,) rad, in what follows two."""
    return np.asarray(2 * _smooth_in_angle(some, others) - 1)


# Which joint errs by a law without a name: told beside all else that an arm may do, or in place of it.
#
# All joints and links following the pose at once can do what one joint does, and beside them its law gains nothing. But
# where one joint alone explains the views at least as well as all of them together, the errors live there. Compared are
# maxima of likelihood and prior: the sizes of all together are charged some three nats for being there at all. An arm
# of which every joint and link is off is hardly ever explained by one of its joints alone.
#
# Of all kinds of laws of all joints one may be there, each as likely before: what counts is their mean Bayes factor,
# and of a joint the mean of its kinds.


def significant_laws(linear: LinearModel) -> tuple[JointLaw, ...]:
    """Laws of single joints of which one is there, likeliest first, () if none is.

    With the likeliest joint come those that 20 to 1 does not tell from it, each by its likeliest kind of law, with the
    log Bayes factor of its kinds together over all that the prior holds.
    """
    return _likeliest_law_per_joint(joint_laws(linear)) or _laws_without_arm_errors(linear)


def _laws_without_arm_errors(linear: LinearModel) -> tuple[JointLaw, ...]:
    """Return laws of which one, where joints and links err by it alone, is 20 to 1 over none and explains no less
    than all of them together."""
    if not _joint_processes(linear):
        return ()
    right = linear.restricted(NOT_OF_ARM)
    tried = joint_laws(right)
    whole = 0.5 * (right.null.deviance - linear.null.deviance)
    if tried[0].log_bayes_factor < whole:
        return ()
    return tuple(replace(law, log_bayes_factor=law.log_bayes_factor - whole) for law in _likeliest_law_per_joint(tried))


def _likeliest_law_per_joint(laws: Sequence[JointLaw]) -> tuple[JointLaw, ...]:
    """Return the likeliest law of every joint within 20 to 1 of the likeliest; () where none is so much
    likelier than nothing.

    Args:
        laws: of all kinds and joints, likeliest first.
    """
    if not laws or log_mean_exp([law.log_bayes_factor for law in laws]) <= limits.ODDS:
        return ()
    of_joint = {k: [law for law in laws if law.joint == k] for k in dict.fromkeys(law.joint for law in laws)}
    factors = {k: [law.log_bayes_factor for law in own] for k, own in of_joint.items()}
    together = {k: float(logsumexp(own) - np.log(len(laws))) for k, own in factors.items()}
    near = [k for k in together if together[k] > max(together.values()) - limits.ODDS]
    return tuple(_law_with_alternatives(of_joint[k], together[k]) for k in sorted(near, key=lambda k: -together[k]))


def _law_with_alternatives(laws: Sequence[JointLaw], together: float) -> JointLaw:
    """The likeliest law of a joint, with what it may follow as well.

    Args:
        laws: of all kinds, likeliest first.
        together: log Bayes factor of them.
    """
    near = [law for law in laws if law.log_bayes_factor > laws[0].log_bayes_factor - limits.ODDS]
    in_words = dict.fromkeys(_COVARIATES_OF_KIND[law.follows][0] for law in near)
    return replace(laws[0], log_bayes_factor=together, may_follow=tuple(in_words))


# Courses of laws without a name, with bands: where in its range a joint errs, when, or under which load.

_PLACES = 25  # over the range of a joint


@dataclass(frozen=True)
class JointCurve:
    """How far a joint is off along one number that it follows, the rest where these views had it; beside its mean over
    the views."""

    joint: int  # that errs, counted from 1
    covariate: str  # j3_deg; j3_move_deg, how far it came; time_s or view; j3_torque_nm, or j3_torque_nm_per_kg
    share: float  # of what the law does over the views, 0 … 1
    at: Array  # (G,) of the covariate, in the unit that its name ends with
    error: Array  # (G,) of the joint that errs, rad
    sigma: Array  # (G,) of `error`, rad
    view_values: Array  # (V,) the covariate in the views
    may_follow: tuple[str, ...] = ()  # what these views do not tell apart, the likeliest first

    @property
    def extremes(self) -> tuple[int, int]:
        """Places at which the error is smallest and largest."""
        return int(np.argmin(self.error)), int(np.argmax(self.error))


def joint_curves(laws: Sequence[JointLaw]) -> tuple[JointCurve, ...]:
    """Partial dependence (Friedman 2001, Ann. Stat. 29:1189) of each law on all that it follows, largest share first.

    The law is a random function; what the views say of it is its mean and covariance given their numbers, with the
    hand-eye free and at the fitted sizes of all errors (kriging; Rasmussen & Williams 2006, eq. 2.41).
    """
    found = []
    for law in laws:
        alike = law.errors.kernel_of(law.process)
        whole = float(_law_given_views(law, alike, alike)[0].var())
        found += [_curve_along(law, along, whole) for along in _COVARIATES_OF_KIND[law.follows][1](law)]
    return tuple(sorted((c for c in found if c.share > limits.CURVE_LEAST_SHARE), key=lambda c: -c.share))


def _curve_along(law: JointLaw, along: LawCovariate, whole: float) -> JointCurve:
    """`whole` is the variance over the views of all that the law does, rad²."""
    at, views = along.view_values, len(along.view_values)
    grid = np.linspace(at.min(), at.max(), _PLACES)
    places = np.append(grid, at)
    # Of the function averaged over where all else stood.
    rest = np.broadcast_to(along.remaining_kernel, (views, views))
    with_views = rest.mean(axis=0) * along.kernel(places, at)
    with_places = rest.mean() * along.kernel(places, places)
    centred = np.eye(len(places)) - np.repeat([0.0, 1.0 / views], [_PLACES, views])
    mean, covariance = _law_given_views(law, centred @ with_views, centred @ with_places @ centred.T)
    return JointCurve(
        joint=law.joint,
        covariate=along.covariate,
        share=min(float(mean[_PLACES:].var() / max(whole, 1e-300)), 1.0),
        at=along.unit * grid,
        error=mean[:_PLACES],
        sigma=np.sqrt(np.maximum(np.diag(covariance)[:_PLACES], 0)),
        view_values=along.unit * at,
        may_follow=law.may_follow,
    )


def _law_given_views(law: JointLaw, with_views: Array, prior: Array) -> tuple[Array, Array]:
    """Mean (G,) and covariance (G, G) of places of the law, rad, from what the views show.

    Args:
        with_views: (G, V) covariance of the places with the law at the views, per unit of its variance.
        prior: (G, G) of the places among each other.
    """
    linear, k = law.model, law.joint - 1
    variance, usual = linear.null.variances[-1], float(term_of(linear.measurement, EFFECTS["joint_offset"]).typical[k])
    columns = law.errors.columns[:, law.process].reshape(-1, 6, 1)
    seen = linear.residual(linear.reduce((columns * with_views.T[:, None, :]).reshape(-1, len(with_views))))
    mean = variance * seen.T @ linear.white_residual
    return usual * mean, usual**2 * (variance * prior - variance**2 * seen.T @ seen)
